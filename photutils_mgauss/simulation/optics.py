"""
A PSF field from the optics of a telescope, through GalSim where installed.

The star is imaged by a clear circular pupil, at several wavelengths of the
band that count as its response says, with aberrations that are cubic
polynomials of the position; the jitter of the telescope and the diffusion of
charge in the detector widen it.
"""
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from astropy.nddata import NDData
from numpy.polynomial import chebyshev, polynomial
from photutils.psf import GriddedPSFModel

from photutils_mgauss.simulation.instrument import Band
from photutils_mgauss.simulation.mock_psf import band_of
from photutils_mgauss.utils.validation import (
    as_integer,
    as_real,
    as_rng,
    as_shape,
)
from photutils_mgauss.utils.waiting import waiting

__doctest_requires__ = {'Optics*': ['galsim']}

# Noll's numbers of the aberrations: defocus, astigmatism, coma, trefoil and
# spherical, and how strong each is in comparison.
_NOLL = np.arange(4, 12)
_STRENGTH = np.array([1, 1, 1, 0.8, 0.8, 0.5, 0.5, 0.5])


@dataclass(frozen=True, eq=False)
class Optics:
    """
    A telescope as GalSim draws it: PSFs at any place of a detector.

    Parameters
    ----------
    shape : int or (ny, nx) tuple of int
        The pixels of the detector.
    band : str or Band, optional
        The filter.
    wavefront : float, optional
        Root mean square of the constant part of an aberration [nm].
    variation : float, optional
        The same of the coefficients of its change, up to the corners [nm].
    jitter : float, optional
        Standard deviation of the telescope's motion [arcsec].
    diffusion : float, optional
        Standard deviation of the diffusion of charge [arcsec].
    n_wavelengths : int, optional
        How many wavelengths stand for the band.
    pixel_scale : float, optional
        The side of a pixel [arcsec].
    rng : int or `~numpy.random.Generator`, optional
        The seed of the aberrations.

    Raises
    ------
    ImportError
        If galsim is not installed.
    ValueError
        If a value is out of range.

    Examples
    --------
    >>> from photutils_mgauss import Optics
    >>> optics = Optics((200, 200), 'g', n_wavelengths=1)
    >>> epsfs = optics.to_gridded_psf(2, radius=8)
    >>> epsfs.data.shape  # nodes at the corners, two samples a pixel
    (4, 65, 65)
    """

    shape: tuple
    band: Band = 'g'
    wavefront: float = field(default=24.0, kw_only=True)
    variation: float = field(default=12.0, kw_only=True)
    jitter: float = field(default=0.030, kw_only=True)
    diffusion: float = field(default=0.026, kw_only=True)
    n_wavelengths: int = field(default=4, kw_only=True)
    pixel_scale: float = field(default=0.074, kw_only=True)
    rng: int = field(default=24, kw_only=True)

    def __post_init__(self):
        _galsim()
        object.__setattr__(self, 'shape', as_shape(self.shape, 'shape'))
        object.__setattr__(self, 'band', band_of(self.band))
        for name in ('wavefront', 'variation'):
            as_real(getattr(self, name), name, minimum=0)
        for name in ('jitter', 'diffusion', 'pixel_scale'):
            as_real(getattr(self, name), name, above=0)
        as_integer(self.n_wavelengths, 'n_wavelengths', minimum=1)
        _ = self._coefficients

    @cached_property
    def _coefficients(self):
        """The polynomials of the aberrations, (8, 4, 4) [nm]."""
        rng = as_rng(self.rng)
        order = np.add(*np.indices((4, 4)))
        size = np.where(order == 0, self.wavefront,
                        self.variation / np.maximum(order, 1))
        size = np.where(order <= 3, size, 0)
        return (rng.standard_normal((8, 4, 4)) * size
                * _STRENGTH[:, None, None])

    def aberrations(self, x, y):
        """
        Return the aberrations at a place of the detector.

        Parameters
        ----------
        x, y : float
            The place [pix].

        Returns
        -------
        (12,) `~numpy.ndarray`
            Zernike coefficients in Noll's order, the first unused [nm].
        """
        ny, nx = self.shape
        u, v = 2 * x / max(nx - 1, 1) - 1, 2 * y / max(ny - 1, 1) - 1
        result = np.zeros(12)
        result[_NOLL] = [polynomial.polyval2d(u, v, c)
                         for c in self._coefficients]
        return result

    def profile(self, x, y):
        """
        Return the star at a place, before pixels.

        Parameters
        ----------
        x, y : float
            As for `aberrations`.

        Returns
        -------
        ``galsim.GSObject``
            Of unit flux, in arcseconds.
        """
        return self._profile(x, y, self.jitter**2 + self.diffusion**2)

    def _profile(self, x, y, variance):
        """Return the star, widened by a Gaussian of a variance."""
        galsim = _galsim()
        params = galsim.GSParams(maximum_fft_size=8192,
                                 folding_threshold=2.5e-3)
        error = self.aberrations(x, y)
        colours = [weight * galsim.OpticalPSF(
            lam=wavelength, diam=self.band.diameter,
            aberrations=list(error / wavelength), oversampling=1.5,
            pad_factor=1.5, gsparams=params)
            for wavelength, weight in
            self.band.colours(self.n_wavelengths).T]
        light = galsim.Sum(colours)
        blur = galsim.Gaussian(sigma=float(np.sqrt(variance)))
        return galsim.Convolve([light, blur], gsparams=params)

    def to_gridded_psf(self, n_nodes=21, *, n_samples=10, oversampling=4,
                       radius=32):
        """
        Tabulate the PSF, pixels included.

        Drawing takes a third of a second for each place. A grid of more than
        ``n_samples`` nodes along an axis is interpolated, pixel by pixel,
        with the polynomials through that many Chebyshev points.

        Parameters
        ----------
        n_nodes : int, optional
            The number of nodes along each axis. Between them the PSF is the
            blend of four.
        n_samples : int, optional
            The number of places along each axis that GalSim draws.
        oversampling : int, optional
            Samples per pixel.
        radius : int, optional
            Half the side of the stamps [pix].

        Returns
        -------
        `~photutils.psf.GriddedPSFModel`
            To be given to `simulate`. Its ``meta['optics']`` is this object,
            from which the brighter-fatter effect draws photons.

        Raises
        ------
        ValueError
            If a number is too small.
        """
        n_nodes = as_integer(n_nodes, 'n_nodes', minimum=2)
        n_samples = as_integer(n_samples, 'n_samples', minimum=2)
        oversampling = as_integer(oversampling, 'oversampling', minimum=2)
        radius = as_integer(radius, 'radius', minimum=4)
        nodes = np.linspace(-1, 1, n_nodes)
        places = chebyshev.chebpts1(min(n_samples, n_nodes))
        if n_nodes <= n_samples:
            places = nodes
        with waiting('Optics.to_gridded_psf'):
            images = np.array([[self._sample(*self._place(u, v), oversampling,
                                             radius) for u in places]
                               for v in places])
        share = _interpolation(places, nodes)
        images = np.einsum('jb,ia,bayx->jiyx', share, share, images,
                           optimize=True)
        return GriddedPSFModel(NDData(
            images.reshape(-1, *images.shape[2:]), meta={
                'grid_xypos': [self._place(u, v) for v in nodes
                               for u in nodes],
                'oversampling': oversampling, 'optics': self}))

    def light(self, x, y, *, oversampling=4, radius=24):
        """
        Draw the star at a place as photons fall on the detector.

        The image is narrower than the star by the width of a sample:
        photons that are spread evenly over their sample are as wide as the
        star.

        Parameters
        ----------
        x, y : float
            The place [pix].
        oversampling : int, optional
            Samples per pixel.
        radius : int, optional
            Half the side of the stamp [pix].

        Returns
        -------
        (n, n) `~numpy.ndarray`
            The share of photons in each sample, before any pixel; it sums
            to nearly 1.

        Examples
        --------
        >>> from photutils_mgauss import Optics
        >>> optics = Optics((200, 200), 'g', n_wavelengths=1)
        >>> optics.light(50, 50, radius=8).shape
        (65, 65)
        """
        n = 2 * radius * oversampling + 1
        side = self.pixel_scale / oversampling
        variance = self.jitter**2 + self.diffusion**2
        narrower = max(variance - side**2 / 12, variance / 100)
        image = self._profile(x, y, narrower).drawImage(
            nx=n, ny=n, scale=side, method='no_pixel', dtype=float)
        return image.array

    def _place(self, u, v):
        """Return x and y [pix] of coordinates that run from -1 to 1."""
        ny, nx = self.shape
        return float((u + 1) / 2 * (nx - 1)), float((v + 1) / 2 * (ny - 1))

    def _sample(self, x, y, oversampling, radius):
        """Return the effective PSF at a place, its sum oversampling^2."""
        galsim = _galsim()
        n = 2 * radius * oversampling + 1
        star = galsim.Convolve([self.profile(x, y),
                                galsim.Pixel(self.pixel_scale)])
        image = star.drawImage(nx=n, ny=n, method='no_pixel',
                               scale=self.pixel_scale / oversampling,
                               dtype=float)
        return image.array * oversampling**2


def _interpolation(places, nodes):
    """Return the shares (n, m) of m places in the polynomial at n nodes."""
    degree = places.size - 1
    return (chebyshev.chebvander(nodes, degree)
            @ np.linalg.inv(chebyshev.chebvander(places, degree)))


def _galsim():
    try:
        import galsim
    except ImportError as error:
        msg = ('Optics needs the package galsim (pip install galsim); '
               'csst_psf makes a PSF field without it')
        raise ImportError(msg) from error
    return galsim
