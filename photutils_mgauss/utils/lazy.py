"""Names that a package hands on and loads when they are first used."""
from importlib import import_module

from astropy.io import registry
from astropy.table import Table


def hand_on(package, owners):
    """
    Return `__getattr__`, `__dir__` and `__all__` of a package.

    Parameters
    ----------
    package : str
        Its ``__name__``.
    owners : dict
        Public name -> the module below the package that owns it.

    Returns
    -------
    load, listing : callable
        The module's `__getattr__` and `__dir__` (PEP 562).
    names : list of str
        Its ``__all__``.
    """
    def load(name):
        if name not in owners:
            msg = f'module {package!r} has no attribute {name!r}'
            raise AttributeError(msg)
        value = getattr(import_module(f'{package}.{owners[name]}'), name)
        setattr(import_module(package), name, value)
        return value

    def listing():
        return sorted({*vars(import_module(package)), *owners})

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
    for name in names:
        registry.register_reader(f'mgauss.{name}', Table, later(name),
                                 force=True)
