"""Residuals as the detectors of a camera have them, in pixels."""
import astropy.units as u
import numpy as np
from astropy.table import QTable

from photutils_mgauss.motions.chips import rows_of_chips
from photutils_mgauss.motions.columns import pixels
from photutils_mgauss.sky.tangent_plane import (
    TangentPlane,
    directions,
    unit_vectors,
)
from photutils_mgauss.sky.wcs import pixel_jacobian, pixel_to_vectors


def detector_residuals(residuals, epochs):
    """
    Return where on its chip each detection is, and its residual there.

    Parameters
    ----------
    residuals : `~astropy.table.QTable`
        The table of all detections.
    epochs : list of `Epoch`
        The epochs with corrected WCS.

    Returns
    -------
    `~astropy.table.QTable`
        ``chip``, ``x_pix``, ``y_pix``, ``dx_pix`` and ``dy_pix``.
    """
    n = len(residuals)
    places, away = np.full((2, n), np.nan), np.full((2, n), np.nan)
    chips = np.full(n, '', dtype=object)
    number, rows = (np.asarray(residuals[name]) for name in ('epoch', 'row'))
    for e, epoch in enumerate(epochs):
        if epoch.is_pixels:
            own = np.flatnonzero(number == e)
            at = pixels(epoch.table)[:, rows[own]]
            places[:, own] = at
            for wcs, of_chip, name in rows_of_chips(epoch):
                some = np.flatnonzero(np.isin(rows[own], of_chip))
                which = own[some]
                chips[which] = '' if name is None else str(name)
                away[:, which] = _in_pixels(wcs, at[:, some],
                                            residuals[which])
    table = QTable({'chip': chips.astype(str)})
    for name, values in (('x_pix', places[0]), ('y_pix', places[1]),
                         ('dx_pix', away[0]), ('dy_pix', away[1])):
        table[name] = values * u.pix
    return table


def _in_pixels(wcs, at, residuals):
    """Return the residuals (2, k) in pixels."""
    away = np.stack([residuals[name].value for name in ('dra', 'ddec')])
    if wcs is None or not away.size:  # a plane whose unit is the pixel
        return away if residuals['dra'].unit == u.pix else np.nan * away
    plane = _plane_around(residuals)
    jacobian = pixel_jacobian(wcs, plane, *at)
    # Axes of the plane are turned from east and north away from its middle.
    turn = plane.local_inverse(plane.project(pixel_to_vectors(wcs, *at)))
    to_sky = np.einsum('ijn,jkn->nik', turn, jacobian)
    out = np.full(away.shape, np.nan)
    good = np.isfinite(to_sky).all(axis=(1, 2)) & np.isfinite(away).all(0)
    out[:, good] = np.linalg.solve(to_sky[good],
                                   away[:, good].T[..., None])[..., 0].T
    return out


def _plane_around(residuals):
    """Return a plane that touches the sky in the middle of detections."""
    places = unit_vectors(*(residuals[name].to_value(u.deg)
                            for name in ('ra', 'dec')))
    middle = np.nanmean(places, axis=1)
    return TangentPlane(*directions(middle / np.linalg.norm(middle)))
