"""
The pixels of boxes, taken out of images as their users hold them.

A joint fit looks at the boxes of its stars, many times. They are put into
units of the noise when they are taken out, so that an image itself is never
copied, whatever its numbers are: with a few groups at a time, the memory of
a fit is that of its stars.
"""
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from photutils_mgauss import kernels
from photutils_mgauss.photometry.engine import kernel_image
from photutils_mgauss.utils.image import PixelData


@dataclass(frozen=True, eq=False)
class ScaledImage:
    """
    An image as it is, and the unit of light in which a fit sees it.

    Attributes
    ----------
    pixels : `~photutils_mgauss.utils.image.PixelData`
        Without errors all pixels have that of 1 in the fit.
    unit : float
        The light, in the unit of the pixels, that counts as 1.
    light : (ny, nx) `~numpy.ndarray`, optional
        What the fit does not see of the image, in its unit.
    """

    pixels: PixelData
    unit: float
    light: np.ndarray | None = None

    def whole(self):
        """Return a copy of all pixels as kernels take it; ``light`` stays."""
        pixels = self.pixels
        data, error = pixels.data / self.unit, pixels.error
        if error is not None:
            data[~((error > 0) & np.isfinite(error))] = np.nan
            error = error / self.unit
        return kernel_image(data, error, pixels.mask)

    def values(self, at):
        """Return the pixels at an index, NaN for those that are not used."""
        values = np.asarray(self.pixels.data[at], float) / self.unit
        values[~np.isfinite(values)] = np.nan
        if self.pixels.mask is not None:
            values[self.pixels.mask[at]] = np.nan
        return values

    def groups(self, boxes, own, psf):
        """
        Return the pixels of groups of boxes.

        Parameters
        ----------
        boxes : (g, m, 4) `~numpy.ndarray` of int
            See `~photutils_mgauss.photometry.engine.cut_boxes`.
        own : (g, m, 3) `~numpy.ndarray` or None
            Flux, x and y of stars to add to the image.
        psf : tuple
            That of those stars.

        Returns
        -------
        `~photutils_mgauss.kernels.GroupPixels`
            Pixels whose error is not positive and finite are not used.
        """
        n, m = boxes.shape[:2]
        flat, pixels = boxes.reshape(-1, 4), self.pixels
        data = _taken(pixels.data, flat)
        if pixels.mask is not None:
            data[_taken(pixels.mask, flat) > 0] = np.nan
        error = (np.full(data.shape, self.unit) if pixels.error is None
                 else _taken(pixels.error, flat))
        light = (np.empty((0, 0, 0)) if self.light is None
                 else _taken(self.light, flat).reshape(n, m, -1))
        out = kernels.GroupPixels(
            boxes, data.reshape(n, m, -1), error.reshape(n, m, -1),
            np.zeros(n), np.zeros(n, np.int64))
        kernels.weigh_groups(
            out, light, self.unit, np.empty((0, m, 3)) if own is None else
            own, psf, kernels.BoxScratch.empty(m, flat).around)
        return out


def _taken(image, boxes):
    """Return the pixels (n, area) of boxes (n, 4), column after column."""
    sizes = boxes[:, 2] * boxes[:, 3]
    out = np.zeros((len(boxes), int(sizes.max(initial=1))))
    # Few shapes: boxes are cut short at edges only.
    key = np.where(sizes > 0, boxes[:, 2] * (1 + sizes.max(initial=0))
                   + boxes[:, 3], 0)
    for one in np.unique(key[key > 0]):
        rows = np.flatnonzero(key == one)
        row, column, (height, width) = (*boxes[rows, :2].T, boxes[rows[0], 2:])
        # Whole boxes at a time, in any order and of any numbers.
        found = sliding_window_view(image, (height, width))[row, column]
        out[rows, :height * width] = found.swapaxes(1, 2).reshape(
            len(rows), -1)
    return out
