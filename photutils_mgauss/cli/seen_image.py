"""The image behind a catalogue, if it is still where it was."""
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from photutils_mgauss.cli.psf_files import read_psf
from photutils_mgauss.cli.star_image import Reading, read_image
from photutils_mgauss.simulation.scene import render_stars
from photutils_mgauss.utils.star_columns import column_values

# Of larger images the middle is shown: stars of the whole would be specks,
# and drawing them all takes long [pix].
_LARGEST = 800
# Stars so far outside the middle still have light in it [pix].
_MARGIN = 50


@dataclass(frozen=True, eq=False)
class SeenImage:
    """
    An image less its sky, (ny, nx), and what its stars leave of it.

    ``residual`` and ``error`` are None where the PSF is not found. ``corner``
    (x, y) is the first pixel shown of the image, and ``whole`` says whether
    that is all of it.
    """

    data: np.ndarray
    residual: np.ndarray | None
    error: np.ndarray | None
    corner: tuple
    whole: bool


def seen_image(path, table, record):
    """
    Return the image that a catalogue was measured on, or None.

    Parameters
    ----------
    path : `~pathlib.Path`
        The file of the catalogue.
    table : `~astropy.table.QTable`
        The catalogue.
    record : dict
        How it was made.

    Returns
    -------
    SeenImage or None
        None if there is no image of that name. Of a large one it is the
        middle.
    """
    exposure = record.get('exposure', {})
    file = _found(path, exposure.get('image'))
    if file is None:
        return None
    with warnings.catch_warnings():
        # Whatever is odd about the image was said when it was measured.
        warnings.simplefilter('ignore')
        try:
            image = read_image(file, Reading(ext=exposure.get('ext')))
            middle = _middle(image.data.shape)
            data = np.where(image.mask, np.nan, image.without_sky)[middle]
            error = np.broadcast_to(image.noise.total,
                                    image.data.shape)[middle]
        except (OSError, ValueError):
            return None
    corner = middle[1].start, middle[0].start
    whole = data.shape == image.data.shape
    psf = _found(path, record.get('psf'))
    if psf is None:
        return SeenImage(data, None, None, corner, whole)
    drawn = _drawn(read_psf(psf), table, data.shape, corner)
    return SeenImage(data, data - drawn, error, corner, whole)


def _middle(shape):
    """Return the slices of what is shown of an image."""
    starts = [max(0, (n - _LARGEST) // 2) for n in shape]
    return tuple(slice(start, min(n, start + _LARGEST))
                 for start, n in zip(starts, shape, strict=True))


def _drawn(psf, table, shape, corner):
    """Return the stars of a table in the part of an image at a corner."""
    stars = np.array([column_values(table, name) for name in
                      ('x_fit', 'y_fit', 'flux_fit')])
    stars[:2] -= np.reshape(corner, (2, 1))
    size = np.reshape(shape[::-1], (2, 1))
    near = np.isfinite(stars).all(axis=0)
    near[near] = np.all((stars[:2, near] > -_MARGIN)
                        & (stars[:2, near] < size + _MARGIN), axis=0)
    if any(corner):
        psf = type(psf)(list(psf.mixtures), psf.grid_xypos - corner,
                        scales=psf.scales,
                        pixel_integrated=psf.pixel_integrated)
    return render_stars(psf, *stars[:, near], shape)


def _found(path, name):
    """Return the file of a name, as it is or beside the catalogue."""
    if not isinstance(name, str):
        return None
    places = Path(path).resolve().parent / name, Path(name)
    return next((place for place in places if place.is_file()), None)
