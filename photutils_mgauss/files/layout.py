"""What is asked of stored tables, whatever kind of file holds them."""
from photutils_mgauss.files.damage import UnusableFileError

__all__ = ['VERSION', 'check_version', 'complete']

# Of the layout of the tables. A reader takes every version up to its own.
VERSION = 1


def check_version(version, name):
    """Raise unless files of this version can be read."""
    if not 1 <= version <= VERSION:
        msg = (f'{name}: must be of version {VERSION} or older, got version '
               f'{version}: it was written by a newer photutils_mgauss')
        raise UnusableFileError(msg)


def complete(cls, tables, name):
    """Return an object made of tables, if no column is missing."""
    missing = [f'{column!r} of {table!r}'
               for table, columns in cls._columns.items()
               for column in columns if column not in tables.get(table, {})]
    if missing:
        msg = (f'{name}: must hold all columns of a {cls.__name__}, got none '
               f'for {", ".join(missing)}')
        raise UnusableFileError(msg)
    return cls._from_tables(tables)
