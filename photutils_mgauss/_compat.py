"""
Everything that depends on the version of photutils.

When photutils >= 3.1 is the oldest supported, this file can go.
"""
from weakref import WeakValueDictionary

import photutils
from astropy.utils import minversion

# Before 3.1, photutils builds one class for all groups of n stars whose model
# has the same class name in ``__class__``, and captures the first model it
# meets: its state outside Parameters and its ``fixed`` flags serve every
# later model.
STALE_GROUP_MODELS = not minversion(photutils, '3.1')

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
    flags = ''.join('01'[getattr(model, name).fixed]
                    for name in model.param_names)
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
