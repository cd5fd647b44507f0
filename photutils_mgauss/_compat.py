"""
Everything that depends on the version of photutils.

When photutils >= 3.1 is the oldest supported, this file can go.
"""
from weakref import WeakValueDictionary

import photutils
from astropy.utils import minversion

# Before 3.1, photutils builds one class for all groups of n stars whose model
# class has the same name, and captures the first model it meets: its state
# outside Parameters and its ``fixed`` flags serve every later model.
STALE_GROUP_MODELS = not minversion(photutils, '3.1')

_CLASSES = WeakValueDictionary()


def set_identity(model, state):
    """
    Give the model a class whose name says all that photutils may capture.

    Parameters
    ----------
    model : `~astropy.modeling.Model`
        Its class is replaced, in place, by a subclass without any content.
    state : hashable
        What is not in Parameter values. The ``fixed`` flags are added.
    """
    if not STALE_GROUP_MODELS:
        return
    public = public_class(model)
    flags = ''.join('01'[getattr(model, name).fixed]
                    for name in model.param_names)
    key = (public, state, flags)
    cls = _CLASSES.get(key)
    if cls is None:
        name = f'{public.__name__}_{state}_{int("1" + flags, 2):x}'
        members = {'__init__': public.__init__, '__call__': public.__call__,
                   '__module__': public.__module__, '_public_class': public,
                   '__doc__': public.__doc__}
        cls = _CLASSES[key] = type(public)(name, (public,), members)
    model.__class__ = cls


def public_class(model):
    """Return the class of a model as its users know it."""
    return getattr(type(model), '_public_class', type(model))
