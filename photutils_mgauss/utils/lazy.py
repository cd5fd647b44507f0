"""Names that a package hands on and loads when they are first used."""
import sys
from importlib import import_module
from importlib.abc import MetaPathFinder
from importlib.util import find_spec


def hand_on(package, owners, modules=()):
    """
    Return `__getattr__`, `__dir__` and `__all__` of a package.

    Parameters
    ----------
    package : str
        Its ``__name__``.
    owners : dict
        Public name -> the module below the package that owns it.
    modules : sequence of str, optional
        Modules below the package that are loaded in the same way.

    Returns
    -------
    load, listing : callable
        The module's `__getattr__` and `__dir__` (PEP 562).
    names : list of str
        Its ``__all__``.
    """
    def load(name):
        if name in modules:
            return import_module(f'{package}.{name}')
        if name not in owners:
            msg = f'module {package!r} has no attribute {name!r}'
            raise AttributeError(msg)
        value = getattr(import_module(f'{package}.{owners[name]}'), name)
        setattr(import_module(package), name, value)
        return value

    def listing():
        return sorted({*vars(import_module(package)), *owners, *modules})

    return load, listing, list(owners)


def offer_formats(names, owner, reader):
    """
    Let `astropy.table.Table.read` know of formats, read by a module later.

    Parameters
    ----------
    names : sequence of str
        What the formats are called after ``'mgauss.'``.
    owner, reader : str
        The module, and in it the function of a file, a name and options.
    """
    def later(name):
        def read(file, **options):
            return getattr(import_module(owner), reader)(file, name,
                                                         **options)
        return read

    def register():
        from astropy.io import registry
        from astropy.table import Table
        for name in names:
            registry.register_reader(f'mgauss.{name}', Table, later(name),
                                     force=True)
    when_imported('astropy.table', register)


def when_imported(name, function):
    """
    Call a function once a module is there, now or whenever it is imported.

    The module is not imported for that: help of the command line comes
    without waiting for packages that it does not need.
    """
    if name in sys.modules:
        function()
    else:
        sys.meta_path.insert(0, _Watch(name, function))


class _Watch(MetaPathFinder):
    """Waits for the import of one module, and calls a function after it."""

    def __init__(self, name, function):
        self._name, self._function = name, function

    def find_spec(self, name, path, target=None):
        """Find the module for which this waits, and no other."""
        if name != self._name:
            return None
        sys.meta_path.remove(self)
        spec = find_spec(name)
        run = spec.loader.exec_module

        def run_and_tell(module):
            run(module)
            self._function()
        spec.loader.exec_module = run_and_tell
        return spec
