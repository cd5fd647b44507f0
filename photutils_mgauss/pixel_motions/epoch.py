"""One image of an epoch: its pixels, PSF and WCS, when and from where."""
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from astropy.coordinates import CartesianRepresentation

from photutils_mgauss.photometry.many_images import fixed_psf
from photutils_mgauss.sky.observers import (
    _known_observer,
    julian_years,
    observer_velocity,
)
from photutils_mgauss.sky.wcs import check_celestial
from photutils_mgauss.utils.image import read_pixels


@dataclass(frozen=True, eq=False)
class ImageEpoch:
    """
    One image for `PixelMotionFitter`, with its PSF, WCS and time.

    Parameters
    ----------
    data : (ny, nx) array_like or `~astropy.nddata.NDData`
        The pixels, in any form that :ref:`pixels` lists. You need not
        subtract a smooth background.
    psf : GriddedMixturePSF, MultiGaussianPSFModel or MixtureField
        The PSF of this image.
    wcs : APE 14 WCS
        A gwcs or `astropy.wcs.WCS` with celestial axes, from a
        `MotionSolution` of the brighter stars, so that the images are
        aligned.
    time : `~astropy.time.Time` or float
        Middle of the exposure; numbers are Julian years (TDB).
    error : array_like, optional
        Standard deviations of the pixels. Without them one number is
        estimated for the image, and errors are scaled by the residuals.
    mask : (ny, nx) array_like of bool, optional
        True for pixels to leave out.
    band : str, optional
        The filter, for fluxes that all images of a band share.
    observer : str or `~astropy.coordinates.CartesianRepresentation`, optional
        The place of the observer, as for `Epoch`.

    Raises
    ------
    TypeError, ValueError
        If an argument is not valid.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.wcs import WCS
    >>> from photutils_mgauss import csst_psf, ImageEpoch
    >>> wcs = WCS(naxis=2)
    >>> wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    >>> wcs.wcs.cdelt = -2e-5, 2e-5
    >>> noise = np.random.default_rng(1).normal(size=(60, 80))
    >>> ImageEpoch(noise, csst_psf((60, 80)), wcs, 2026.5, error=1, band='g')
    <ImageEpoch: 60 x 80 pixels at 2026.500, band g>
    """

    data: object
    psf: object
    wcs: object
    time: object
    error: object = field(default=None, kw_only=True)
    mask: object = field(default=None, kw_only=True)
    band: str = field(default=None, kw_only=True)
    observer: object = field(default=None, kw_only=True)

    def __post_init__(self):
        check_celestial(self.wcs)
        if self.observer is not None and not isinstance(
                self.observer, CartesianRepresentation):
            _known_observer(self.observer)
        years = julian_years(self.time)
        if years.ndim or not np.isfinite(years):
            msg = f'time must be one finite time, got {self.time!r:.80}'
            raise ValueError(msg)
        if not (self.band is None or isinstance(self.band, str)):
            msg = f'band must be a name, got {self.band!r:.80}'
            raise TypeError(msg)
        # What is wrong is said here, not when it is used.
        _ = self.pixels, self.model

    def __repr__(self):
        ny, nx = self.pixels.shape
        band = '' if self.band is None else f', band {self.band}'
        return (f'<ImageEpoch: {ny} x {nx} pixels at {self.year:.3f}{band}>')

    @cached_property
    def pixels(self):
        """The `~photutils_mgauss.utils.image.PixelData`."""
        return read_pixels(self.data, self.error, self.mask, broadcast=True)

    @cached_property
    def model(self):
        """The PSF as a model; fields are sampled on a grid."""
        return fixed_psf(self.psf)

    @property
    def year(self):
        """The Julian year (TDB)."""
        return float(julian_years(self.time))

    @property
    def velocity(self):
        """The velocity of the observer (3,) in units of light, or None."""
        return observer_velocity(self.observer)
