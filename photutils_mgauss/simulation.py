r"""
Images of stars whose truth is known.

The electrons of a pixel are drawn from the light of stars, sky and dark
current; the readout adds noise, a bias and the rounding of counts, and
saturated pixels hold a full well. What comes back is what a pipeline would
make of it: bias and dark removed, in electrons, with the sky left in.

An image is made of bands of rows, each with random numbers of its own, so
that a seed gives the same pixels with any number of threads.
"""
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import astropy.units as u
import numpy as np
from astropy.nddata import NDData, StdDevUncertainty
from astropy.table import QTable

from photutils_mgauss import _kernels
from photutils_mgauss._detector_effects import (
    SATURATED,
    DetectorEffects,
    add_cosmic_rays,
    bleed,
    pattern,
    respond,
)
from photutils_mgauss._parallel import available_cores
from photutils_mgauss._simulation_catalogues import (
    PAPER_DENSITY,
    crowded_field,
    sky_field,
    sparse_field,
)
from photutils_mgauss._simulation_instrument import (
    CSST_BANDS,
    Band,
    Instrument,
)
from photutils_mgauss._simulation_psf import csst_psf
from photutils_mgauss._simulation_sky import Exposure, paper_exposures
from photutils_mgauss._validation import as_floats, as_real, as_shape
from photutils_mgauss.gridded import GriddedMixturePSF

__all__ = ['CSST_BANDS', 'PAPER_DENSITY', 'Band', 'DetectorEffects',
           'Exposure', 'Instrument',
           'Scene', 'crowded_field', 'csst_psf', 'paper_exposures',
           'render_stars', 'simulate', 'simulate_epochs', 'sky_field',
           'sparse_field']

# Rows that share a random stream. It is part of what a seed means.
_BAND_ROWS = 128

# Gaussians are drawn where they exceed this [electron]: a thousandth of the
# noise of the faintest pixel.
_FAINTEST = 1e-3

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
        hot, 8 dead, 16 bad column.
    truth : `~astropy.table.QTable`
        The sources on the image and close to it: ``id``, ``x``, ``y``
        [pix], ``flux`` [electron], ``mag``, ``inside``, and the other
        columns of the catalogue.
    psf : GriddedMixturePSF
        The true PSF.
    background : float
        The sky in each pixel [electron].
    exposure : Exposure
        When, where and in which band.
    instrument : Instrument
        The camera.
    wcs : `~gwcs.wcs.WCS`
        From pixels to ICRS.
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
        return (f'<Scene: {ny} x {nx} pixels, {len(self.truth)} sources, '
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
    psf : GriddedMixturePSF, optional
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
        If a column is missing or not finite.

    Examples
    --------
    >>> from photutils_mgauss.simulation import (
    ...     Instrument, simulate, sparse_field)
    >>> stars = sparse_field((256, 256), rng=1)
    >>> scene = simulate(stars, instrument=Instrument(shape=(256, 256)),
    ...                  rng=2)
    >>> scene.image.shape, scene.truth['flux'].unit
    ((256, 256), Unit("electron"))
    """
    rng = np.random.default_rng(rng)
    exposure = Exposure() if exposure is None else exposure
    instrument = Instrument() if instrument is None else instrument
    if psf is None:
        psf = csst_psf(instrument.shape, exposure.band,
                       rng=exposure.detector)
    effects = DetectorEffects() if effects is None else effects
    psf = effects.widen(psf)
    wcs = exposure.wcs(instrument.shape, instrument.pixel_scale)
    truth = _truth(sources, exposure, instrument, wcs)
    chip = _Chip(instrument, effects, exposure)
    electrons, flags = _expose(chip, truth, psf, rng, executor)
    image, error = _read(chip, electrons, rng, executor)
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
    psfs : sequence of GriddedMixturePSF, optional
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
    exposures = list(exposures)
    psfs = [None] * len(exposures) if psfs is None else list(psfs)
    if len(psfs) != len(exposures):
        msg = (f'psfs must have one element for each of {len(exposures)} '
               f'exposures, got {len(psfs)}')
        raise ValueError(msg)
    seeds = np.random.default_rng(rng).spawn(len(exposures))
    return [simulate(sources, exposure, instrument=instrument, psf=psf,
                     effects=effects, rng=seed, executor=executor)
            for exposure, psf, seed in zip(exposures, psfs, seeds,
                                           strict=True)]


def render_stars(psf, x, y, flux, shape, *, faintest=1e-3, executor=None):
    """
    Draw stars on one image, without noise.

    Parameters
    ----------
    psf : GriddedMixturePSF
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
    image = np.zeros(shape)
    bands = _row_bands(shape)
    parts = _split(psf, x, y, flux, bands, faintest)
    draw = partial(_render, psf, shape[1], faintest)
    for band, part in zip(bands, _run(draw, executor, bands, parts),
                          strict=True):
        image[band] = part
    return image


def _row_bands(shape):
    """Return slices of the rows of an image."""
    ny = shape[0]
    return [slice(start, min(start + _BAND_ROWS, ny))
            for start in range(0, ny, _BAND_ROWS)]


def _run(function, executor, *columns):
    """Map a function over columns of arguments, in threads by default."""
    if executor is not None:
        yield from executor.map(function, *columns)
        return
    with ThreadPoolExecutor(available_cores()) as pool:
        yield from pool.map(function, *columns)


def _split(psf, x, y, flux, bands, faintest):
    """Yield, for each band, the stars (3, n) that may reach it."""
    # By y, so that each band finds its stars, and the sum over stars in
    # each pixel has one order.
    order = np.argsort(y, kind='stable')
    stars = np.stack([x, y, flux])[:, order]
    reach = _reach(psf._grid.rows, stars[2], faintest)
    farthest = reach.max(initial=0)
    for band in bands:
        first, last = np.searchsorted(
            stars[1], [band.start - farthest, band.stop + farthest])
        near = slice(first, last)
        distance = np.maximum(band.start - stars[1, near],
                              stars[1, near] - band.stop)
        yield stars[:, near][:, distance <= reach[near]]


def _reach(rows, flux, faintest):
    """Return how far along y a star of each flux can be drawn (n,) [pix]."""
    peak = np.abs(rows[..., 0]).max(axis=0)
    stddev = 1 / np.sqrt(rows[..., 5].min(axis=0))
    offset = np.abs(rows[..., 2]).max()
    reach = np.zeros_like(flux)
    for height, sigma in zip(peak, stddev, strict=True):
        ratio = np.maximum(np.abs(flux) * height / faintest,
                           1 / _kernels._DEPTH)
        reach = np.maximum(reach, sigma * np.sqrt(2 * np.log(ratio)))
    return reach + offset + 1


def _render(psf, width, faintest, band, stars):
    """Return the expected light (rows, width) of stars in a band of rows."""
    out = np.zeros((band.stop - band.start, width))
    grid = psf._grid
    x, y, flux = np.ascontiguousarray(stars)
    _kernels.render_image(x, y, flux, grid.rows, grid.x_grid, grid.y_grid,
                          psf.pixel_integrated, faintest, float(band.start),
                          out)
    return out


@dataclass(frozen=True, eq=False)
class _Chip:
    """A detector during an exposure."""

    instrument: Instrument
    effects: DetectorEffects
    exposure: Exposure

    @property
    def bands(self):
        """The bands of rows it is made in."""
        return _row_bands(self.instrument.shape)

    @property
    def sky(self):
        """The light of the sky in a pixel [electron]."""
        return self.instrument.sky(self.exposure.band)

    def pattern(self, band):
        """Return what is fixed about a band of rows."""
        return pattern(self.effects, self.exposure.detector, band,
                       self.instrument.shape[1])


def _expose(chip, truth, psf, rng, executor):
    """Return the electrons in each pixel, at most a full well, and flags."""
    x, y, flux = (truth[name].value for name in ('x', 'y', 'flux'))
    electrons = np.empty(chip.instrument.shape, np.float32)
    flags = np.empty(chip.instrument.shape, np.uint8)
    parts = _run(partial(_expose_band, chip, psf), executor, chip.bands,
                 _split(psf, x, y, flux, chip.bands, _FAINTEST),
                 rng.spawn(len(chip.bands)))
    for band, part in zip(chip.bands, parts, strict=True):
        electrons[band], flags[band] = part
    add_cosmic_rays(electrons, flags, chip.effects,
                    chip.instrument.exposure_time, rng)
    full_well = chip.instrument.full_well
    if chip.effects.bleeding:
        bleed(electrons, full_well)
    flags |= np.where(electrons >= full_well, SATURATED, 0).astype(np.uint8)
    np.minimum(electrons, np.float32(full_well), out=electrons)
    return electrons, flags


def _expose_band(chip, psf, band, stars, rng):
    """Return the electrons and flags of a band of rows."""
    instrument, fixed = chip.instrument, chip.pattern(band)
    expected = _render(psf, instrument.shape[1], _FAINTEST, band, stars)
    expected += chip.sky
    expected *= fixed.response
    expected += instrument.dark_level
    expected += fixed.dark * instrument.exposure_time
    return rng.poisson(expected).astype(np.float32), fixed.flags


def _read(chip, electrons, rng, executor):
    """Return the image that a pipeline makes of the electrons, and error."""
    image = np.empty(electrons.shape, np.float32)
    error = np.empty(electrons.shape, np.float32)
    parts = _run(partial(_read_band, chip), executor, chip.bands,
                 (electrons[band] for band in chip.bands),
                 rng.spawn(len(chip.bands)))
    for band, part in zip(chip.bands, parts, strict=True):
        image[band], error[band] = part
    return image, error


def _read_band(chip, band, electrons, rng):
    instrument, flat = chip.instrument, chip.pattern(band).flat
    charge = respond(electrons, chip.effects, instrument.full_well)
    noise = instrument.read_noise * rng.standard_normal(charge.shape)
    counts = np.rint((charge + noise + instrument.bias) / instrument.gain)
    level = counts * instrument.gain - instrument.bias
    variance = np.maximum(level, 0) + instrument.readout_variance
    return (level - instrument.dark_level) / flat, np.sqrt(variance) / flat


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
