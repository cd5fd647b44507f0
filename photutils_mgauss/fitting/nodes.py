r"""
Mixtures for every node of a grid of PSF images, and how good they are.

The pixel-phase error is the shift that a star would seem to have if its
pixels were the image's and its model the mixture: the residual :math:`r` is
projected, for many places of the star within a pixel, onto flux and position,

.. math::

    \delta = (D^T D)^{-1} D^T r, \qquad
    D = F\,[P, -\partial_x P, -\partial_y P].

A shift that is the same at all phases is a matter of definition; half the
range over the phases is the error. That of the flux is the scatter over the
phases, see `photutils_mgauss.fitting.phases`.
"""
import numpy as np
from scipy.ndimage import map_coordinates, spline_filter

from photutils_mgauss.fitting.image import fit_mixture
from photutils_mgauss.fitting.kept import fit_or_recall
from photutils_mgauss.fitting.phases import FLUX_LIMIT, flux_phase_error
from photutils_mgauss.psf.grid import plain_report
from photutils_mgauss.psf.shapes import adaptive_moments
from photutils_mgauss.utils.checkpoint import Checkpoint
from photutils_mgauss.utils.parallel import available_cores
from photutils_mgauss.utils.validation import as_choice, as_integer, as_real
from photutils_mgauss.utils.waiting import progress

# Phases of the star within a pixel, along each axis.
_PHASES = 4
# Stars are rarely fitted on more than 11 x 11 pixels.
_PHASE_RADIUS = 5.5
# As many nodes are kept together, at least.
_KEPT = 32


def fit_nodes(nodes, n_components, *, radius=None, start='centre',
              executor=None, progress_bar=False, checkpoint=None, **kwargs):
    """
    Fit a mixture to every image.

    Parameters
    ----------
    nodes : NodeImages
        The images.
    n_components : int
        The number K of Gaussians.
    radius : float, optional
        Only samples this near to the peak are fitted [pix].
    start : {'centre', 'own'}, optional
        Whether all but the middle node start from the fit of that one, or
        each looks for its own start.
    executor : `~concurrent.futures.Executor`, optional
        Where to fit.
    progress_bar : bool, optional
        Whether to show one.
    checkpoint : str or path-like, optional
        A folder in which finished fits are kept, and looked for.
    **kwargs
        Further keywords of `fit_mixture`.

    Returns
    -------
    list of GaussianMixture or None
    scales : (M,) `~numpy.ndarray`
        The flux of each image; NaN where there is no mixture.
    report : `~astropy.table.QTable`
    """
    as_choice(start, 'start', ('centre', 'own'))
    as_integer(n_components, 'n_components', minimum=1)
    radius = (nodes.widest_radius() if radius is None
              else as_real(radius, 'radius', above=0) / nodes.unit)
    mask = nodes.filled_borders()
    if 'mask' in kwargs:
        mask = mask | np.asarray(kwargs.pop('mask'), bool)
    options = {'oversampling': nodes.oversampling, 'origin': nodes.centre,
               'radius': radius, **kwargs}
    images = np.where(mask, 0.0, nodes.images)
    first = _first_fit(images, mask, nodes, n_components, options, start)
    work = {'n_components': n_components, 'start': first, **options}
    store, fits = Checkpoint(checkpoint), []
    for chunk in _chunks(len(images), progress_bar, bool(store)):
        fits += fit_or_recall(store, images[chunk], mask[chunk], work,
                              executor)
    if first is not None and kwargs.get('weighting') == 'photometric':
        fits = _refitted(fits, images, mask, nodes, n_components,
                         {**options, 'executor': executor})
    report = _report(nodes, images, mask, fits, radius, executor)
    mixtures = [fit.mixture and fit.mixture.affine(nodes.unit * np.eye(2))
                if nodes.unit != 1 else fit.mixture for fit in fits]
    return mixtures, np.array([fit.flux for fit in fits]), report


def _first_fit(images, mask, nodes, n_components, options, start):
    """Return the mixture of the node nearest to the middle that has one."""
    if start == 'own' or len(images) == 1:
        return None
    middle = (nodes.positions.min(axis=0) + nodes.positions.max(axis=0)) / 2
    distance = np.hypot(*(nodes.positions - middle).T)
    distance[nodes.blank] = np.inf
    for node in np.argsort(distance)[:3]:
        fit, = fit_mixture(images[[node]], n_components, mask=mask[[node]],
                           **options)
        if fit.status.usable:
            return fit.mixture
    return None


def _refitted(fits, images, mask, nodes, n_components, options):
    """
    Return the fits, those that miss the limit of the flux from own starts.

    The start from another node may lead to another minimum.
    """
    errors = np.array([_flux_phase_error(nodes, fit, image)
                       for fit, image in zip(fits, images, strict=True)])
    poor = np.flatnonzero(errors > FLUX_LIMIT)
    if not poor.size:
        return fits
    again = fit_mixture(images[poor], n_components, mask=mask[poor],
                        **options)
    better = list(fits)
    for node, fit in zip(poor, again, strict=True):
        if _flux_phase_error(nodes, fit, images[node]) < errors[node]:
            better[node] = fit
    return better


def _chunks(n, progress_bar, kept):
    """Yield slices of nodes, under a progress bar if one is wanted."""
    size = n
    if kept:
        # The same on every machine that may go on with the work.
        size = max(_KEPT, -(-n // 40))
    elif progress_bar:
        size = max(32 * available_cores(), -(-n // 40))
    with progress(total=n, desc='Fitting nodes', shown=progress_bar) as bar:
        for i in range(0, n, size):
            yield slice(i, min(i + size, n))
            bar.update(min(size, n - i))


def _report(nodes, images, mask, fits, radius, executor):
    """Return the table of all nodes."""
    models = np.array([image - fit.residual
                       for image, fit in zip(images, fits, strict=True)])
    shape_of = {'oversampling': nodes.oversampling, 'origin': nodes.centre,
                'executor': executor}
    truth = adaptive_moments(images, mask=mask, **shape_of)
    model = adaptive_moments(models, **shape_of)
    table = plain_report(nodes.positions,
                         [fit.mixture.n_components if fit.mixture else 0
                          for fit in fits],
                         np.array([fit.flux for fit in fits]))
    table['chi2'] = [fit.chi2 for fit in fits]
    table['size_error'] = truth.relative_size_error(model)
    table['ellipticity_error'] = truth.ellipticity_error(model)
    table['e1'], table['e2'] = truth.e1, truth.e2
    table['phase_error'] = [
        _phase_error(nodes, fit, min(radius, _PHASE_RADIUS / nodes.unit))
        for fit in fits]
    table['flux_phase_error'] = [
        _flux_phase_error(nodes, fit, image)
        for fit, image in zip(fits, images, strict=True)]
    table['enclosed_flux'] = [fit.enclosed_flux for fit in fits]
    table['status'] = [int(fit.status) for fit in fits]
    table['message'] = [fit.message for fit in fits]
    return table


def _flux_phase_error(nodes, fit, image):
    """Return how much fluxes scatter over the pixel phases."""
    if fit.mixture is None:
        return np.nan
    pitch = np.array(nodes.oversampling[::-1]) / nodes.unit
    return flux_phase_error(fit.mixture.affine(nodes.unit * np.eye(2)),
                            np.where(fit.used, image, image - fit.residual),
                            pitch, np.array(nodes.centre))


def _phase_error(nodes, fit, radius):
    """Return half the range of the shift over the pixel phases [pix]."""
    if fit.mixture is None:
        return np.nan
    step = 1 / nodes.unit
    half = int(radius / step)
    grid = np.arange(-half, half + 1) * step
    phase = np.arange(_PHASES) / _PHASES * step
    x = (grid + phase[:, None])[None, :, None, :]
    y = (grid + phase[:, None])[:, None, :, None]
    x, y = (a.reshape(_PHASES**2, -1) for a in np.broadcast_arrays(x, y))
    inside = np.hypot(x, y) <= radius
    scale = np.array(nodes.oversampling[::-1])
    places = np.stack([y * scale[1] + nodes.centre[1],
                       x * scale[0] + nodes.centre[0]])
    residual = map_coordinates(spline_filter(fit.residual), places,
                               prefilter=False, mode='nearest')
    shift = _shifts(fit, x, y, np.where(inside, residual, 0), inside)
    return float(np.ptp(shift, axis=0).max() / 2 * nodes.unit)


def _shifts(fit, x, y, residual, inside):
    """Return the shifts (phases, 2) that the residuals look like."""
    design = np.concatenate([fit.mixture.evaluate(x, y)[..., None],
                             -fit.mixture.gradient(x, y)], axis=-1)
    design *= fit.flux * inside[..., None]
    normal = np.einsum('pni,pnj->pij', design, design)
    right = np.einsum('pni,pn->pi', design, residual)
    return np.linalg.solve(normal, right[..., None])[:, 1:, 0]
