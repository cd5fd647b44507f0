"""
The package's objects in ASDF trees.

asdf finds this module by entry points and loads it with the first file it
opens: so it imports little but asdf. The objects' own modules load when one
of them is read.
"""
from contextlib import contextmanager
from functools import cache
from importlib.resources import files

import asdf
import numpy as np
from asdf.extension import Converter, Extension, TagDefinition

from photutils_mgauss.files.layout import VERSION, check_version, complete

_BASE = 'asdf://photutils_mgauss/'

# Public class -> the module that defines it.
CLASSES = {
    'GaussianMixture': 'psf.mixture',
    'GriddedMixturePSF': 'psf.gridded',
    'MixtureField': 'field.mixture_field',
    'MultiGaussianPSFModel': 'psf.model',
}


def _tag(name):
    return f'{_BASE}tags/{name}-1.0.0'


def _schema(name):
    return f'{_BASE}schemas/{name}-1.0.0'


class TablesConverter(Converter):
    """Objects to trees of tables of columns, and back."""

    @property
    def tags(self):
        """The tags of all classes."""
        return [_tag(name) for name in CLASSES]

    @property
    def types(self):
        """The full names of all classes, which need not be loaded."""
        return [f'photutils_mgauss.{module}.{name}'
                for name, module in CLASSES.items()]

    def select_tag(self, obj, tags, ctx):
        """Return the tag of an object."""
        return _tag(type(obj).__name__)

    def to_yaml_tree(self, obj, tag, ctx):
        """Return plain lists and arrays."""
        tables = {name: {column: _plain(values)
                         for column, values in columns.items()}
                  for name, columns in obj._to_tables().items()}
        return {'version': VERSION, 'tables': tables}

    def from_yaml_tree(self, node, tag, ctx):
        """Return the object."""
        import photutils_mgauss
        check_version(node['version'], 'tree')
        name = tag.rpartition('/')[2].partition('-')[0]
        tables = {table: {column: np.array(values)
                          for column, values in columns.items()}
                  for table, columns in node['tables'].items()}
        return complete(getattr(photutils_mgauss, name), tables, 'tree')


def _plain(values):
    """Return text and truth values as lists, numbers as an array."""
    values = np.asarray(values)
    return values.tolist() if values.dtype.kind in 'Ub' else values


class MixtureExtension(Extension):
    """What asdf needs to know of this package."""

    extension_uri = f'{_BASE}extensions/mixtures-1.0.0'

    @property
    def converters(self):
        """The one converter."""
        return [TablesConverter()]

    @property
    def tags(self):
        """The tags and their schemas."""
        return [TagDefinition(_tag(name), schema_uris=[_schema(name)],
                              title=name) for name in CLASSES]


def extensions():
    """Return the extensions; an entry point of asdf."""
    return [MixtureExtension()]


def resource_mappings():
    """Return the schemas by their names; an entry point of asdf."""
    folder = files('photutils_mgauss') / 'schemas'
    return [{_schema(name): (folder / f'{name}-1.0.0.yaml').read_bytes()
             for name in CLASSES}]


@cache
def _own():
    """Return the extension and the schemas, the same ones every time."""
    return extensions(), resource_mappings()


@contextmanager
def enabled():
    """
    Let asdf know this package even where it is not installed.

    asdf keeps all it has made of an extension for as long as it runs. So
    each is made once: ours here, and those of other packages in the
    configuration outside the context, from which the context copies them.
    """
    asdf.get_config().extensions  # noqa: B018
    asdf.get_config().resource_mappings  # noqa: B018
    own, mappings = _own()
    with asdf.config_context() as config:
        for mapping in mappings:
            config.add_resource_mapping(mapping)
        for extension in own:
            config.add_extension(extension)
        yield
