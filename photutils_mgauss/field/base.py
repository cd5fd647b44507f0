"""What all fields have in common, and the tables they report."""
import warnings

import numpy as np
from astropy.stats import gaussian_sigma_to_fwhm
from astropy.table import QTable
from astropy.utils.exceptions import AstropyUserWarning
from scipy.optimize import brentq

from photutils_mgauss.field.normal import model_stamps, to_vector
from photutils_mgauss.psf.shapes import adaptive_moments
from photutils_mgauss.utils.equality import ComparedByValue
from photutils_mgauss.utils.image import with_unit
from photutils_mgauss.utils.notebook import with_picture
from photutils_mgauss.utils.star_columns import words_column
from photutils_mgauss.utils.validation import as_real

# The radius with half of the light of a Gaussian [standard deviations].
_HALF_LIGHT = np.sqrt(2 * np.log(2))


class Field(ComparedByValue):
    """A PSF that varies over a detector; ``mixture_at`` gives it."""

    def _described(self, details=''):
        """Return the text of ``repr``; details stand before the degree."""
        used = int(np.count_nonzero(self.stars['used']))
        pixel = ', pixel_integrated=True' if self.pixel_integrated else ''
        return (f'<{type(self).__name__}({details}degree={self.degree}, '
                f'shape={self.shape}, {used} of {len(self.stars)} stars'
                f'{pixel})>')

    @property
    def centre(self):
        """What the origin of the mixtures is: 'core' or 'flux'."""
        return 'flux' if np.isinf(self.centre_stddev) else 'core'

    @property
    def degree(self):
        """The degree of the polynomials."""
        return int(np.sqrt(2 * len(self.coefficients))) - 1

    def enclosed_flux(self, x, y):
        """
        Return the share of the PSF's flux inside the fitted circle.

        Parameters
        ----------
        x, y : float
            The position [pix].

        Returns
        -------
        float
        """
        return self.mixture_at(x, y).encircled_energy(self.radius)

    def aperture_correction(self, radius, x, y):
        """
        Return the factor from the flux in an aperture to that of the PSF.

        Beyond ``self.radius`` the wings are those of the Gaussians, which no
        pixel has confirmed, unless the field was fitted with
        ``normalise='curve-of-growth'``.

        Parameters
        ----------
        radius : float
            The radius of the aperture [pix].
        x, y : float
            The position [pix].

        Returns
        -------
        float

        Raises
        ------
        TypeError, ValueError
            If the radius is not a positive number.
        """
        radius = as_real(radius, 'radius', above=0)
        return 1 / self.mixture_at(x, y).encircled_energy(radius)

    def plot(self, quantity='size', *, n=20, ax=None):
        """
        Draw how the PSF varies over the detector.

        Parameters
        ----------
        quantity : {'size', 'ellipticity', 'residual'}, optional
            See `photutils_mgauss.plotting.plot_field`.
        n : int, optional
            The number of places along the longer side.
        ax : `~matplotlib.axes.Axes`, optional
            Where to draw; None is pyplot's current Axes.

        Returns
        -------
        `~matplotlib.axes.Axes`
        """
        from photutils_mgauss.plotting.field import plot_field
        return plot_field(self, quantity, n=n, ax=ax)

    def _repr_html_(self):
        return with_picture(repr(self), lambda ax: self.plot(ax=ax))


def nodes(n, size):
    """Return the places of n nodes along an axis of the detector."""
    return np.linspace(0, size - 1, n) if n > 1 else np.array([(size - 1) / 2])


def lattice(grid_shape, shape):
    """Return x and y of the nodes of a grid over the detector, row by row."""
    rows, columns = grid_shape
    return (grid.ravel() for grid in np.meshgrid(
        nodes(columns, shape[1]), nodes(rows, shape[0])))


def covariance_of(fit):
    """Return the covariance of the fitted coefficients."""
    return np.linalg.inv(fit.equations.matrix
                         + np.diag(to_vector(fit.prior.precision)))


def residual_stars(fit):
    """Return data minus model of each star, NaN where nothing was used."""
    residual = fit.problem.stamps.data - model_stamps(fit.problem,
                                                      fit.coefficients)
    residual[fit.problem.weights == 0] = np.nan
    return residual


def star_table(fit, sample, centre_stddev):
    """Return the table of the stars that were fitted."""
    problem = fit.problem
    n_pixels = (problem.weights > 0).sum(axis=(1, 2))
    table = QTable()
    table['id'] = sample.row + 1
    if len(sample.reasons) > 1:
        table['exposure'] = sample.exposure
        table['star'] = sample.star + 1
    table['x'], table['y'] = sample.expected()
    table['x_fit'], table['y_fit'], flux = _own_numbers(
        fit, centre_stddev).T
    table['flux_fit'] = with_unit(flux, sample.unit)
    table['local_bkg'] = with_unit(problem.sky, sample.unit)
    growth = sample.growth[sample.exposure]
    table['reduced_chi2'] = (growth * fit.equations.chi2
                             / np.maximum(n_pixels - 3, 1))
    table['n_pixels_fit'] = n_pixels
    table['n_pixels_rejected'] = fit.deviant_pixels.sum(axis=(1, 2))
    table['used'] = problem.used
    table['reason'] = words_column([
        sample.reasons[e][i] for e, i in zip(sample.exposure, sample.row,
                                             strict=True)])
    return table


def _own_numbers(fit, centre_stddev):
    """Return x, y and flux of the stars, whose PSF is that of the result."""
    problem = fit.problem
    own = problem.sources[:, 0].copy()
    shapes, sign = problem.form.shapes(fit.coefficients, problem.basis,
                                       problem.local)
    own[:, :2] -= problem.form.shifts(shapes, sign, problem.local,
                                      centre_stddev)
    if fit.coefficients.ndim == 3:
        # The flux of a star is that of weights that sum to 1.
        own[:, 2] *= np.exp(shapes[..., 0]).sum(axis=1)
    return own


def core_width(mixture):
    """
    Return the full width at half maximum of a mixture's core [pix].

    That of its adaptive moments or, where a core has none, of the Gaussian
    with half of its light inside the same circle.
    """
    shapes = adaptive_moments(mixture)
    size = np.sqrt(shapes.r2 / 2)
    if not np.isfinite(size):
        warnings.warn(
            'the core of the PSF in the middle of the detector has no size '
            f'({shapes.message}): the weight under which it is centred is as '
            'large as the circle with half of the light', AstropyUserWarning,
            stacklevel=4)
        size = _half_light_radius(mixture) / _HALF_LIGHT
    return float(size * gaussian_sigma_to_fwhm)


def _half_light_radius(mixture):
    """Return the radius of the circle with half of the light [pix]."""
    longest = np.sqrt(np.trace(mixture.covariances, axis1=1, axis2=2))
    far = np.hypot(*mixture.means.T).max() + 5 * longest.max()
    return brentq(lambda r: mixture.encircled_energy(r) - 0.5, 0, far)
