"""
Everything that depends on the version of photutils.

When photutils >= 3.1 is the oldest supported, this file can go.
"""
from copy import copy, deepcopy
from operator import attrgetter
from weakref import WeakValueDictionary

import numpy as np
import photutils
from astropy.table import Table
from astropy.utils import minversion
from photutils.psf import PSFPhotometry
from photutils.utils._deprecation import DeprecatedColumnQTable
from photutils.utils._misc import _get_meta

# Before 3.1, photutils builds one class for all groups of n stars whose model
# has the same class name in ``__class__``, and captures the first model it
# meets: its state outside Parameters and its ``fixed`` flags serve every
# later model.
STALE_GROUP_MODELS = not minversion(photutils, '3.1')

# Before 3.1, photutils takes the places (y, x) in files of STPSF for (x, y).
EXCHANGED_STPSF_NODES = not minversion(photutils, '3.1')

_CLASSES = WeakValueDictionary()


def group_class(model):
    """
    Return a class whose name says all that photutils may capture.

    It is what a model gives as its ``__class__`` where that is needed. Its
    ``type`` stays the public class, by which other packages, such as asdf,
    recognise it.

    Parameters
    ----------
    model : `~astropy.modeling.Model`
        Its ``_state`` is what is not in Parameters, and hashable.
    """
    public = type(model)
    if '_ready' not in model.__dict__:
        return public
    flags = ''.join(['01'[one.fixed] for one in
                     attrgetter(*model.param_names)(model)])
    key = (public, model._state, flags)
    cls = _CLASSES.get(key)
    if cls is None:
        cls = _CLASSES[key] = _named_subclass(public, model._state, flags)
    # Alive as long as the model, or each look would build another one.
    model.__dict__['_group_class'] = cls
    return cls


def _named_subclass(public, state, flags):
    name = f'{public.__name__}_{state}_{int("1" + flags, 2):x}'
    members = {'__init__': public.__init__, '__call__': public.__call__,
               '__module__': public.__module__, '__doc__': public.__doc__}
    return type(public)(name, (public,), members)


# Since 3.1 a star fitted outside its own pixels has a flag of its own, and
# the flag for bounds looks at all of a model's bounds.
FLAGS_FIT_REGION = minversion(photutils, '3.1')
FLAGS_MODEL_BOUNDS = minversion(photutils, '3.1')


def prepare_inputs(photometry, data, mask, error, init_params):
    """
    Let photutils check its inputs, find stars, estimate fluxes and group.

    Returns
    -------
    data, mask, error, init_params : tuple
        Without units; all None if no stars were found.
    """
    names = None
    if isinstance(init_params, Table) and 'id' in init_params.colnames:
        names = np.asarray(init_params['id'])
    if names is None or names.dtype.kind not in 'USO':
        return photometry._prepare_fit_inputs(data, mask=mask, error=error,
                                              init_params=init_params)
    # photutils makes groups of the identifiers, and groups are numbers.
    numbered = init_params.copy()
    numbered['id'] = np.arange(1, len(names) + 1)
    data, mask, error, prepared = photometry._prepare_fit_inputs(
        data, mask=mask, error=error, init_params=numbered)
    prepared['id'] = names[np.asarray(prepared['id']) - 1]
    return data, mask, error, prepared


def check_nddata(mask, error):
    """Refuse what photutils refuses beside an NDData object."""
    check = getattr(PSFPhotometry, '_check_nddata_kwargs', None)
    if check is not None:
        check(mask=mask, error=error)


# Since 3.1 photutils can fit in several threads.
HAS_THREADS = minversion(photutils, '3.1')

# What a call leaves in a PSFPhotometry object.
OF_A_CALL = ('data_unit', 'finder_results', 'init_params', 'results',
             'fit_info')


def for_one_call(photometry):
    """
    Return a copy of a PSFPhotometry object that one call may change.

    A call writes its unit and its results into the object and its parts, and
    photutils 3.0 forgets the grouper when it is given groups. The model, the
    finder and the grouper are shared.
    """
    twin = copy(photometry)
    twin._data_processor = copy(photometry._data_processor)
    twin._psf_fitter = copy(photometry._psf_fitter)
    twin.fitter = twin._psf_fitter.fitter = deepcopy(photometry.fitter)
    twin._reset_results()
    return twin


def results_table(columns, meta):
    """Return the table of results in the class that photutils uses."""
    table = DeprecatedColumnQTable(columns, meta=meta, copy=False)
    table.deprecation_map = {'npixfit': 'n_pixels_fit'}
    table._deprecation_since = '3.0'
    table._deprecation_until = '4.0'
    return table


def results_meta(photometry):
    """Return what photutils writes into the meta of its results."""
    meta = _get_meta()
    meta['psf_class'] = type(photometry).__name__
    for name in photometry._attrs:
        value = getattr(photometry, name)
        by_repr = name in ('psf_model', 'finder', 'grouper', 'fitter',
                           'local_bkg_estimator')
        meta[name] = repr(value) if by_repr and value is not None else value
    return meta


def group_members(model):
    """
    Return the PSF model of a group's stars and how many there are.

    Since 2.3 photutils fits a group as one model that lists the parameters
    of one star after those of the other. Any other model is its own only
    member.
    """
    base = getattr(model, 'base_psf_model', None)
    return (model, 1) if base is None else (base, model.n_sources)
