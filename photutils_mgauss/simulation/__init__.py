"""
Images and catalogues with a known truth, drawn from a seed.

`scene` has `simulate` and its relatives, `paper` the paper's own scenes;
`instrument` is the camera of the paper's Table 1, `exposures` its Table 2
with pointings and distortions, `catalogues` the stars to draw, `mock_psf`
and `optics` the PSFs, `renderer` what draws stars with either. `image` makes
light into counts, `effects` and `brighter_fatter` spoil them as detectors
do, `bound` skips the image and gives catalogues at the Cramer-Rao bound,
`files` stores scenes. Every random number comes from the generator that is
passed in.
"""
from photutils_mgauss.utils.lazy import hand_on

__getattr__, __dir__, __all__ = hand_on(__name__, {
    'Band': 'instrument',
    'crowded_field': 'catalogues',
    'CSST_BANDS': 'instrument',
    'csst_psf': 'mock_psf',
    'DetectorEffects': 'effects',
    'Exposure': 'exposures',
    'Instrument': 'instrument',
    'Optics': 'optics',
    'paper_exposures': 'exposures',
    'paper_scene': 'paper',
    'render_stars': 'scene',
    'Scene': 'scene',
    'simulate': 'scene',
    'simulate_catalogues': 'scene',
    'simulate_epochs': 'scene',
    'SimulatedCatalogue': 'bound',
    'sky_field': 'catalogues',
    'sparse_field': 'catalogues',
})
