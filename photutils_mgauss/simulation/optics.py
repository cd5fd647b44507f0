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

# Half the side of the stamp that photons are drawn on [pix], and the fewest
# samples of light in a pixel.
PHOTON_RADIUS = 24
FINEST = 4


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

    @cached_property
    def _params(self):
        return _galsim().GSParams(maximum_fft_size=8192,
                                  folding_threshold=2.5e-3)

    @cached_property
    def _apertures(self):
        """The pupil as each wavelength samples it, the same everywhere."""
        return [_galsim().Aperture(
            self.band.diameter, lam=wavelength, oversampling=1.5,
            pad_factor=1.5, gsparams=self._params)
            for wavelength, _ in self.band.colours(self.n_wavelengths).T]

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
        params = self._params
        error = self.aberrations(x, y)
        colours = [weight * galsim.OpticalPSF(
            lam=wavelength, diam=self.band.diameter, aper=aperture,
            aberrations=list(error / wavelength), gsparams=params)
            for (wavelength, weight), aperture in zip(
                self.band.colours(self.n_wavelengths).T,
                self._apertures, strict=True)]
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
        # The light is drawn so finely that no wave is left that its samples
        # do not show.
        step = -(-FINEST // oversampling)
        half = max(radius, PHOTON_RADIUS) + 1
        with waiting('Optics.to_gridded_psf'):
            light = np.array([[self.light(
                *self._place(u, v), oversampling=step * oversampling,
                radius=half) for u in places] for v in places])
        share = _interpolation(places, nodes)
        light = np.einsum('jb,ia,bayx->jiyx', share, share, light,
                          optimize=True).reshape(-1, *light.shape[2:])
        images = np.array([_cut(
            self._through_pixels(image, step * oversampling),
            radius * step * oversampling)[::step, ::step] for image in light])
        return GriddedPSFModel(NDData(images, meta={
            'grid_xypos': [self._place(u, v) for v in nodes for u in nodes],
            'oversampling': oversampling, 'optics': self,
            'light': LightTable(step * oversampling, np.array([_cut(
                image, PHOTON_RADIUS * step * oversampling)
                for image in light], np.float32))}))

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
        variance = self.jitter**2 + self.diffusion**2
        image = self._profile(
            x, y, variance - self._sample_variance(oversampling)).drawImage(
            nx=n, ny=n, scale=self.pixel_scale / oversampling,
            method='no_pixel', dtype=float)
        return image.array

    def _sample_variance(self, oversampling):
        """Return by how much `light` is narrower than the star [arcsec^2]."""
        variance = self.jitter**2 + self.diffusion**2
        side = self.pixel_scale / oversampling
        return min(side**2 / 12, 0.99 * variance)

    def _through_pixels(self, light, oversampling):
        """Return the effective PSF that an image of light has."""
        n = len(light)
        # In turns per native pixel.
        wave = np.fft.fftfreq(n) * oversampling
        variance = (self._sample_variance(oversampling)
                    / self.pixel_scale**2)
        share = np.sinc(wave) * np.exp(-2 * variance * (np.pi * wave)**2)
        changed = np.fft.fft2(light) * share * share[:, None]
        return np.fft.ifft2(changed).real * oversampling**2

    def _place(self, u, v):
        """Return x and y [pix] of coordinates that run from -1 to 1."""
        ny, nx = self.shape
        return float((u + 1) / 2 * (nx - 1)), float((v + 1) / 2 * (ny - 1))


@dataclass(frozen=True, eq=False)
class LightTable:
    """
    The light of stars before pixels, at the nodes of a PSF.

    ``images`` (M, n, n) have the shares of photons in each sample, of which
    a pixel has ``oversampling`` along each axis.
    """

    oversampling: int
    images: np.ndarray


def _cut(image, half):
    """Return the middle of an image, so many samples to each side."""
    middle = len(image) // 2
    return image[middle - half:middle + half + 1,
                 middle - half:middle + half + 1]


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
