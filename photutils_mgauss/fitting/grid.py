"""Grids of mixtures, and reports, fitted to the PSFs of other programs."""
import warnings

import numpy as np
from astropy.utils.exceptions import AstropyUserWarning

from photutils_mgauss.fitting.node_choice import choose
from photutils_mgauss.fitting.node_images import (
    of_gridded_psf,
    of_image_psf,
    of_psfex,
)
from photutils_mgauss.fitting.nodes import fit_nodes
from photutils_mgauss.fitting.phases import FLUX_LIMIT, SHIFT_LIMIT
from photutils_mgauss.psf.grid import check_lattice, make_grid
from photutils_mgauss.utils.waiting import waiting


def fit_gridded_psf(psf, n_components, **kwargs):
    """See `GriddedMixturePSF.from_gridded_psf`."""
    return fit_node_images(of_gridded_psf(psf), n_components, **kwargs)


def fit_psfex(path, n_components, *, grid_shape, limits, contexts, **kwargs):
    """See `GriddedMixturePSF.from_psfex`."""
    nodes = of_psfex(path, grid_shape, limits=limits, contexts=contexts)
    return fit_node_images(nodes, n_components, scaled=False, **kwargs)


def fit_image_psf(psf, n_components, *, grid_xypos, **kwargs):
    """See `GriddedMixturePSF.from_image_psf`."""
    nodes = of_image_psf(psf, grid_xypos)
    return fit_node_images(nodes, n_components, **kwargs)


def fit_node_images(nodes, n_components, *, scaled=True, **kwargs):
    """
    Fit images and return the grid of their mixtures, and the report.

    The first is a `~photutils_mgauss.psf.grid.Grid`.
    """
    check_lattice(nodes.positions)
    with waiting('fit mixtures to PSF images',
                 kwargs.get('progress_bar', False)):
        if n_components is None:
            n_components, kwargs = choose(nodes, kwargs)
        mixtures, scales, report = fit_nodes(nodes, n_components, **kwargs)
    if not any(mixtures):
        msg = ('psf must have at least one image that can be fitted, but '
               f'all failed, the first: {report["message"][0]}')
        raise ValueError(msg)
    grid, order = make_grid(mixtures, nodes.positions,
                            scales if scaled else None)
    _warn_of_phases(report, n_components,
                    kwargs.get('weighting', 'uniform'))
    report = report[order]
    report['id'] = np.arange(1, len(report) + 1)
    report['bridged'] = [mixtures[i] is None for i in order]
    report['scale'] = grid.scales
    report['n_components'] = (grid.weights != 0).sum(axis=1)
    return grid, report


def _warn_of_phases(report, n_components, weighting):
    """Warn of stars that change with their place in the pixel."""
    errors, shifts = report['flux_phase_error'], report['phase_error']
    n, n_shifts = (np.count_nonzero(values > limit) for values, limit in (
        (errors, FLUX_LIMIT), (shifts, SHIFT_LIMIT)))
    if n:
        warnings.warn(
            f'fluxes measured with these mixtures of {n_components} Gaussians '
            'change with the place of a star in its pixel by up to '
            f'{100 * np.nanmax(errors):.1f} % rms, by more than '
            f'{100 * FLUX_LIMIT:.1f} % at {n} of {len(report)} nodes (column '
            'flux_phase_error of the report); '
            f'{_remedy(weighting, "photometric")}', AstropyUserWarning,
            stacklevel=5)
    if n_shifts:
        warnings.warn(
            'positions measured with these mixtures change with the place of '
            f'a star in its pixel by up to {np.nanmax(shifts):.4f} pix, by '
            f'more than {SHIFT_LIMIT} pix at {n_shifts} of {len(report)} '
            'nodes (column phase_error of the report), which the errors of '
            f'stars do not include; {_remedy(weighting, "astrometric")}',
            AstropyUserWarning, stacklevel=5)


def _remedy(weighting, best):
    """Return what makes an error smaller that a weighting is best for."""
    if weighting == best:
        return 'more Gaussians make this smaller'
    # Each of the two weightings makes the other's errors larger.
    cost = {'photometric': ' (which is worse for fluxes)',
            'astrometric': ' (which is worse for positions)'}
    return (f'more Gaussians or weighting={best!r}{cost.get(weighting, "")} '
            'make this smaller')
