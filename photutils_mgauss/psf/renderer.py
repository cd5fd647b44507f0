"""
Stars of a PSF grid drawn on an image, each as far as it can be seen.

A renderer adds stars to an image whose first pixel is the detector's (left,
bottom), and knows how far from a star it draws.
"""
from dataclasses import dataclass

import numpy as np

from photutils_mgauss import kernels
from photutils_mgauss.psf.base import PSFModel


@dataclass(frozen=True, eq=False)
class MixtureRenderer:
    """Stars made of Gaussians."""

    psf: PSFModel

    @property
    def peak(self):
        """The brightest pixel of any star of flux 1."""
        integrated = self.psf.pixel_integrated
        return max(float(m.evaluate(0, 0, pixel_integrated=integrated))
                   for m in self.psf.mixtures)

    def reach(self, flux, faintest):
        """Return how far a star of each flux is drawn (n,) [pix]."""
        rows = self.psf.grid.rows
        peak = np.abs(rows[..., 0]).max(axis=0)
        stddev = 1 / np.sqrt(rows[..., 5].min(axis=0))
        offset = np.abs(rows[..., 2]).max()
        reach = np.zeros_like(flux)
        for height, sigma in zip(peak, stddev, strict=True):
            ratio = np.maximum(np.abs(flux) * height / faintest,
                               1 / kernels.DEPTH)
            reach = np.maximum(reach, sigma * np.sqrt(2 * np.log(ratio)))
        return reach + offset + 1

    def add(self, stars, faintest, left, bottom, out):
        """Add stars (3, n), the rows x, y and flux, to out (ny, nx)."""
        x, y, flux = np.ascontiguousarray(stars)
        grid = self.psf.grid
        kernel, nodes = ((kernels.render_image, grid.rows)
                         if self.psf.interpolation == 'blend' else
                         (kernels.render_matched_image, grid.sums))
        kernel(x, y, flux, nodes, grid.x_grid, grid.y_grid,
               self.psf.pixel_integrated, float(faintest), float(left),
               float(bottom), out)

    def image(self, stars, faintest, shape, window=None):
        """
        Return the image of stars (3, n), the rows x, y and flux.

        Stars with a number that is not finite are left out. With a window
        (ny, nx), each star is drawn on so many pixels only; the middle one,
        ``(n - 1) // 2``, is the pixel nearest to the star.
        """
        stars = stars[:, np.isfinite(stars).all(axis=0)]
        image = np.zeros(shape)
        if window is None:
            self.add(stars, faintest, 0, 0, image)
            return image
        corners = np.rint(stars[1::-1]).astype(int) - (
            np.array(window)[:, None] - 1) // 2
        for k, corner in enumerate(corners.T):
            bottom, left = np.clip(corner, 0, shape)
            top, right = np.clip(corner + window, 0, shape)
            part = np.zeros((top - bottom, right - left))
            self.add(stars[:, k:k + 1], faintest, left, bottom, part)
            image[bottom:top, left:right] += part
        return image
