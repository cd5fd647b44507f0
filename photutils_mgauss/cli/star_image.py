"""
Images of stars from files, ready to be measured.

An image needs the noise of its pixels. Where its file does not have it, it
follows from sky, readout and gain (Eq. 10 of Nie et al.).
"""
import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from astropy.utils.exceptions import AstropyUserWarning
from photutils.background import Background2D
from photutils.utils import calc_total_error
from scipy.ndimage import label

from photutils_mgauss.files.image_header import (
    electrons_in_unit,
    is_surface_brightness,
)
from photutils_mgauss.files.image_layers import read_layers, read_wcs
from photutils_mgauss.photometry.noise import background_error, pixel_error
from photutils_mgauss.sky.observers import julian_years
from photutils_mgauss.utils.image import PixelData
from photutils_mgauss.utils.saturation import without_saturated

# The sky is not measured in boxes with a larger share of bad pixels [%].
_BAD_SHARE = 50.0
# So many pixels side by side, and not more than this share of an image, do
# not have its highest value by chance.
_FEW, _MOST = 4, 0.05


@dataclass(frozen=True)
class Reading:
    """
    How an image is to be read; what is None is left to its files.

    ``ext``, ``error_ext`` and ``flags_ext`` are extensions; ``error``,
    ``weight``, ``flags`` and ``wcs`` are files beside the image.
    ``good_bits`` are the bits of the flags that do not make a pixel bad,
    ``gain`` the electrons in a count (or in a unit that is no count),
    ``read_noise`` in electrons, ``exposure_time`` in seconds, ``saturation``
    in the image's unit, ``time`` the middle of the exposure, ``time_key`` a
    keyword that has it, ``sky_box`` the side of the boxes of the sky in
    pixels.
    """

    ext: str | None = None
    error_ext: str | None = None
    flags_ext: str | None = None
    error: str | None = None
    weight: str | None = None
    flags: str | None = None
    wcs: str | None = None
    good_bits: int | None = None
    gain: float | None = None
    read_noise: float | None = None
    exposure_time: float | None = None
    saturation: float | None = None
    time: object = None
    time_key: str | None = None
    sky_box: int = 128


@dataclass(frozen=True, eq=False)
class Noise:
    """
    The noise of the pixels of an image, (ny, nx).

    ``total`` is that of an image with its stars. If ``gain``, electrons per
    unit, is not None, ``background`` is the noise without the light of the
    stars; otherwise it is the same as ``total``.
    """

    total: np.ndarray
    background: np.ndarray
    gain: float | None


class StarImage:
    """
    An image of stars and all that its files say of it.

    Parameters
    ----------
    path : `~pathlib.Path`
        Its file.
    layers : `~photutils_mgauss.files.image_layers.Layers`
        The arrays.
    reading : `Reading`
        What the user says of them.
    """

    def __init__(self, path, layers, reading):
        self.path = Path(path)
        self.layers = layers
        self.reading = reading
        self.mask = layers.mask(reading.good_bits)
        if self.mask.all():
            msg = f'{path}: must have pixels that are not bad, got none'
            raise ValueError(msg)

    @property
    def data(self):
        """The values with the sky in them, (ny, nx)."""
        return self.layers.data

    @property
    def unit(self):
        """The unit of the values, or None."""
        return self.layers.cards.unit

    @property
    def content(self):
        """What a measurement depends on, besides its options."""
        return [self.data, self.layers.error, self.mask, self.electrons,
                self.saturation]

    @cached_property
    def wcs(self):
        """The WCS, or None."""
        if self.reading.wcs is not None:
            return read_wcs(self.reading.wcs)
        return self.layers.wcs

    @property
    def time(self):
        """The middle of the exposure, or None."""
        if self.reading.time is not None:
            return self.reading.time
        if self.reading.time_key is not None:
            return self.layers.cards.time_at(self.reading.time_key)
        return self.layers.cards.time

    @property
    def saturation(self):
        """The level of saturated pixels, or None."""
        return self._saturation[0]

    @cached_property
    def _saturation(self):
        """The level of saturated pixels, and what says so."""
        if self.reading.saturation is not None:
            return self.reading.saturation, '--saturation says'
        level, largest = self.layers.cards.saturation, self.layers.largest
        if (largest is not None and (level is None or level > largest)
                and np.any(self.data[~self.mask] >= largest)):
            return largest, (f'the numbers of {self.layers.bits} bits in the '
                             'file say')
        return level, 'the header says'

    @property
    def saturation_without_sky(self):
        """The same without the median of the sky, or None."""
        if self.saturation is None:
            return None
        level = self.saturation - float(self.sky.background_median)
        return level if level > 0 else None

    @cached_property
    def useless(self):
        """Which pixels are bad or next to saturated ones, (ny, nx)."""
        return without_saturated(PixelData(self.data, None, self.mask),
                                 self.saturation).mask

    def say_saturation(self):
        """Return a sentence on what is saturated."""
        level, source = self._saturation
        n = int(np.count_nonzero(self.data >= level))
        return (f'pixels from {level:g} on are saturated, as {source}: {n} '
                'of them')

    def warn_of_flat_tops(self):
        """Warn of pixels that look saturated, if no level says so."""
        data = np.where(self.mask, -np.inf, self.data)
        highest = data.max()
        top = data == highest
        n = np.count_nonzero(top)
        if (not _FEW <= n <= _MOST * top.size
                or (self.saturation or np.inf) <= highest):
            return
        clumps, _ = label(top, np.ones((3, 3)))
        if np.bincount(clumps[top]).max() >= _FEW:
            warnings.warn(
                f'{self.path}: {n} pixels share the highest value, '
                f'{highest:.8g}, some side by side; if they are saturated, '
                f'give --saturation {highest:.8g}', AstropyUserWarning,
                stacklevel=3)

    def _or_header(self, name):
        own = getattr(self.reading, name)
        return getattr(self.layers.cards, name) if own is None else own

    @cached_property
    def sky(self):
        """The `~photutils.background.Background2D` of the image."""
        ny, nx = self.data.shape
        box = min(self.reading.sky_box, ny, nx)
        try:
            return Background2D(np.where(self.mask, 0, self.data), box,
                                mask=self.mask, exclude_percentile=_BAD_SHARE)
        except ValueError as error:
            msg = (f'{self.path}: must have a box of {box} x {box} pixels '
                   f'with {_BAD_SHARE:g} % good ones to measure the sky in; '
                   'choose another --sky-box')
            raise ValueError(msg) from error

    @cached_property
    def without_sky(self):
        """The values less the sky, 0 at bad pixels, (ny, nx)."""
        values = self.data - self.sky.background
        level = self.saturation_without_sky
        if level is not None:
            # Full pixels stay full where the sky is brighter than elsewhere.
            full = self.data >= self.saturation
            values[full] = np.maximum(values[full], level)
        return np.where(self.mask, 0, values)

    @property
    def electrons(self):
        """The electrons in a unit of the image, or None."""
        # A gain of the user's is in the unit of an image that has no counts.
        conversion = (None if self.reading.gain is not None
                      else self.layers.cards.conversion)
        known = electrons_in_unit(self.unit, self._or_header('gain'),
                                  self._or_header('exposure_time'),
                                  conversion)
        return self.reading.gain if known is None else known

    @cached_property
    def noise(self):
        """The `Noise`, from the file or from sky, readout and gain."""
        if self.layers.error is not None:
            return Noise(self.layers.error, self.layers.error, None)
        electrons = self.electrons
        if electrons is None:
            raise ValueError(self._no_noise())
        level = self.sky.background + self.layers.cards.removed_sky
        read_noise = self._or_header('read_noise')
        light = self.without_sky
        # A sky that is not positive was taken away by somebody before.
        if read_noise is None or np.median(level) <= 0:
            background = np.array(self.sky.background_rms)
            total = calc_total_error(light, background, electrons)
            return Noise(total, background, electrons)
        known = {'sky': np.maximum(level, 0), 'read_noise': read_noise,
                 'gain': electrons}
        return Noise(pixel_error(light, **known), background_error(**known),
                     electrons)

    def _no_noise(self):
        unit = 'no unit' if self.unit is None else f'the unit {self.unit}'
        header = (
            '; or the keywords GAIN [electron/DN], EXPTIME [s] and PHOTMJSR '
            'or FLUXCONV [MJy/sr per DN/s], whose GAIN * EXPTIME / PHOTMJSR '
            'is that number of electrons'
            if is_surface_brightness(self.unit) else '')
        problem = self.layers.cards.gain_problem
        problem = problem and f'; {problem}'
        return (f'{self.path}: the noise must be known; it has neither an '
                f'extension ERR nor a file beside it, and for an image with '
                f'{unit} it takes --gain (electrons in a count or unit) and, '
                f'for rates, --exposure-time{header}{problem}')

    def check(self):
        """Raise if the image lacks what it takes to measure it."""
        if self.layers.error is None and self.electrons is None:
            raise ValueError(self._no_noise())
        self.wcs, self.time  # noqa: B018 whether they can be read

    def describe(self):
        """Return a sentence on what was read."""
        ny, nx = self.data.shape
        places = [f'{what} {where}'
                  for what, where in self.layers.sources.items()]
        if self.layers.error is None:
            places.append(self._say_noise())
        words = [f'{nx} x {ny} pixels', ', '.join(places),
                 f'{self.mask.mean():.1%} bad']
        words.append('no WCS' if self.wcs is None else
                     f'{type(self.wcs).__module__.split(".")[0]} WCS')
        words.append('no time' if self.time is None else
                     f'{julian_years(self.time):.3f}{self._say_day()}')
        return f'{self.path}: {"; ".join(words)}'

    def _say_noise(self):
        known = self._or_header('read_noise')
        if known is not None:
            return f'error from sky, gain and a read noise of {known:g} e'
        problem = self.layers.cards.read_noise_problem
        return ("error from gain and the sky's scatter, which holds the read "
                'noise' + (f' ({problem})' if problem else ''))

    def _say_day(self):
        known = (self.reading.time is not None
                 or self.reading.time_key is not None)
        return ('' if known or not self.layers.cards.has_only_a_day
                else ' (a date without time of day)')


def read_image(path, reading=None):
    """
    Read an image of stars.

    Parameters
    ----------
    path : str or path-like
        FITS with one or several extensions, those of JWST and HST, ASDF like
        Roman's, and images with files for errors and flags beside them.
    reading : `Reading`, optional
        What the files do not say, or should not decide.

    Returns
    -------
    StarImage

    Raises
    ------
    OSError, ValueError
        If a file cannot be read, or what it holds is no image.
    """
    reading = Reading() if reading is None else reading
    beside = {kind: getattr(reading, kind)
              for kind in ('error', 'weight', 'flags')}
    layers = read_layers(path, ext=reading.ext, error_ext=reading.error_ext,
                         flags_ext=reading.flags_ext, beside=beside)
    image = StarImage(path, layers, reading)
    image.warn_of_flat_tops()
    return image
