r"""
Images of stars whose truth is known.

The electrons of a pixel are drawn from the light of stars, sky and dark
current; the readout adds noise, a bias and the rounding of counts, and
saturated pixels hold a full well. What comes back is what a pipeline would
make of it: bias and dark removed, in electrons, with the sky left in.

A seed gives the same pixels with any number of threads.
"""
from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.nddata import NDData, StdDevUncertainty
from astropy.table import QTable

from photutils_mgauss.psf.gridded import GriddedMixturePSF
from photutils_mgauss.simulation.bound import (
    SimulatedCatalogue,
    covariances,
    draw_table,
)
from photutils_mgauss.simulation.effects import DetectorEffects
from photutils_mgauss.simulation.exposures import Exposure
from photutils_mgauss.simulation.image import Chip, draw, expose, read
from photutils_mgauss.simulation.instrument import Instrument
from photutils_mgauss.simulation.mock_psf import csst_psf
from photutils_mgauss.simulation.renderer import renderer_of, widen
from photutils_mgauss.utils.star_columns import check_table
from photutils_mgauss.utils.validation import (
    as_floats,
    as_instance,
    as_real,
    as_rng,
    as_shape,
)
from photutils_mgauss.utils.waiting import waiting

__all__ = ['Scene', 'render_stars', 'simulate', 'simulate_catalogues',
           'simulate_epochs']

# Sources farther than this from the image are not part of its truth [pix].
_MARGIN = 64


@dataclass(frozen=True, eq=False)
class Scene:
    """
    A simulated exposure and all that is true about it.

    Attributes
    ----------
    image : (ny, nx) `~numpy.ndarray`
        Bias and dark removed, sky left in [electron].
    error : (ny, nx) `~numpy.ndarray`
        The standard deviation that a pipeline would state, from the image
        itself [electron].
    flags : (ny, nx) `~numpy.ndarray`
        What is wrong with a pixel, as bits: 1 saturated, 2 cosmic ray, 4
        hot, 8 dead, 16 bad column, 32 warm.
    truth : `~astropy.table.QTable`
        The sources on the image and close to it: ``id``, ``x``, ``y``
        [pix], ``flux`` in electrons, numbers like the image, ``mag``,
        ``inside``, and the other columns of the catalogue.
    psf : GriddedMixturePSF or `~photutils.psf.GriddedPSFModel`
        The true PSF.
    background : float
        The sky in each pixel [electron].
    exposure : Exposure
        When, where and in which band.
    instrument : Instrument
        The camera.
    wcs : `~gwcs.wcs.WCS`
        From pixels to ICRS.

    Examples
    --------
    >>> from photutils_mgauss import Instrument, simulate, sparse_field
    >>> scene = simulate(sparse_field((150, 200), rng=1), rng=2,
    ...                  instrument=Instrument(shape=(150, 200)))
    >>> scene.image.shape, scene.error.shape, scene.mask.shape
    ((150, 200), (150, 200), (150, 200))
    >>> data = scene.image - scene.background
    >>> stars = scene.truth[scene.truth['inside']]
    >>> stars['x', 'y', 'flux', 'mag'].colnames
    ['x', 'y', 'flux', 'mag']
    """

    image: np.ndarray
    error: np.ndarray
    flags: np.ndarray
    truth: QTable
    psf: GriddedMixturePSF
    background: float
    exposure: Exposure
    instrument: Instrument
    wcs: object

    def __repr__(self):
        ny, nx = self.image.shape
        return (f'<Scene: {ny} x {nx} pixels, {len(self.truth)} '
                f'source{"s" * (len(self.truth) != 1)}, '
                f'{self.exposure!r}>')

    @property
    def mask(self):
        """True where a pixel must not be used, (ny, nx)."""
        return self.flags != 0

    @property
    def time(self):
        """The middle of the exposure, TDB."""
        return self.exposure.time

    def to_nddata(self):
        """
        Return the image with its error, mask and WCS.

        Returns
        -------
        `~astropy.nddata.NDData`
            In electrons. The sky is left in.
        """
        meta = {'FILTER': self.exposure.band.name,
                'DATE-MID': self.time.utc.isot,
                'EXPTIME': self.instrument.exposure_time,
                'BACKGRND': self.background}
        return NDData(self.image, unit=u.electron, mask=self.mask,
                      uncertainty=StdDevUncertainty(self.error),
                      wcs=self.wcs, meta=meta)

    @waiting('Scene.write')
    def write(self, path, *, layout='extensions', overwrite=False):
        """
        Write the scene to files, the way a pipeline does.

        Parameters
        ----------
        path : str or `~pathlib.Path`
            The name of the image, or what the names of all begin with.
        layout : {'extensions', 'csst'}, optional
            One FITS file with the extensions SCI, ERR and DQ [electron]; or
            three with the image [electron / s], the flags (``_flg``) and the
            weights (``_wht``, the inverse variance, 0 where a pixel is bad).
        overwrite : bool, optional
            Whether to replace existing files.

        Returns
        -------
        list of `~pathlib.Path`
            The images, the truth (``_truth.ecsv``) and the WCS
            (``_wcs.asdf``); the headers have the WCS too, as TAN-SIP.

        Raises
        ------
        ValueError
            If the layout is unknown.
        FileExistsError
            If a file is there and ``overwrite`` is not set.
        """
        from photutils_mgauss.simulation.files import write_scene
        return write_scene(self, path, layout, overwrite)


def simulate(sources, exposure=None, *, instrument=None, psf=None,
             effects=None, rng, executor=None):
    """
    Take an image of stars.

    Parameters
    ----------
    sources : `~astropy.table.Table`
        Where stars are: ``x`` and ``y`` [pix], or ``ra`` and ``dec`` with
        motions as `sky_field` gives them. How bright they are: ``flux``
        [electron], or a magnitude, ``mag_g`` (or what the band is) or
        ``mag``.
    exposure : Exposure, optional
        When, where and in which band; by default `Exposure()`.
    instrument : Instrument, optional
        The camera; its ``shape`` is the size of the image.
    psf : GriddedMixturePSF or `~photutils.psf.GriddedPSFModel`, optional
        The PSF; by default the `csst_psf` of the band and detector.
    effects : DetectorEffects, optional
        The imperfections of the detector; by default it has none.
    rng : int or `~numpy.random.Generator`
        The seed of the noise.
    executor : `~concurrent.futures.Executor`, optional
        Where bands of rows are made; by default a pool of threads.

    Returns
    -------
    Scene

    Raises
    ------
    ValueError
        If a column is missing or not finite, or the shutter takes longer to
        cross the detector than half the exposure.

    Examples
    --------
    >>> from photutils_mgauss.simulation import (
    ...     Instrument, simulate, sparse_field)
    >>> stars = sparse_field((256, 256), rng=1)
    >>> scene = simulate(stars, instrument=Instrument(shape=(256, 256)),
    ...                  rng=2)
    >>> scene.image.shape
    (256, 256)
    """
    rng = as_rng(rng)
    exposure = (Exposure() if exposure is None
                else as_instance(exposure, Exposure, 'exposure'))
    instrument = _instrument(instrument)
    if psf is None:
        psf, = _each_psf(None, [exposure], instrument)
    effects = (DetectorEffects() if effects is None
               else as_instance(effects, DetectorEffects, 'effects'))
    as_real(effects.shutter, 'the shutter of effects',
            maximum=instrument.exposure_time / 2)
    psf = widen(psf, effects.charge_diffusion)
    wcs = exposure.wcs(instrument.shape, instrument.pixel_scale)
    truth = _truth(sources, exposure, instrument, wcs)
    chip = Chip(instrument, effects, exposure)
    # Photutils wants fluxes with the unit of the image, which has none.
    truth['flux'] = truth['flux'].value
    with waiting('simulate'):
        electrons, flags = expose(chip, truth, psf, rng, executor)
        image, error = read(chip, electrons, rng, executor)
    return Scene(image, error, flags, truth, psf, chip.sky, exposure,
                 instrument, wcs)


def simulate_epochs(sources, exposures, *, instrument=None, psfs=None,
                    effects=None, rng, executor=None):
    """
    Take an image of the same sources at each of several exposures.

    Parameters
    ----------
    sources : `~astropy.table.QTable`
        Sources in the sky, as `sky_field` gives them.
    exposures : sequence of Exposure
        For example those of `paper_exposures`.
    instrument, effects, executor
        As for `simulate`.
    psfs : sequence, optional
        The PSF of each exposure; by default the `csst_psf` of its band and
        detector.
    rng : int or `~numpy.random.Generator`
        The seed of the noise.

    Returns
    -------
    list of Scene

    Raises
    ------
    ValueError
        If the numbers of exposures and PSFs differ, or as for `simulate`.

    Examples
    --------
    >>> from photutils_mgauss.simulation import (
    ...     Instrument, paper_exposures, simulate_epochs, sky_field)
    >>> sources = sky_field(20, 10, size=0.25, rng=1)
    >>> scenes = simulate_epochs(sources, paper_exposures()[:3], rng=2,
    ...                          instrument=Instrument(shape=(200, 200)))
    >>> [scene.time.isot[:10] for scene in scenes]
    ['2024-12-12', '2026-05-30', '2026-08-11']
    """
    exposures = [as_instance(exposure, Exposure, 'exposures')
                 for exposure in exposures]
    instrument = _instrument(instrument)
    psfs = _each_psf(psfs, exposures, instrument)
    seeds = as_rng(rng).spawn(len(exposures))
    with waiting('simulate_epochs'):
        return [simulate(sources, exposure, instrument=instrument, psf=psf,
                         effects=effects, rng=seed, executor=executor)
                for exposure, psf, seed in zip(exposures, psfs, seeds,
                                               strict=True)]


def simulate_catalogues(sources, exposures, *, instrument=None, psfs=None,
                        threshold=5.0, rng, executor=None):
    """
    Measure sources as well as they can be, without making images.

    Positions and fluxes scatter with the Cramer-Rao bound of an isolated
    star.

    Parameters
    ----------
    sources, exposures, instrument, psfs
        As for `simulate_epochs`.
    threshold : float, optional
        Sources of a lower flux over its error are left out.
    rng : int or `~numpy.random.Generator`
        The seed of the errors.
    executor : `~concurrent.futures.Executor`, optional
        Where sources are measured; by default a pool of threads.

    Returns
    -------
    list of SimulatedCatalogue
        Only sources inside the image and below the full well.

    Raises
    ------
    ValueError
        As for `simulate_epochs`.

    Examples
    --------
    >>> from photutils_mgauss.simulation import (
    ...     Instrument, paper_exposures, simulate_catalogues, sky_field)
    >>> sources = sky_field(20, 10, size=0.25, rng=1, magnitudes=(20, 24))
    >>> catalogues = simulate_catalogues(
    ...     sources, paper_exposures()[:2], rng=2,
    ...     instrument=Instrument(shape=(300, 300)))
    >>> [len(catalogue.table) for catalogue in catalogues]
    [30, 30]
    """
    exposures = [as_instance(exposure, Exposure, 'exposures')
                 for exposure in exposures]
    instrument = _instrument(instrument)
    psfs = _each_psf(psfs, exposures, instrument)
    threshold = as_real(threshold, 'threshold', minimum=0)
    seeds = as_rng(rng).spawn(len(exposures))
    with waiting('simulate_catalogues'):
        return [_catalogue(sources, exposure, instrument, psf, threshold, seed,
                           executor)
                for exposure, psf, seed in zip(exposures, psfs, seeds,
                                               strict=True)]


def _catalogue(sources, exposure, instrument, psf, threshold, rng, executor):
    wcs = exposure.wcs(instrument.shape, instrument.pixel_scale)
    truth = _truth(sources, exposure, instrument, wcs)
    sky = instrument.sky(exposure.band)
    flux = truth['flux'].value
    peak = renderer_of(psf).peak
    truth = truth[truth['inside'] & (flux > 0)
                  & (flux * peak + sky < instrument.full_well)]
    bounds = covariances(
        psf, *(truth[name].value for name in ('x', 'y', 'flux')),
        sky + instrument.dark_level + instrument.readout_variance, executor)
    bright = truth['flux'].value >= threshold * np.sqrt(bounds[:, 2, 2])
    truth = truth[bright]
    return SimulatedCatalogue(draw_table(truth, bounds[bright], rng), truth,
                              wcs, exposure.time)


def _instrument(instrument):
    return (Instrument() if instrument is None
            else as_instance(instrument, Instrument, 'instrument'))


def _each_psf(psfs, exposures, instrument):
    """Return one PSF for each exposure."""
    if psfs is None:
        return [csst_psf(instrument.shape, exposure.band,
                         rng=exposure.detector) for exposure in exposures]
    psfs = list(psfs)
    if len(psfs) != len(exposures):
        msg = (f'psfs must have one element for each of {len(exposures)} '
               f'exposures, got {len(psfs)}')
        raise ValueError(msg)
    return psfs


def render_stars(psf, x, y, flux, shape, *, faintest=1e-3, executor=None):
    """
    Draw stars on one image, without noise.

    Parameters
    ----------
    psf : GriddedMixturePSF or `~photutils.psf.GriddedPSFModel`
        The PSF.
    x, y, flux : (n,) array_like
        Positions [pix] and fluxes. Stars may be outside the image.
    shape : int or (ny, nx) tuple of int
        The pixels of the image.
    faintest : float, optional
        A Gaussian of a star is drawn where it exceeds this, in the unit of
        the flux, and anyway down to a thousandth of its peak.
    executor : `~concurrent.futures.Executor`, optional
        Where bands of rows are drawn; by default a pool of threads. The
        result does not depend on it.

    Returns
    -------
    (ny, nx) `~numpy.ndarray`
        The image, in the unit of ``flux``.

    Raises
    ------
    ValueError
        If a value is not finite or a shape is wrong.

    Examples
    --------
    >>> from photutils_mgauss.simulation import csst_psf, render_stars
    >>> image = render_stars(csst_psf((99, 99)), [50], [40], [1000], (99, 99))
    >>> round(float(image.sum()), 2)
    999.92
    """
    x = as_floats(x, 'x', shape=(None,))
    y = as_floats(y, 'y', shape=x.shape)
    flux = as_floats(flux, 'flux', shape=x.shape)
    shape = as_shape(shape, 'shape')
    faintest = as_real(faintest, 'faintest', above=0)
    with waiting('render_stars'):
        return draw(psf, x, y, flux, shape, faintest, executor)


def _truth(sources, exposure, instrument, wcs):
    """Return the sources on the image and close to it, with positions."""
    truth = QTable(sources, copy=True)
    x, y = _positions(sources, exposure, instrument)
    truth['x'], truth['y'] = x * u.pix, y * u.pix
    if 'ra' not in truth.colnames:
        truth['ra'], truth['dec'] = wcs(x, y, with_bounding_box=False) * u.deg
    rate, mag = _brightness(sources, exposure.band, instrument)
    truth['flux'] = rate * instrument.exposure_time * u.electron
    truth['mag'] = mag * u.mag
    if 'id' not in truth.colnames:
        truth['id'] = np.arange(1, len(truth) + 1)
    ny, nx = instrument.shape
    truth['inside'] = ((x > -0.5) & (y > -0.5)
                       & (x < nx - 0.5) & (y < ny - 0.5))
    near = (np.abs(x - nx / 2) < nx / 2 + _MARGIN) & (
        np.abs(y - ny / 2) < ny / 2 + _MARGIN)
    return truth[near]


def _positions(sources, exposure, instrument):
    """Return x and y (n,) of sources that have pixels or sky positions."""
    check_table(sources, 'sources')
    if 'x' in sources.colnames and 'y' in sources.colnames:
        return [as_floats(u.Quantity(sources[name], u.pix).value, name,
                          shape=(None,)) for name in ('x', 'y')]
    return exposure.pixels(sources, instrument.shape, instrument.pixel_scale)


def _brightness(sources, band, instrument):
    """Return electrons per second and magnitude (n,) of sources."""
    for name in ('flux', f'mag_{band.name}', 'mag'):
        if name in sources.colnames:
            break
    else:
        msg = (f"sources must have a column 'flux', 'mag_{band.name}' or "
               f"'mag', got {sources.colnames}")
        raise ValueError(msg)
    if name != 'flux':
        mag = as_floats(u.Quantity(sources[name], u.mag).value, name)
        return band.rate(mag), mag
    flux = as_floats(u.Quantity(sources[name], u.electron).value, name)
    rate = flux / instrument.exposure_time
    with np.errstate(divide='ignore', invalid='ignore'):
        return rate, band.magnitude(rate)
