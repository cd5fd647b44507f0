"""The image behind a catalogue, if it is still where it was."""
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from photutils_mgauss.cli.psf_files import read_psf
from photutils_mgauss.cli.star_image import Reading, read_image
from photutils_mgauss.simulation.scene import render_stars
from photutils_mgauss.utils.star_columns import column_values

# Larger images are not shown: their stars would be specks [pix].
_LARGEST = 800


@dataclass(frozen=True, eq=False)
class SeenImage:
    """
    An image less its sky, (ny, nx), and what its stars leave of it.

    ``residual`` and ``error`` are None where the PSF is not found.
    """

    data: np.ndarray
    residual: np.ndarray | None
    error: np.ndarray | None


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
        None if there is no image of that name, or it is too large to be shown
        whole.
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
            data = np.where(image.mask, np.nan, image.without_sky)
            error = image.noise.total
        except (OSError, ValueError):
            return None
    if max(data.shape) > _LARGEST:
        return None
    psf = _found(path, record.get('psf'))
    if psf is None:
        return SeenImage(data, None, None)
    stars = np.array([column_values(table, name) for name in
                      ('x_fit', 'y_fit', 'flux_fit')])
    drawn = render_stars(read_psf(psf), *stars[:, np.isfinite(stars).all(0)],
                         data.shape)
    return SeenImage(data, data - drawn, error)


def _found(path, name):
    """Return the file of a name, as it is or beside the catalogue."""
    if not isinstance(name, str):
        return None
    places = Path(path).resolve().parent / name, Path(name)
    return next((place for place in places if place.is_file()), None)
