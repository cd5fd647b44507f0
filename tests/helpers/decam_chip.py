"""Stars of a chip of a real survey, and fits of tabulated PSFs to them."""
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table
from scipy.interpolate import RectBivariateSpline


def find_catalogue(folder):
    """Return the file with the stars of the chip."""
    return next(Path(folder).glob('*findstars.fits'))


def decam_chip(folder):
    """Return image, error and table of the stars that an LDAC file holds."""
    rows = fits.getdata(find_catalogue(folder), 2)
    x, y = rows['X_IMAGE'] - 1.0, rows['Y_IMAGE'] - 1.0
    data = np.full((4096, 2048), np.nan)
    for vignette, x_0, y_0 in zip(rows['VIGNET'], x, y, strict=True):
        left, bottom = int(np.rint(x_0)) - 31, int(np.rint(y_0)) - 31
        y_in, x_in = np.mgrid[bottom:bottom + 63, left:left + 63]
        inside = ((x_in >= 0) & (y_in >= 0) & (x_in < 2048) & (y_in < 4096)
                  & (vignette > -1e29))
        data[y_in[inside], x_in[inside]] = vignette[inside]
    # Sky noise 9 ADU, 3.9 electrons per ADU.
    error = np.sqrt(81 + np.maximum(np.nan_to_num(data), 0) / 3.9)
    return data, error, Table({'x': x, 'y': y})


def psfex_spline(model, x, y):
    """Return the image of a `PSFExModel` at a place, as a spline."""
    image = model.image_at(x, y)
    steps = [(np.arange(n) - origin) * model.sampling for n, origin in
             zip(image.shape[::-1], model.origin, strict=True)]
    return RectBivariateSpline(steps[1], steps[0], image)


def fit_spline(spline, data, error, x, y, half=None):
    """
    Return position and reduced chi^2 of a star within 12 pixels.

    half is 0 or 1 for every other pixel, as on a chessboard.
    """
    cut = np.s_[int(np.rint(y)) - 12:int(np.rint(y)) + 13,
                int(np.rint(x)) - 12:int(np.rint(x)) + 13]
    y_in, x_in = np.mgrid[cut]
    good = np.isfinite(data[cut])
    if half is not None:
        good &= (x_in + y_in) % 2 == half
    pixels, sigma = data[cut][good], error[cut][good]
    place = np.array([x, y])
    for _ in range(8):
        offset = y_in[good] - place[1], x_in[good] - place[0]
        profile, by_y, by_x = (spline.ev(*offset, dx=dx, dy=dy) for dx, dy
                               in ((0, 0), (1, 0), (0, 1)))
        flux = (profile / sigma**2) @ pixels / np.sum((profile / sigma)**2)
        slopes = np.column_stack([profile, -flux * by_x, -flux * by_y])
        residual = (pixels - flux * profile) / sigma
        step = np.linalg.lstsq(slopes / sigma[:, None], residual)[0]
        place += np.clip(step[1:], -1, 1)
    chi2 = np.sum((residual - slopes @ step / sigma)**2) / (good.sum() - 3)
    return np.append(place, chi2)
