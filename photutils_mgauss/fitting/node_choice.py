"""How many Gaussians a grid gets where its user leaves that open."""
from dataclasses import replace

import numpy as np

from photutils_mgauss.fitting.nodes import fit_nodes
from photutils_mgauss.fitting.phases import FLUX_LIMIT

# What is tried, in this order; more Gaussians than the last are slow to find.
_NUMBERS = (3, 5, 8)


def choose(nodes, options):
    """
    Return the number of Gaussians, and the weighting, that nodes ask for.

    The first of several that keeps ``flux_phase_error`` below the limit at
    the corners and the middle of the grid, the last if none does. A PSF that
    three Gaussians describe is fitted as if three were asked for.

    Parameters
    ----------
    nodes : NodeImages
        The images.
    options : dict
        The keywords of `fit_nodes`. A ``weighting`` among them is kept.

    Returns
    -------
    n_components : int
    options : dict
        With the weighting.
    """
    probes = _probes(nodes)
    for number in _NUMBERS:
        tried = {'weighting': _weighting(nodes, number), **options}
        *_, report = fit_nodes(probes, number, **{**tried,
                                                  'progress_bar': False})
        if not (report['flux_phase_error'] > FLUX_LIMIT).any():
            break
    return number, tried


def _weighting(nodes, number):
    """Return how to weigh a fit of so many Gaussians."""
    fine = min(nodes.oversampling) >= 2
    return 'photometric' if fine and number > _NUMBERS[0] else 'uniform'


def _probes(nodes):
    """Return the nodes with an image nearest to corners and middle."""
    usable = np.flatnonzero(~nodes.blank)
    if not usable.size:
        return nodes
    places = nodes.positions[usable]
    low, high = places.min(axis=0), places.max(axis=0)
    shares = np.array([(0.5, 0.5), (0, 0), (1, 0), (0, 1), (1, 1)])
    wanted = low + shares * (high - low)
    distance = np.linalg.norm(places - wanted[:, None], axis=-1)
    index = usable[np.unique(distance.argmin(axis=1))]
    return replace(nodes, images=nodes.images[index],
                   positions=nodes.positions[index])
