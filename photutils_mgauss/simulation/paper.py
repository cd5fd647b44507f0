"""
The simulated scenes of Nie et al., whole or as cut-outs.

The densities are printed in Sections 2.1.2, 4.1 and 5 of the paper. It shows
magnitudes in figures only; ours are those of `sky_field` and `crowded_field`.
"""
from dataclasses import replace

import astropy.units as u
import numpy as np
from astropy.coordinates import BarycentricMeanEcliptic, SkyCoord

from photutils_mgauss.psf.gridded import GriddedMixturePSF
from photutils_mgauss.simulation.catalogues import crowded_field, sky_field
from photutils_mgauss.simulation.effects import DetectorEffects
from photutils_mgauss.simulation.exposures import NGP, paper_exposures
from photutils_mgauss.simulation.instrument import Instrument
from photutils_mgauss.simulation.mock_psf import csst_psf
from photutils_mgauss.simulation.scene import simulate
from photutils_mgauss.utils.validation import (
    as_choice,
    as_integer,
    as_shape,
)
from photutils_mgauss.utils.waiting import waiting

__all__ = ['paper_scene']

FIELDS = ('ngp', 'ngp-psf', 'bulge')

# Point sources in so many square degrees, seen in so many pointings.
_POINT_SOURCES, _SQUARE_DEGREES, _POINTINGS = 1523, 2.17, 135
# The share of stars of both kinds of sources (Sec. 4.1).
_STARS = 614 / (614 + 590)
# Where the crowded field is, on the ecliptic [deg].
_BULGE = (266.0, 5.0)


@waiting('paper_scene')
def paper_scene(field='ngp', shape=None, *, epoch=3, psf=None, effects=None,
                rng=0, executor=None):
    """
    Take an image of one of the fields that Nie et al. simulate.

    ==========  ======================================================
    Field       What is on a whole detector
    ==========  ======================================================
    'ngp'       614 stars and 590 quasars within 11.3 arcmin, moving,
                to measure motions of (Sec. 4.1)
    'ngp-psf'   the stars and quasars of all 135 pointings at a density
                of 1523 in 2.17 square degrees, together on one image,
                to make the PSF of (Sec. 2.1.2): 3406
    'bulge'     5.4 million stars of 16 to 26 mag, towards the bulge
                (Sec. 5)
    ==========  ======================================================

    Stars move, have parallaxes and are displaced by differential aberration.
    Each exposure has a pointing, a rotation, a scale and a distortion of its
    own, as `paper_exposures` draws them.

    Parameters
    ----------
    field : {'ngp', 'ngp-psf', 'bulge'}, optional
        The field.
    shape : int or (ny, nx) tuple of int, optional
        The pixels: by default a whole detector, (9232, 9216). A smaller one
        is a cut-out of its middle, with the density of the paper and the
        PSF and distortion that the middle of the detector has.
    epoch : int, optional
        Which row of the paper's Table 2, from 1 to 7, tells the time, the
        band and the detector.
    psf : GriddedMixturePSF or `~photutils.psf.GriddedPSFModel`, optional
        The PSF; by default the `csst_psf` of the band and detector.
    effects : DetectorEffects, optional
        The imperfections of the detector; by default
        ``DetectorEffects.typical()``.
    rng : int, optional
        The seed. All epochs of a seed show the same sources.
    executor : `~concurrent.futures.Executor`, optional
        Where bands of rows are made; by default a pool of threads.

    Returns
    -------
    Scene

    Raises
    ------
    ValueError
        If the field is unknown, the shape exceeds the detector or the epoch
        is not in the table.

    Examples
    --------
    A cut-out of the crowded field has one star per 16 pixels:

    >>> from photutils_mgauss import paper_scene
    >>> scene = paper_scene('bulge', (100, 120))
    >>> scene.exposure
    <Exposure: g, 2026-08-11T02:49:27.000, ra=265.80064, dec=-18.38099>
    >>> int(scene.truth['inside'].sum()), round(5.4e6 / (9216 * 9232) * 12000)
    (771, 762)
    """
    as_choice(field, 'field', FIELDS)
    camera = Instrument()
    if shape is not None:
        camera = replace(camera, shape=_part(shape, camera.shape))
    epoch = as_integer(epoch, 'epoch', minimum=1, maximum=7)
    seed = as_integer(rng, 'rng', minimum=0)
    exposure = _exposure(field, epoch, camera.shape, seed)
    if psf is None:
        psf = _middle(exposure, camera.shape)
    if effects is None:
        effects = DetectorEffects.typical()
    return simulate(
        _sources(field, camera.shape, np.random.default_rng([seed, 0])),
        exposure, instrument=camera, psf=psf, effects=effects,
        rng=np.random.default_rng([seed, 2, epoch]), executor=executor)


def _part(shape, whole):
    shape = as_shape(shape, 'shape')
    if shape[0] > whole[0] or shape[1] > whole[1]:
        msg = (f'shape must be at most that of the detector, {whole}, got '
               f'{shape}')
        raise ValueError(msg)
    return shape


def _exposure(field, epoch, shape, seed):
    """Return a row of Table 2, with the distortion of the cut-out."""
    ra, dec = _bulge() if field == 'bulge' else NGP
    offset = 0.0 if field == 'bulge' else 3.0
    taken = paper_exposures(ra, dec, offset=offset, aberration=True,
                            rng=np.random.default_rng([seed, 1]))[epoch - 1]
    # Coefficients are for offsets in units of half the diagonal.
    share = np.hypot(*shape) / np.hypot(*Instrument().shape)
    order = np.add(*np.indices((4, 4)))
    return replace(taken, distortion=taken.distortion * share**order)


def _bulge():
    """Return the centre of the crowded field [deg]."""
    place = SkyCoord(*_BULGE * u.deg, frame=BarycentricMeanEcliptic).icrs
    return place.ra.deg, place.dec.deg


def _middle(exposure, shape):
    """Return the PSF that the middle of the detector has."""
    whole = Instrument().shape
    psf = csst_psf(whole, exposure.band, rng=exposure.detector)
    corner = [(whole[1] - shape[1]) / 2, (whole[0] - shape[0]) / 2]
    return GriddedMixturePSF(psf.mixtures, psf.grid_xypos - corner,
                             pixel_integrated=True)


def _sources(field, shape, rng):
    """Return the table of a field's sources."""
    if field == 'bulge':
        return crowded_field(shape, rng=rng)
    if field == 'ngp':
        return sky_field(rng=rng)
    return _psf_stars(shape, rng)


def _psf_stars(shape, rng):
    """Return the stars that fall on a part of a detector in all pointings."""
    degrees = Instrument().pixel_scale / 3600
    density = _POINT_SOURCES / _SQUARE_DEGREES * degrees**2 * _POINTINGS
    n = rng.poisson(density * shape[0] * shape[1])
    n_stars = rng.binomial(n, _STARS)
    table = sky_field(n_stars, n - n_stars, rng=rng)
    table.keep_columns(['id', 'kind', 'mag_g', 'mag_r', 'mag_i'])
    for name, pixels in (('x', shape[1]), ('y', shape[0])):
        table[name] = rng.uniform(-0.5, pixels - 0.5, n) * u.pix
    return table
