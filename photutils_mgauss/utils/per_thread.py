"""
What an object keeps of its last call, for each thread that calls it.

An object that several threads call shows each of them what came out of its
own last call; a thread that has not called it sees the last call of any.
"""
import threading
from weakref import WeakKeyDictionary

_OWN = threading.local()


def _own_values(instance):
    """Return what this thread has kept of an object."""
    if not hasattr(_OWN, 'values'):
        _OWN.values = WeakKeyDictionary()
    return _OWN.values.setdefault(instance, {})


class PerThread:
    """
    An attribute of which each thread sees its own value.

    What is set in the usual way is seen by all threads that keep none of
    their own; `keep` is for what comes out of a call. Copies and pickles of
    an object take the last value of any thread.

    Parameters
    ----------
    words : str
        What the attribute is, its docstring.
    """

    def __init__(self, words):
        self.__doc__ = words

    def __set_name__(self, owner, name):
        self._name = name

    def __get__(self, instance, owner=None):
        if instance is None:
            return self
        own = _own_values(instance)
        try:
            return own[self._name] if self._name in own else (
                instance.__dict__[self._name])
        except KeyError:
            msg = (f'{type(instance).__name__!r} object has no attribute '
                   f'{self._name!r}')
            raise AttributeError(msg) from None

    def __set__(self, instance, value):
        _own_values(instance).pop(self._name, None)
        instance.__dict__[self._name] = value


def keep(instance, **values):
    """Keep what came out of a call of this thread, and as the last one."""
    instance.__dict__.update(values)
    _own_values(instance).update(values)
