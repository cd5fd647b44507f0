"""
Sphinx configuration, on top of the one all astropy packages share.

Warnings are errors in the build that checks the documentation, and it must
pass without a network. So references are of two kinds: our own names, which
have to resolve, and names of other packages, which resolve where their
inventories can be read (``MGAUSS_INTERSPHINX=1``) and are plain text otherwise.
"""
import datetime
import os
from importlib.metadata import version as installed_version

from sphinx_astropy.conf.v3 import *

project = 'photutils_mgauss'
author = 'The photutils_mgauss developers'
_year = datetime.datetime.now(tz=datetime.UTC).year
project_copyright = f'{_year}, {author}'
release = installed_version('photutils_mgauss')
version = '.'.join(release.split('.')[:2])

extensions.remove('sphinx.ext.todo')
exclude_patterns = ['_build', '**.ipynb_checkpoints']
html_title = f'{project} {release}'
html_static_path = []
html_theme_options = {}
html_sidebars = {'**': ['sidebar-nav-bs'], 'index': []}
modindex_common_prefix = ['photutils_mgauss.']

# Every name of ours must resolve.
nitpicky = True
numpydoc_xref_param_type = False
automodsumm_inherited_members = False

if os.environ.get('MGAUSS_INTERSPHINX') == '1':
    intersphinx_mapping |= {
        'photutils': ('https://photutils.readthedocs.io/en/stable/', None),
        'gwcs': ('https://gwcs.readthedocs.io/en/latest/', None),
    }
else:
    intersphinx_mapping = {}

# Names of other packages and of the standard library, by their first word.
nitpick_ignore_regex = [
    (r'py:.*', r'(numpy|np|scipy|astropy|photutils|gwcs|pymc|arviz|numba'
               r'|matplotlib|asdf|concurrent|collections|functools|pathlib'
               r'|typing)(\..*)?'),
    (r'py:.*', r'(bool|bytes|callable|complex|dict|float|frozenset|int|list'
               r'|None|object|property|range|set|slice|str|tuple|type)'),
    (r'py:exc', r'[A-Z][A-Za-z]*(Error|Warning)'),
    (r'py:obj', r'([A-Z][A-Za-z]*(Error|Warning)|True|False|None)'),
]
