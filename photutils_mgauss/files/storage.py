"""
Objects in files: named tables of plain columns, as FITS or ASDF.

A class that can be stored turns itself into tables of float64, integer,
boolean and string columns, and is made from such tables again. Numbers stand
in columns, never in header cards, which would cost digits; so what is read
is what was written, bit by bit. Nothing is pickled.
"""
import warnings
from os import PathLike
from pathlib import Path

import numpy as np
from astropy.io import fits, registry
from astropy.io.fits.connect import is_fits

from photutils_mgauss.files.asdf_files import is_asdf, open_asdf
from photutils_mgauss.files.damage import UnusableFileError, undamaged
from photutils_mgauss.files.fits_files import name_of, open_fits
from photutils_mgauss.files.layout import VERSION, check_version, complete
from photutils_mgauss.files.whole import whole_file
from photutils_mgauss.utils.waiting import waiting

__all__ = ['read_stored', 'storable', 'table_columns']


class _Read(registry.UnifiedReadWrite):
    """
    Read an object of this class from a file.

    Parameters
    ----------
    path : str, path-like or file-like
        A FITS or ASDF file made by `write`.
    format : {'fits', 'asdf'}, optional
        Found from the content of the file where it is not given.

    Raises
    ------
    OSError
        If the file cannot be opened.
    ValueError
        If the file is damaged, was made by a newer version, or holds
        something else.

    Notes
    -----
    Every number comes back bit by bit.
    """

    def __init__(self, instance, cls):
        super().__init__(instance, cls, 'read')

    def __call__(self, path, *args, **kwargs):
        if isinstance(path, str | PathLike):
            # Says why it cannot be opened, which the registry does not.
            Path(path).open('rb').close()
        with waiting(f'{self._cls.__name__}.read'), undamaged(
                name_of(path), 'an undamaged file of a '
                       f'{self._cls.__name__} (FITS or ASDF)'):
            return self.registry.read(self._cls, path, *args, **kwargs)


class _Write(registry.UnifiedReadWrite):
    """
    Write the object to a file.

    Parameters
    ----------
    path : str, path-like or file-like
        Where to write.
    format : {'fits', 'asdf'}, optional
        Found from the name of the file where it is not given.
    overwrite : bool, optional
        Whether an existing file is replaced.

    Raises
    ------
    OSError
        If the file exists and ``overwrite`` is not set, or cannot be
        written; an older file then stays as it was.
    ValueError
        If neither ``format`` nor the name of the file tells the format.

    Notes
    -----
    Every number is written as a float64 column, none as a header card.
    """

    def __init__(self, instance, cls):
        super().__init__(instance, cls, 'write')

    def __call__(self, path, *args, **kwargs):
        try:
            with waiting(f'{self._cls.__name__}.write'):
                self.registry.write(self._instance, path, *args, **kwargs)
        except registry.IORegistryError as error:
            msg = (f'{name_of(path)}: must end with .fits or .asdf, or '
                   "format must be 'fits' or 'asdf'")
            raise ValueError(msg) from error


def storable(**tables):
    """
    Give a class ``read`` and ``write``; its decorator.

    The class has ``_to_tables()``, which returns a dict of tables, each a
    dict of columns, and the class method ``_from_tables(tables)``, the
    inverse of it.

    Parameters
    ----------
    **tables : dict
        The tables every file has, each a dict of column names and units.
        Further tables may come with them.
    """
    def decorate(cls):
        cls._columns = tables
        cls.read = registry.UnifiedReadWriteMethod(_Read)
        cls.write = registry.UnifiedReadWriteMethod(_Write)
        _register(cls)
        return cls
    return decorate


def _register(cls):
    formats = {'fits': (is_fits, _read_fits, _write_fits),
               'asdf': (_is_asdf, _read_asdf, _write_asdf)}
    for name, (identify, read, write) in formats.items():
        registry.register_identifier(name, cls, identify)
        with registry.delay_doc_updates(cls):
            registry.register_reader(name, cls, _bound(read, cls))
            registry.register_writer(name, cls, write)


def _bound(read, cls):
    def reader(file):
        return read(cls, file)
    return reader


def table_columns(table):
    """Return the columns of a table without units, as files hold them."""
    columns = {name: np.asarray(table[name]) for name in table.colnames}
    return {name: column.astype(str) if column.dtype.kind == 'O' else column
            for name, column in columns.items()}


def _write_fits(stored, file, *, overwrite=False):
    cls = type(stored)
    primary = fits.PrimaryHDU()
    primary.header['MGCLASS'] = cls.__name__, 'what the file holds'
    primary.header['MGVERS'] = VERSION, 'version of the layout'
    hdus = [_table_hdu(name, columns, cls._columns.get(name, {}))
            for name, columns in stored._to_tables().items()]
    hdus = fits.HDUList([primary, *hdus])
    if hasattr(file, 'write'):
        hdus.writeto(file, checksum=True)
        return
    with whole_file(file, overwrite=overwrite) as draft:
        hdus.writeto(draft, overwrite=True, checksum=True)


def _table_hdu(name, columns, units):
    made = [_fits_column(column, np.asarray(values), units.get(column))
            for column, values in columns.items()]
    return fits.BinTableHDU.from_columns(made, name=name.upper())


def _fits_column(name, values, unit):
    size = int(np.prod(values.shape[1:]))
    if values.dtype.kind == 'U':
        values = np.char.encode(values, 'utf-8')
        letter = f'{max(values.itemsize, 1)}A'
    else:
        letter = str(size) + {'f': 'D', 'b': 'L', 'i': 'K'}[values.dtype.kind]
    dim = str(values.shape[:0:-1]) if values.ndim > 2 else None
    return fits.Column(name.upper(), letter, unit=unit or None, dim=dim,
                       array=values)


def _read_fits(cls, file):
    name = name_of(file)
    with open_fits(file, 'undamaged', checksum=True) as hdus:
        header = hdus[0].header
        _check_class(header.get('MGCLASS'), cls, name)
        check_version(header.get('MGVERS', 0), name)
        tables = {hdu.name.lower(): _plain_columns(hdu) for hdu in hdus[1:]}
        return complete(cls, tables, name)


def read_stored(path):
    """
    Return the object of this package in a file, of whichever class.

    Parameters
    ----------
    path : str or path-like
        A FITS or ASDF file made by `write`.

    Raises
    ------
    OSError
        If the file cannot be opened.
    ValueError
        If it is damaged or holds no such object.
    """
    import photutils_mgauss
    from photutils_mgauss.files.asdf_extension import CLASSES
    if is_asdf(path):
        with undamaged(path):
            found = _stored_in_asdf(path)
        if found:
            return _only_one(found, path)
        name = None
    else:
        with open_fits(path, 'undamaged') as hdus:
            name = hdus[0].header.get('MGCLASS')
    if name not in CLASSES:
        msg = f'{path}: must hold a PSF of this package, got {name}'
        raise UnusableFileError(msg)
    return getattr(photutils_mgauss, name).read(path)


def _plain_columns(hdu):
    return {name.lower(): _native(hdu.data[name]) for name in hdu.data.names}


def _native(column):
    column = np.array(column)
    if column.dtype.kind in 'SU':
        return column.astype(str)
    return column.astype(column.dtype.newbyteorder('='))


def _check_class(found, cls, name):
    if found != cls.__name__:
        got, remedy = (
            (f'a {found}', f'{found}.read takes it') if found else
            ('a file of another program',
             'GriddedMixturePSF.from_file takes the PSFs of other programs'))
        msg = f'{name}: must hold a {cls.__name__}, got {got}; {remedy}'
        raise UnusableFileError(msg)


def _is_asdf(origin, path, file, *args, **kwargs):
    if origin == 'read' and file is not None:
        where = file.tell()
        start = file.read(5)
        file.seek(where)
        return start == b'#ASDF'
    return path is not None and str(path).endswith('.asdf')


def _write_asdf(stored, file, *, overwrite=False):
    import asdf

    from photutils_mgauss.files.asdf_extension import enabled
    with enabled():
        tree = asdf.AsdfFile({'psf': stored})
        if hasattr(file, 'write'):
            tree.write_to(file)
            return
        with whole_file(file, overwrite=overwrite) as draft:
            tree.write_to(draft)


def _read_asdf(cls, file):
    name = name_of(file)
    with undamaged(name):
        found = _stored_in_asdf(file)
    wanted = {key: value for key, value in found.items()
              if isinstance(value, cls)}
    if not wanted:
        names = ', '.join(type(value).__name__ for value in found.values())
        _check_class(names, cls, name)
    return _only_one(wanted, name)


def _only_one(found, name):
    """Return the object, if there is one only."""
    if len(found) > 1:
        msg = (f'{name}: must hold one object of this package, got '
               f'{len(found)}, {", ".join(map(str, found))}; asdf.open gives '
               'all of them by these names')
        raise UnusableFileError(msg)
    return next(iter(found.values()))


def _stored_in_asdf(file):
    import asdf

    from photutils_mgauss.files.asdf_extension import CLASSES, enabled
    with enabled(), warnings.catch_warnings():
        # An unknown version of a tag is only a warning of asdf.
        warnings.simplefilter('error')
        warnings.simplefilter('ignore', asdf.exceptions.
                              AsdfPackageVersionWarning)
        with open_asdf(file) as opened:
            return {key: value for key, value in opened.tree.items()
                    if type(value).__name__ in CLASSES}
