"""
Sphinx configuration, on top of the one all astropy packages share.

Warnings are errors in the build that checks the documentation, and it must
pass without a network. So references are of two kinds: our own names, which
have to resolve, and names of other packages, which resolve where their
inventories can be read (``MGAUSS_INTERSPHINX=1``) and are plain text
otherwise.
"""
import datetime as dt
import inspect
import os
import sys
from pathlib import Path

from sphinx_astropy.conf.v3 import *

import photutils_mgauss

project = 'photutils_mgauss'
author = 'The photutils_mgauss developers'
_year = dt.datetime.now(tz=dt.UTC).year
project_copyright = f'{_year}, {author}'
release = photutils_mgauss.__version__
version = '.'.join(release.split('.')[:2])

sys.path.insert(0, str(Path(__file__).parent))
extensions.remove('sphinx.ext.todo')
extensions.remove('sphinx.ext.mathjax')
extensions += ['make_formulae', 'make_gallery', 'make_house']
html_math_renderer = 'mathml'
exclude_patterns = ['_build', '**.ipynb_checkpoints']
html_title = f'{project} {release}'
html_static_path = ['_static']
html_css_files = ['mgauss.css']
html_logo = ''
# The theme is Astropy's; the bar above, its links and its statistics are not.
html_theme_options = {
    'sst_project_name': project, 'sst_site_root': '.', 'sst_is_root': True,
    'navbar_links': [['Quickstart', 'quickstart'],
                     ['What do you want to do?', 'tasks/index'],
                     ['API', 'api'], ['Get help', 'help'],
                     ['Cite', 'cite'], ['Contribute', 'contributing']],
    'footer_links': [], 'goatcounter_analytics_url': False}
modindex_common_prefix = ['photutils_mgauss.']

# Every name of ours must resolve, and is looked for in the package first.
nitpicky = True
rst_prolog = '.. currentmodule:: photutils_mgauss'
numpydoc_xref_param_type = False
automodsumm_inherited_members = False


def _take_over(owner):
    """Give a class the public members of its bases in this package."""
    for base in owner.__mro__[1:]:
        if base.__module__.startswith('photutils_mgauss.'):
            for name in {*vars(base)} - {*vars(owner)}:
                if not name.startswith('_'):
                    setattr(owner, name, vars(base)[name])


# automodapi lists either what stands in a class itself or all it inherits,
# also from astropy. Readers want what this package has written.
for _name in photutils_mgauss.__all__:
    if inspect.isclass(_member := getattr(photutils_mgauss, _name)):
        _take_over(_member)

if os.environ.get('MGAUSS_INTERSPHINX') == '1':
    intersphinx_mapping |= {
        'photutils': ('https://photutils.readthedocs.io/en/stable/', None),
        'gwcs': ('https://gwcs.readthedocs.io/en/latest/', None),
    }
else:
    intersphinx_mapping = {}

# Names of other packages and of the standard library, by their first word.
_others = (
    'numpy np scipy astropy photutils gwcs pymc arviz xarray galsim numba '
    'matplotlib asdf concurrent collections copy enum functools pathlib '
    'typing')
_plain = (
    'bool bytes callable complex dict float frozenset int list object '
    'property range set slice str tuple type None True False')
nitpick_ignore_regex = [
    # The base classes of public ones are known to their rooms only.
    ('py:.*', r'photutils_mgauss\.\w+\.\w+\.\w+'),
    ('py:.*', rf'({"|".join(_others.split())})(\..*)?'),
    ('py:.*', '|'.join(_plain.split())),
    ('py:.*', '[A-Z][A-Za-z]*(Error|Warning)'),
]
