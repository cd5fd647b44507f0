"""Imports go downward through the layers of docs/layers.csv, and are cheap."""
import ast
import csv
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import photutils_mgauss

PACKAGE = Path(photutils_mgauss.__file__).parent
TABLE = Path(__file__).parents[1] / 'docs' / 'layers.csv'


def name_of(path):
    """Return the name of a module in the table, its folder before it."""
    words = path.relative_to(PACKAGE).with_suffix('').parts
    return '/'.join(words[:-1] if words[-1] == '__init__' else words)


def defines_something(path):
    tree = ast.parse(path.read_text(encoding='utf-8'))
    return path.stem != '__init__' or any(
        isinstance(node, ast.FunctionDef | ast.ImportFrom)
        for node in tree.body)


MODULES = sorted(name_of(path) for path in PACKAGE.rglob('*.py')
                 if name_of(path) not in ('', '_version')
                 and defines_something(path))
SLOW = ('pymc', 'pytensor', 'arviz', 'matplotlib.pyplot')
SKY_PACKAGES = ('gwcs', 'astropy.coordinates', 'astropy.time', 'astropy.wcs')

with TABLE.open(newline='') as file:
    LINES = list(csv.DictReader(file))
ROWS = {row['Module']: row for row in LINES}
LAYERS = {name: int(row['Layer']) for name, row in ROWS.items()}
KNOWN = [name for name in MODULES if name in LAYERS]


def parse(name):
    path = PACKAGE / f'{name}.py'
    if not path.exists():
        path = PACKAGE / name / '__init__.py'
    return ast.parse(path.read_text(encoding='utf-8'))


def imported_names(node):
    """Yield the dotted names that an import statement may load."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        base = node.module or ''
        if node.level:
            base = f'photutils_mgauss.{base}'.rstrip('.')
        yield base
        yield from (f'{base}.{alias.name}' for alias in node.names)


def own_modules(node):
    """Return the modules of the package that a statement imports."""
    parts = [name.split('.') for name in imported_names(node)]
    ours = [words[1:] for words in parts if words[0] == 'photutils_mgauss']
    names = {'/'.join(words[:n]) for words in ours for n in (1, 2)}
    return names & LAYERS.keys()


def allowed_plotting(tree):
    """Return the imports of plotting that stand inside plot* functions."""
    return {node for function in ast.walk(tree)
            if isinstance(function, ast.FunctionDef)
            and function.name.startswith('plot')
            for node in ast.walk(function)
            if own_modules(node) == {'plotting'}}


def upward_imports(name, tree):
    """Return a sentence for each import that goes up, `name` importing."""
    allowed = allowed_plotting(tree)
    return [f'{name} (layer {LAYERS[name]}) imports {other} '
            f'(layer {LAYERS[other]}) in line {node.lineno}'
            for node in ast.walk(tree) if node not in allowed
            for other in own_modules(node)
            if LAYERS[other] > LAYERS[name]]


def all_imports(tree):
    """Return the modules of ours that a module imports, now or later."""
    allowed = allowed_plotting(tree)
    return set().union(*(own_modules(node) for node in ast.walk(tree)
                         if node not in allowed))


def run(code):
    return subprocess.run([sys.executable, '-c', code], check=True,
                          capture_output=True, text=True).stdout


def test_every_module_has_a_layer():
    unknown = [name for name in MODULES if name not in LAYERS]
    assert not unknown, f'add {unknown} to the table in docs/layers.csv'
    assert len(LINES) == len(ROWS), 'docs/layers.csv has a module twice'
    gone = [name for name in ROWS if name not in MODULES]
    assert not gone, f'take {gone} out of the table in docs/layers.csv'


@pytest.mark.parametrize('name', KNOWN)
def test_imports_go_downward(name):
    assert upward_imports(name, parse(name)) == []


def test_no_two_modules_import_each_other():
    graph = {name: all_imports(parse(name)) for name in KNOWN}
    TopologicalSorter(graph).prepare()


@pytest.mark.parametrize('name', KNOWN)
def test_the_halves_meet_only_in_the_table_between_them(name):
    half = ROWS[name]['Half']
    strangers = {'image': 'sky', 'sky': 'image'}.get(half)
    others = set().union(*map(own_modules, ast.walk(parse(name))))
    assert not [other for other in others
                if strangers and ROWS[other]['Half'] == strangers]


@pytest.mark.parametrize(
    'name', [name for name in KNOWN if ROWS[name]['Half'] == 'image'])
def test_the_image_half_knows_nothing_of_sky_and_time(name):
    names = [word for node in ast.walk(parse(name))
             for word in imported_names(node)]
    assert not [word for word in names if word.startswith(SKY_PACKAGES)]


@pytest.mark.parametrize(('source', 'count'), [
    ('from photutils_mgauss.cli import main', 1),
    ('from photutils_mgauss import cli', 1),
    ('from . import cli', 1),
    ('from .cli import main', 1),
    ('import photutils_mgauss.cli as c', 1),
    ('from photutils_mgauss.utils.validation import as_real', 0),
    ('def plot(self):\n    from photutils_mgauss import plotting', 0),
    ('def plot(self):\n    from photutils_mgauss.plotting import a', 0),
    ('def draw(self):\n    from photutils_mgauss import plotting', 1),
    ('from photutils_mgauss import plotting', 1),
])
def test_an_upward_import_is_seen(source, count):
    assert len(upward_imports('mixture', ast.parse(source))) == count


@pytest.mark.parametrize('what', [
    'import photutils_mgauss',
    'from photutils_mgauss import *',
])
def test_importing_loads_no_slow_package(what):
    code = f'{what}\nimport sys\nprint(*sys.modules)'
    loaded = run(code).split()
    assert 'photutils_mgauss' in loaded
    assert not [name for name in SLOW if name in loaded]


def test_importing_the_package_loads_none_of_its_modules():
    loaded = run('import photutils_mgauss, sys; print(*sys.modules)').split()
    ours = [name.split('.')[1] for name in loaded
            if name.startswith('photutils_mgauss.')]
    assert set(ours) <= {'_version'}


def test_every_public_name_can_be_reached_and_is_listed():
    for name in photutils_mgauss.__all__:
        assert getattr(photutils_mgauss, name) is not None
        assert name in dir(photutils_mgauss)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match='nothing_here'):
        photutils_mgauss.nothing_here  # noqa: B018
