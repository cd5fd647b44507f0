"""
From stars to pixels: light, charge and readout, in bands of rows.

Each band has random numbers of its own, so that a seed gives the same pixels
with any number of threads.
"""
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from photutils_mgauss.simulation.brighter_fatter import (
    repelled,
    shoot_stars,
)
from photutils_mgauss.simulation.effects import (
    SATURATED,
    DetectorEffects,
    add_cosmic_rays,
    bleed,
    illumination,
    pattern,
    respond,
)
from photutils_mgauss.simulation.exposures import Exposure
from photutils_mgauss.simulation.instrument import Instrument
from photutils_mgauss.simulation.renderer import renderer_of
from photutils_mgauss.utils.parallel import map_parallel

# Rows that share a random stream. It is part of what a seed means.
_BAND_ROWS = 128

# Gaussians are drawn where they exceed this [electron]: a thousandth of the
# noise of the faintest pixel.
FAINTEST = 1e-3


def draw(psf, x, y, flux, shape, faintest, executor):
    """Return the light (ny, nx) of stars."""
    bands, renderer = row_bands(shape), renderer_of(psf)
    image = np.empty(shape)
    parts = map_parallel(
        partial(_render, renderer, shape[1], faintest), bands,
        _split(renderer, x, y, flux, bands, faintest), executor=executor)
    for band, part in zip(bands, parts, strict=True):
        image[band] = part
    return image


def row_bands(shape):
    """Return slices of the rows of an image."""
    ny = shape[0]
    return [slice(start, min(start + _BAND_ROWS, ny))
            for start in range(0, ny, _BAND_ROWS)]


def _split(renderer, x, y, flux, bands, faintest):
    """Yield, for each band, the stars (3, n) that may reach it."""
    # By y, so that each band finds its stars, and the sum over stars in
    # each pixel has one order.
    order = np.argsort(y, kind='stable')
    stars = np.stack([x, y, flux])[:, order]
    reach = renderer.reach(stars[2], faintest)
    farthest = reach.max(initial=0)
    for band in bands:
        first, last = np.searchsorted(
            stars[1], [band.start - farthest, band.stop + farthest])
        near = slice(first, last)
        distance = np.maximum(band.start - stars[1, near],
                              stars[1, near] - band.stop)
        yield stars[:, near][:, distance <= reach[near]]


def _render(renderer, width, faintest, band, stars):
    """Return the expected light (rows, width) of stars in a band of rows."""
    out = np.zeros((band.stop - band.start, width))
    renderer.add(stars, faintest, 0, band.start, out)
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

    @property
    def response(self):
        """The response of all pixels (ny, nx)."""
        return np.concatenate([self.pattern(band).response
                               for band in self.bands])

    def pattern(self, band):
        """Return what is fixed about a band of rows."""
        fixed = pattern(self.effects, self.exposure.detector, band,
                        self.instrument.shape[1])
        light = illumination(self.effects, self.exposure.detector,
                             self.instrument, band)
        return replace(fixed, flat=fixed.flat * light,
                       response=fixed.response * light)


def expose(chip, truth, psf, rng, executor):
    """Return the electrons in each pixel, at most a full well, and flags."""
    x, y, flux = (truth[name].value for name in ('x', 'y', 'flux'))
    renderer = renderer_of(psf)
    electrons = np.empty(chip.instrument.shape, np.float32)
    flags = np.empty(chip.instrument.shape, np.uint8)
    strength = chip.effects.brighter_fatter
    shot = repelled(x, y, flux, electrons.shape) if strength else (
        np.zeros(len(x), bool))
    stars = _split(renderer, x[~shot], y[~shot], flux[~shot], chip.bands,
                   FAINTEST)
    parts = map_parallel(partial(_expose_band, chip, renderer), chip.bands,
                         stars, rng.spawn(len(chip.bands)), executor=executor)
    for band, part in zip(chip.bands, parts, strict=True):
        electrons[band], flags[band] = part
    if strength:
        electrons += shoot_stars(psf, x[shot], y[shot], flux[shot],
                                 chip.response, strength, rng)
    add_cosmic_rays(electrons, flags, chip.effects,
                    chip.instrument.exposure_time, rng)
    full_well = chip.instrument.full_well
    if chip.effects.bleeding:
        bleed(electrons, full_well)
    flags |= np.where(electrons >= full_well, SATURATED, 0).astype(np.uint8)
    np.minimum(electrons, np.float32(full_well), out=electrons)
    return electrons, flags


def _expose_band(chip, renderer, band, stars, rng):
    """Return the electrons and flags of a band of rows."""
    instrument, fixed = chip.instrument, chip.pattern(band)
    expected = _render(renderer, instrument.shape[1], FAINTEST, band, stars)
    expected += chip.sky
    expected *= fixed.response
    expected += instrument.dark_level
    expected += fixed.dark * instrument.exposure_time
    return rng.poisson(expected).astype(np.float32), fixed.flags


def read(chip, electrons, rng, executor):
    """Return the image that a pipeline makes of the electrons, and error."""
    image = np.empty(electrons.shape, np.float32)
    error = np.empty(electrons.shape, np.float32)
    parts = map_parallel(partial(_read_band, chip), chip.bands,
                         (electrons[band] for band in chip.bands),
                         rng.spawn(len(chip.bands)), executor=executor)
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
