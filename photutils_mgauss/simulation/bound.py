r"""
Catalogues at the Cramer-Rao bound, without making images.

With the expected electrons :math:`\mu_p` of pixel p and their variance
:math:`\sigma_p^2`, the covariance of x, y and flux is at best the inverse of

.. math::

    F_{ij} = \sum_p \frac{1}{\sigma_p^2}\,
    \frac{\partial \mu_p}{\partial \theta_i}\,
    \frac{\partial \mu_p}{\partial \theta_j} .
"""
from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.table import QTable
from astropy.time import Time

from photutils_mgauss.simulation.renderer import renderer_of
from photutils_mgauss.utils.parallel import map_chunks

# Half the side of the stamps, and the step of the derivatives [pix].
_HALF = 7
_STEP = 0.01


@dataclass(frozen=True, eq=False)
class SimulatedCatalogue:
    """
    What a perfect measurement of an exposure would give.

    Attributes
    ----------
    table : `~astropy.table.QTable`
        ``id``, ``x_fit``, ``x_err``, ``y_fit``, ``y_err`` [pix], ``xy_cov``
        [pix^2], ``flux_fit``, ``flux_err`` [electron] and ``flags``.
    truth : `~astropy.table.QTable`
        The sources in the rows of ``table``.
    wcs : `~gwcs.wcs.WCS`
        From pixels to ICRS.
    time : `~astropy.time.Time`
        The middle of the exposure, TDB.

    Examples
    --------
    It has what an `Epoch` is made of:

    >>> from photutils_mgauss import (
    ...     Epoch, Instrument, paper_exposures, simulate_catalogues, sky_field)
    >>> sources = sky_field(20, 10, size=0.25, rng=1, magnitudes=(20, 24))
    >>> (catalogue,) = simulate_catalogues(
    ...     sources, paper_exposures()[1:2], rng=2,
    ...     instrument=Instrument(shape=(300, 300)))
    >>> catalogue
    <SimulatedCatalogue: 30 sources at 2026.410>
    >>> Epoch(catalogue.table, catalogue.wcs, catalogue.time)
    <Epoch: 30 stars at 2026.410, gwcs WCS>
    """

    table: QTable
    truth: QTable
    wcs: object
    time: Time

    def __repr__(self):
        return (f'<SimulatedCatalogue: {len(self.table)} sources at '
                f'{self.time.jyear:.3f}>')


def covariances(psf, x, y, flux, variance, executor):
    """
    Return the bounds (n, 3, 3) of x, y and flux of isolated stars.

    ``variance`` is that of a pixel without the star [electron^2].
    """
    renderer = renderer_of(psf)

    def bounds(xs, ys, fluxes):
        return [_bound(renderer, *star, variance)
                for star in zip(xs, ys, fluxes, strict=True)]
    return np.array(map_chunks(bounds, (x, y, flux), executor,
                               chunk_size=64)).reshape(-1, 3, 3)


def _bound(renderer, x, y, flux, variance):
    star, *derivatives = _derivatives(renderer, x, y, flux)
    weight = 1 / (variance + star)
    jacobian = np.stack(derivatives)
    fisher = np.einsum('iyx,jyx,yx->ij', jacobian, jacobian, weight)
    # The units of flux and position differ by orders of magnitude.
    scale = 1 / np.sqrt(np.diag(fisher))
    return (np.linalg.inv(fisher * np.outer(scale, scale))
            * np.outer(scale, scale))


def _derivatives(renderer, x, y, flux):
    """Return the stamp of a star and its derivatives by x, y and flux."""
    h = _STEP
    moved = [(x, y), (x + h, y), (x - h, y), (x, y + h), (x, y - h)]
    star, right, left, up, down = (_stamp(renderer, *place, flux, x, y)
                                   for place in moved)
    return star, (right - left) / (2 * h), (up - down) / (2 * h), star / flux


def _stamp(renderer, x, y, flux, x_centre, y_centre):
    out = np.zeros((2 * _HALF + 1, 2 * _HALF + 1))
    renderer.add(np.array([[x], [y], [flux]]), 1e-5 * flux,
              np.rint(x_centre) - _HALF, np.rint(y_centre) - _HALF, out)
    return out


def draw_table(truth, bounds, rng):
    """Return the measured table of stars with given bounds."""
    lower = np.linalg.cholesky(bounds)
    noise = np.einsum('nij,nj->ni', lower,
                      rng.standard_normal((len(truth), 3)))
    error = np.sqrt(np.einsum('nii->ni', bounds))
    values = [truth['x'].value, truth['y'].value, truth['flux'].value]
    table = QTable({'id': truth['id']})
    for i, (name, unit) in enumerate((('x', u.pix), ('y', u.pix),
                                      ('flux', u.electron))):
        table[f'{name}_fit'] = (values[i] + noise[:, i]) * unit
        table[f'{name}_err'] = error[:, i] * unit
    table['xy_cov'] = bounds[:, 0, 1] * u.pix**2
    table['flags'] = np.zeros(len(truth), int)
    return table
