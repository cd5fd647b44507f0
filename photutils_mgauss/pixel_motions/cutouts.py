"""What all images show of one star: data, model, and what is left."""
import astropy.units as u
import numpy as np
from astropy.table import QTable

from photutils_mgauss.pixel_motions.campaign import light_unit
from photutils_mgauss.psf.renderer import MixtureRenderer

# Where a Gaussian of a star ends, in units of the noise.
_FAINTEST = 1e-3


def cutout_table(campaign, solved, star, size):
    """
    Return stamps of size (ny, nx) around one star, a row for each image.

    ``data`` are without the sky of the star's fit, if there is one; NaN
    where there is no pixel. ``model`` has the light of all stars.
    """
    images = np.flatnonzero(solved.weights[star] > 0)
    table = QTable({'image': images, 'time': campaign.years[images] * u.yr})
    place = solved.pixels[star, images].reshape(-1, 2)
    table['x'], table['y'] = place.T * u.pix
    stamps = np.full((2, len(images), *size), np.nan)
    for row, k in enumerate(images):
        first = np.rint(place[row]).astype(int) - (np.array(size[::-1]) - 1
                                                   ) // 2
        stamps[0, row] = _data(campaign.joint.images[k], first, size)
        stamps[0, row] -= np.nan_to_num(solved.sky[star, k])
        stamps[1, row] = _model(campaign, solved, k, first, size)
    unit = campaign.scale * light_unit(campaign)
    for name, values in zip(('data', 'model', 'residual'), (
            *stamps, stamps[0] - stamps[1]), strict=True):
        table[name] = values * unit
    return table


def _data(image, first, size):
    """Return the pixels of a stamp, NaN for those that are not used."""
    out = np.full(size, np.nan)
    height, width = image.pixels.shape
    rows, columns = (np.arange(start, start + n) for start, n in zip(
        first[::-1], size, strict=True))
    inside = np.ix_((rows >= 0) & (rows < height),
                    (columns >= 0) & (columns < width))
    at = np.ix_(rows[inside[0].ravel()], columns[inside[1].ravel()])
    out[inside] = image.values(at)
    return out


def _model(campaign, solved, k, first, size):
    """Return the light of all stars in a stamp of image k."""
    seen = solved.weights[:, k] > 0
    stars = np.stack([*solved.pixels[seen, k].T, solved.fluxes[seen, k]])
    out = np.zeros(size)
    MixtureRenderer(campaign.epochs[k].model).add(stars, _FAINTEST, *first,
                                                  out)
    return out
