"""
From stars to pixels: light, charge and readout, in bands of rows.

Each band has random numbers of its own, so that a seed gives the same pixels
with any number of threads.
"""
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

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
from photutils_mgauss._simulation_instrument import Instrument
from photutils_mgauss._simulation_sky import Exposure

# Rows that share a random stream. It is part of what a seed means.
_BAND_ROWS = 128

# Gaussians are drawn where they exceed this [electron]: a thousandth of the
# noise of the faintest pixel.
FAINTEST = 1e-3


def draw(psf, x, y, flux, shape, faintest, executor):
    """Return the light (ny, nx) of stars."""
    bands = row_bands(shape)
    image = np.empty(shape)
    parts = _run(partial(_render, psf, shape[1], faintest), executor, bands,
                 _split(psf, x, y, flux, bands, faintest))
    for band, part in zip(bands, parts, strict=True):
        image[band] = part
    return image


def row_bands(shape):
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
                          psf.pixel_integrated, faintest, 0.0,
                          float(band.start), out)
    return out


@dataclass(frozen=True, eq=False)
class Chip:
    """A detector during an exposure."""

    instrument: Instrument
    effects: DetectorEffects
    exposure: Exposure

    @property
    def bands(self):
        """The bands of rows it is made in."""
        return row_bands(self.instrument.shape)

    @property
    def sky(self):
        """The light of the sky in a pixel [electron]."""
        return self.instrument.sky(self.exposure.band)

    def pattern(self, band):
        """Return what is fixed about a band of rows."""
        return pattern(self.effects, self.exposure.detector, band,
                       self.instrument.shape[1])


def expose(chip, truth, psf, rng, executor):
    """Return the electrons in each pixel, at most a full well, and flags."""
    x, y, flux = (truth[name].value for name in ('x', 'y', 'flux'))
    electrons = np.empty(chip.instrument.shape, np.float32)
    flags = np.empty(chip.instrument.shape, np.uint8)
    parts = _run(partial(_expose_band, chip, psf), executor, chip.bands,
                 _split(psf, x, y, flux, chip.bands, FAINTEST),
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
    expected = _render(psf, instrument.shape[1], FAINTEST, band, stars)
    expected += chip.sky
    expected *= fixed.response
    expected += instrument.dark_level
    expected += fixed.dark * instrument.exposure_time
    return rng.poisson(expected).astype(np.float32), fixed.flags


def read(chip, electrons, rng, executor):
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
