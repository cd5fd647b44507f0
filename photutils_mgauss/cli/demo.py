"""
The main job on a field that is simulated first.

Images of several epochs become PSF grids, catalogues and proper motions, and
the motions are compared with the truth.
"""
from dataclasses import dataclass, field
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.stats import mad_std
from astropy.table import QTable
from photutils.background import Background2D
from photutils.detection import DAOStarFinder
from scipy.spatial import cKDTree

from photutils_mgauss.cli.tools import whole_file
from photutils_mgauss.field.fit import fit_mixture_field
from photutils_mgauss.field.selection import select_psf_stars
from photutils_mgauss.motions import Epoch, ProperMotionFitter
from photutils_mgauss.photometry.psf_photometry import MixturePSFPhotometry
from photutils_mgauss.psf.gridded import GriddedMixturePSF
from photutils_mgauss.simulation import (
    Instrument,
    paper_exposures,
    simulate,
    sky_field,
)

# The exposures of the paper's Table 2 that make two to seven epochs: always
# the first and the last.
_CAMPAIGNS = {2: (0, 6), 3: (0, 3, 6), 4: (0, 1, 3, 6), 5: (0, 1, 3, 5, 6),
              6: (0, 1, 2, 3, 5, 6), 7: range(7)}

_FIT_SHAPE = (11, 11)
_PSF_RADIUS = 10


@dataclass(frozen=True)
class Settings:
    """What the demonstration simulates."""

    n_epochs: int = 5
    size: int = 1024
    n_stars: int = 350
    n_qsos: int = 120
    seed: int = 1

    @property
    def instrument(self):
        """The camera, with a detector of size by size pixels."""
        return Instrument(shape=(self.size, self.size))

    def sources(self):
        """Return stars and quasars of 18 to 24 mag."""
        arcmin = self.size * self.instrument.pixel_scale / 60
        return sky_field(self.n_stars, self.n_qsos, size=arcmin * 1.05,
                         magnitudes=(18, 24), parallaxes=False,
                         separation=0.9, rng=self.seed)

    def exposures(self):
        """Return some of the exposures of the paper's Table 2."""
        exposures = paper_exposures(offset=1.0)
        return [exposures[i] for i in _CAMPAIGNS[self.n_epochs]]


@dataclass(frozen=True, eq=False)
class Measured:
    """What the image of one epoch gave."""

    scene: object
    psf: GriddedMixturePSF
    n_psf_stars: int
    catalogue: QTable

    def residuals(self):
        """Return a row for each star: magnitude, error, stated error."""
        truth = self.scene.truth
        ours = np.column_stack([self.catalogue['x_fit'],
                                self.catalogue['y_fit']])
        true = np.column_stack([truth['x'].value, truth['y'].value])
        distance, nearest = cKDTree(true).query(ours)
        near = distance < 1
        return QTable({
            'mag': truth['mag'][nearest][near],
            'delta': (ours - true[nearest])[near] * u.pix,
            'error': np.column_stack([self.catalogue['x_err'],
                                      self.catalogue['y_err']])[near] * u.pix,
        })


@dataclass(frozen=True, eq=False)
class Result:
    """The motions and what is true about them."""

    epochs: list
    solution: object
    sources: QTable
    matched: QTable = field(init=False)

    def __post_init__(self):
        object.__setattr__(self, 'matched', _match(self.solution.stars,
                                                   self.sources))


def take_images(settings, progress):
    """Simulate the epochs; return the sources and a scene for each."""
    sources = settings.sources()
    exposures = settings.exposures()
    seeds = np.random.default_rng(settings.seed).spawn(len(exposures))
    scenes = [simulate(sources, exposure, instrument=settings.instrument,
                       rng=seed)
              for exposure, seed in progress(
                  list(zip(exposures, seeds, strict=True)), 'simulate')]
    return sources, scenes


def measure(scene):
    """Make the PSF and the catalogue of one image, from the image alone."""
    background = Background2D(scene.image, 128, mask=scene.mask)
    data = scene.image - background.background
    noise = background.background_rms
    candidates = select_psf_stars(data, error=scene.error, mask=scene.mask,
                                  radius=_PSF_RADIUS)
    psf = fit_mixture_field(data, candidates, error=scene.error,
                            mask=scene.mask, n_components=4, degree=2,
                            radius=_PSF_RADIUS).to_grid((10, 10))
    finder = DAOStarFinder(5 * background.background_rms_median, 2.0)
    photometry = MixturePSFPhotometry(psf, _FIT_SHAPE, finder=finder,
                                      aperture_radius=3, effective_gain=1,
                                      xy_cov=True)
    catalogue = photometry(data, error=noise, mask=scene.mask)
    catalogue = catalogue[catalogue['flags'] == 0]
    return Measured(scene, psf, int(np.sum(candidates['selected'])),
                    catalogue)


def find_motions(measured, sources):
    """Align the epochs on the quasars and fit proper motions."""
    quasars = sources[sources['kind'] == 'qso']['ra', 'dec']
    quasars['class'] = 'qso'
    epochs = [Epoch(_without_ids(m.catalogue), m.scene.wcs, m.scene.time)
              for m in measured]
    solution = ProperMotionFitter(references=quasars).fit(epochs)
    return Result(measured, solution, sources)


def _without_ids(catalogue):
    """Return the catalogue without the finder's running numbers."""
    return catalogue[[name for name in catalogue.colnames
                      if name not in ('id', 'group_id')]]


def _match(stars, sources):
    """Return measured stars, not quasars, beside their true motions."""
    stars = stars[np.isfinite(stars['pmra'].value)
                  & (stars['n_good_obs'] > 1)]
    found = SkyCoord(stars['ra'], stars['dec'])
    true = SkyCoord(sources['ra'], sources['dec'])
    index, distance, _ = found.match_to_catalog_sky(true)
    nearest = sources[index]
    good = (distance < 0.1 * u.arcsec) & (nearest['kind'] == 'star')
    table = stars[good]['pmra', 'pmdec', 'pmra_error', 'pmdec_error',
                        'n_good_obs']
    for name in ('pmra', 'pmdec'):
        table[f'{name}_true'] = nearest[name][good]
        table[f'{name}_pull'] = ((table[name] - table[f'{name}_true'])
                                 / table[f'{name}_error']).to_value('')
    table['mag'] = nearest['mag_g'][good]
    return table


def write(result, folder):
    """Write PSF grids, catalogues, motions and frames; return the paths."""
    folder = Path(folder)
    for number, epoch in enumerate(result.epochs, 1):
        _write_whole(epoch.psf, folder / f'psf_{number}.fits')
        _write_whole(epoch.catalogue, folder / f'catalogue_{number}.ecsv')
    for name, table in (('motions', result.solution.stars),
                        ('alignment', result.solution.alignment)):
        _write_whole(table, folder / f'{name}.ecsv')
        _write_whole(table, folder / f'{name}.fits')
    return sorted(folder.glob('*'))


def _write_whole(what, path):
    with whole_file(path) as draft:
        what.write(draft)


def write_images(scenes, sources, folder):
    """Write the images and the quasars among the sources; return paths."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, scene in enumerate(scenes, 1):
        scene.write(folder / f'night{number}.fits', overwrite=True)
    quasars = sources[sources['kind'] == 'qso']['ra', 'dec']
    quasars['class'] = 'qso'
    _write_whole(quasars, folder / 'quasars.ecsv')
    return sorted(folder.glob('*'))


def summary(result):
    """Return the lines that say what was recovered."""
    lines = ['epoch       band  PSF stars  stars  position error [mas]  pull']
    for epoch in result.epochs:
        stars = epoch.residuals()
        scale = 1000 * epoch.scene.instrument.pixel_scale
        pull = (stars['delta'] / stars['error']).value
        lines.append(
            f'{epoch.scene.time.isot[:10]}  {epoch.scene.exposure.band.name}'
            f'     {epoch.n_psf_stars:9d}  {len(stars):5d}'
            f'  {scale * mad_std(stars["delta"].value):20.2f}'
            f'  {mad_std(pull):4.2f}')
    lines.append('')
    lines.append('stars [mag]  number  median error  true scatter [mas/yr]'
                 '  pull')
    mag = result.matched['mag'].value
    for low, high in ((18, 20), (20, 22), (22, 24)):
        part = result.matched[(mag >= low) & (mag < high)]
        if len(part):
            lines.append(_motion_line(part, low, high))
    return lines


def _motion_line(part, low, high):
    delta = np.concatenate([(part[name] - part[f'{name}_true']).value
                            for name in ('pmra', 'pmdec')])
    pull = np.concatenate([part[f'{name}_pull'] for name in ('pmra',
                                                             'pmdec')])
    error = np.median(np.concatenate([part[f'{name}_error'].value for name
                                      in ('pmra', 'pmdec')]))
    return (f'{low}-{high}        {len(part):6d}  {error:12.3f}'
            f'  {mad_std(delta):21.3f}  {mad_std(pull):4.2f}')


def plot_positions(result, axes):
    """Plot the position errors of the first and the last epoch."""
    from photutils_mgauss.plotting import plot_error_curve
    for ax, epoch in zip(axes, (result.epochs[0], result.epochs[-1]),
                         strict=True):
        stars = epoch.residuals()
        scale = 1000 * epoch.scene.instrument.pixel_scale
        plot_error_curve(stars['mag'].value,
                         scale * stars['delta'].value,
                         scale * stars['error'].value, unit='mas', ax=ax)
        ax.set_title(f'{epoch.scene.time.isot[:10]}, band '
                     f'{epoch.scene.exposure.band.name}')


def plot_motions(result, axes):
    """Plot measured against true proper motions."""
    from photutils_mgauss.plotting import plot_comparison
    stars = result.matched
    for ax, name in zip(axes, ('pmra', 'pmdec'), strict=True):
        plot_comparison(stars[f'{name}_true'].value, stars[name].value,
                        stars[f'{name}_error'].value, label=name,
                        unit='mas/yr', ax=ax)
