"""
What draws stars: mixtures on a grid, or images of effective PSFs on one.

The renderer of images does what `psf.renderer.MixtureRenderer` does.
"""
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from astropy.nddata import NDData
from photutils.psf import GriddedPSFModel
from scipy.ndimage import gaussian_filter, spline_filter

from photutils_mgauss import kernels
from photutils_mgauss.psf.gridded import GriddedMixturePSF
from photutils_mgauss.psf.renderer import MixtureRenderer


@dataclass(frozen=True, eq=False)
class ImageRenderer:
    """Stars interpolated in the ePSF images of a photutils grid."""

    psf: GriddedPSFModel

    @property
    def peak(self):
        """The brightest pixel of any star of flux 1."""
        return float(np.max(self.psf.data))

    @cached_property
    def _table(self):
        """Spline coefficients (M, ny, nx), ordered by y, then x, and axes."""
        places = np.asarray(self.psf.grid_xypos, float)
        order = np.lexsort((places[:, 0], places[:, 1]))
        images = np.asarray(self.psf.data, float)[order]
        coefficients = np.array([spline_filter(image, order=3, mode='mirror')
                                 for image in images])
        return coefficients, *(np.unique(axis) for axis in places.T)

    @property
    def _oversampling(self):
        y, x = np.broadcast_to(self.psf.oversampling, 2)
        if x != y:
            msg = (f'psf must have the same oversampling along x and y, got '
                   f'{int(x)} and {int(y)}')
            raise ValueError(msg)
        return int(x)

    @property
    def _half(self):
        """The distance from the middle to the last whole pixel [pix]."""
        ny, nx = self.psf.data.shape[1:]
        return (min(ny, nx) - 1) / 2 / self._oversampling - 1

    @cached_property
    def _profile(self):
        """The brightest sample beyond each whole distance, per flux."""
        images = np.abs(np.asarray(self.psf.data, float)).max(axis=0)
        y, x = (np.arange(n) - (n - 1) / 2 for n in images.shape)
        distance = np.hypot(y[:, None], x) / self._oversampling
        rings = [images[distance >= r].max() for r in
                 range(int(self._half) + 1)]
        return np.array(rings)

    def reach(self, flux, faintest):
        """Return how far a star of each flux is drawn (n,) [pix]."""
        # The profile falls; find the first distance it is too faint at. The
        # rings of bright stars end with the table.
        level = np.maximum(faintest / np.maximum(np.abs(flux), 1e-300),
                           kernels.DEPTH * self._profile[0] * 0.1)
        steps = np.searchsorted(-self._profile, -level)
        return np.minimum(steps + 1, int(self._half)).astype(float)

    def add(self, stars, faintest, left, bottom, out):
        """Add stars (3, n), the rows x, y and flux, to out (ny, nx)."""
        x, y, flux = np.ascontiguousarray(stars)
        table, x_grid, y_grid = self._table
        kernels.render_epsfs(x, y, flux, self.reach(flux, faintest), table,
                             x_grid, y_grid, float(self._oversampling),
                             float(left), float(bottom), out)


def renderer_of(psf):
    """Return what draws stars with a PSF."""
    return (MixtureRenderer if _is_mixture(psf) else ImageRenderer)(psf)


def _is_mixture(psf):
    """Return whether a PSF is a grid of mixtures, not one of images."""
    if isinstance(psf, GriddedMixturePSF):
        return True
    if isinstance(psf, GriddedPSFModel):
        return False
    msg = ('psf must be a GriddedMixturePSF or a GriddedPSFModel, got '
           f'{type(psf).__name__}')
    raise TypeError(msg)


def widen(psf, stddev):
    """Return a PSF convolved with a round Gaussian [pix]."""
    mixture = _is_mixture(psf)
    if stddev == 0:
        return psf
    if mixture:
        return psf.convolve(stddev**2 * np.eye(2))
    sigma = stddev * np.broadcast_to(psf.oversampling, 2)
    images = [gaussian_filter(np.asarray(image, float), sigma,
                              mode='constant') for image in psf.data]
    meta = {'grid_xypos': psf.grid_xypos, 'oversampling': psf.oversampling}
    if 'optics' in psf.meta:
        optics = psf.meta['optics']
        meta['optics'] = replace(optics, diffusion=float(np.hypot(
            optics.diffusion, stddev * optics.pixel_scale)))
        light = psf.meta['light']
        meta['light'] = replace(light, images=np.array([gaussian_filter(
            image, stddev * light.oversampling, mode='constant')
            for image in light.images]))
    return GriddedPSFModel(NDData(np.array(images), meta=meta))
