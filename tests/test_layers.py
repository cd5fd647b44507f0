"""Imports go downward through the layers of docs/layers.csv, and are cheap."""
import ast
import csv
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from importlib import import_module
from operator import attrgetter
from pathlib import Path

import pytest

import photutils_mgauss

PACKAGE = Path(photutils_mgauss.__file__).parent
TESTS = Path(__file__).parent
TABLE = TESTS.parent / 'docs' / 'layers.csv'
WALK = TABLE.with_name('walk.csv')
SLOW = ('pymc', 'pytensor', 'arviz', 'matplotlib.pyplot')
SKY_PACKAGES = ('gwcs', 'astropy.coordinates', 'astropy.time', 'astropy.wcs')

with TABLE.open(newline='') as file:
    LINES = list(csv.DictReader(file))
with WALK.open(newline='') as file:
    STATIONS = [(row['Module'].strip('`'), row['Call'].strip('`'))
                for row in csv.DictReader(file)]
ROWS = {row['Room']: row for row in LINES}
FLOORS = {name: int(row['Floor']) for name, row in ROWS.items()}
# One star in many images: the only module that needs both halves.
BOTH_HALVES = {'photometry/many_images'}


def name_of(path):
    """Return the name of a module, its room before it."""
    words = path.relative_to(PACKAGE).with_suffix('').parts
    return '/'.join(words[:-1] if words[-1] == '__init__' else words)


MODULES = {name_of(path): path for path in sorted(PACKAGE.rglob('*.py'))
           if path.parent != PACKAGE}


def room_of(name):
    return name.partition('/')[0]


@cache
def parse(name):
    return ast.parse(MODULES[name].read_text(encoding='utf-8'))


def imported_names(node):
    """Yield the dotted names that an import statement may load."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        base = node.module or ''
        if node.level:
            base = f'photutils_mgauss.{base}'.rstrip('.')
        yield from (f'{base}.{alias.name}' for alias in node.names)


def own_modules(node):
    """Return the modules of the package that a statement imports."""
    found = set()
    for name in imported_names(node):
        top, *words = name.split('.')
        if top == 'photutils_mgauss':
            public = OWNERS.get(words[0]) if len(words) == 1 else None
            names = [public] if public else [
                '/'.join(words[:n]) for n in (2, 1)]
            found.update([word for word in names if word in MODULES][:1])
    return found


OWNERS = {name: owner.replace('.', '/')
          for name, owner in photutils_mgauss._OWNERS.items()}


@cache
def imports(tree):
    """Return the import statements of a tree, a few nodes of very many."""
    return [node for node in ast.walk(tree)
            if isinstance(node, ast.Import | ast.ImportFrom)]


@cache
def exceptions(tree):
    """
    Return the imports that may go up.

    A plot* function may draw, and a from_* constructor of a class may need a
    room above the class.
    """
    return {node for function in ast.walk(tree)
            if isinstance(function, ast.FunctionDef)
            and function.name.startswith(('plot', 'from_'))
            for node in imports(function)
            if {room_of(name) for name in own_modules(node)}
            <= ({'plotting'} if function.name.startswith('plot')
                else {'fitting', 'field'})}


def upward_imports(name, tree):
    """Return a sentence for each import that goes up, `name` importing."""
    allowed, room = exceptions(tree), room_of(name)
    return [f'{name} (floor {FLOORS[room]}) imports {other} '
            f'(floor {FLOORS[room_of(other)]}) in line {node.lineno}'
            for node in imports(tree) if node not in allowed
            for other in own_modules(node) if room_of(other) != room
            and FLOORS[room_of(other)] >= FLOORS[room]]


def all_imports(tree):
    """Return the modules of ours that a module imports, now or later."""
    allowed = exceptions(tree)
    return set().union(*(own_modules(node) for node in imports(tree)
                         if node not in allowed))


def run(code):
    return subprocess.run([sys.executable, '-c', code], check=True,
                          capture_output=True, text=True).stdout


def test_every_room_has_a_floor():
    rooms = {room_of(name) for name in MODULES}
    assert rooms == ROWS.keys(), 'docs/layers.csv has a row for each folder'
    assert len(LINES) == len(ROWS), 'docs/layers.csv has a room twice'
    assert len(set(FLOORS.values())) <= 7


def test_no_module_stands_outside_the_rooms():
    flat = {path.stem for path in PACKAGE.glob('*.py')}
    assert flat - {'_version'} == {'__init__', '__main__'}


@pytest.mark.parametrize('name', ROWS)
def test_every_room_says_what_it_is_for(name):
    words = ast.get_docstring(parse(name)).split()
    assert len(words) > 40


@pytest.mark.parametrize('name', MODULES)
def test_no_module_is_long(name):
    lines = MODULES[name].read_text(encoding='utf-8').splitlines()
    assert len(lines) <= 600


@pytest.mark.parametrize('name', MODULES)
def test_imports_go_downward(name):
    assert upward_imports(name, parse(name)) == []


@pytest.mark.parametrize(('name', 'call'), STATIONS)
def test_the_walk_through_the_house_leads_through_real_doors(name, call):
    module = import_module(f'photutils_mgauss.{name.replace("/", ".")}')
    assert attrgetter(call)(module).__module__ == module.__name__


def test_tests_stand_in_the_rooms_of_what_they_test():
    folders = {path.parent.name for path in TESTS.glob('*/test_*.py')}
    # The readers of all rooms are tried with damaged files in one place.
    assert folders <= ROWS.keys() | {'fuzz'}


@pytest.mark.parametrize('path', [
    pytest.param(path, id=path.stem) for path in TESTS.rglob('*.py')])
def test_no_test_module_is_imported(path):
    names = [name for node in imports(ast.parse(path.read_text('utf-8')))
             for name in imported_names(node)]
    assert not [name for name in names if name.startswith('test_')
                or '.test_' in name]


def test_no_two_modules_import_each_other():
    graph = {name: all_imports(parse(name)) for name in MODULES}
    TopologicalSorter(graph).prepare()


@pytest.mark.parametrize('name', MODULES)
def test_the_halves_meet_only_in_the_table_between_them(name):
    half = ROWS[room_of(name)]['Half']
    strangers = {'image': 'sky', 'sky': 'image'}.get(half)
    others = set().union(*map(own_modules, imports(parse(name))))
    assert name in BOTH_HALVES or not [
        other for other in others
        if strangers and ROWS[room_of(other)]['Half'] == strangers]


@pytest.mark.parametrize(
    'name', [name for name in MODULES if name not in BOTH_HALVES
             and ROWS[room_of(name)]['Half'] == 'image'])
def test_the_image_half_knows_nothing_of_sky_and_time(name):
    names = [word for node in imports(parse(name))
             for word in imported_names(node)]
    assert not [word for word in names if word.startswith(SKY_PACKAGES)]


@pytest.mark.parametrize(('source', 'count'), [
    ('from photutils_mgauss.cli import main', 1),
    ('from photutils_mgauss import cli', 1),
    ('from photutils_mgauss import fit_mixture', 1),
    ('from photutils_mgauss import GaussianMixture', 0),
    ('from . import cli', 1),
    ('from .cli.tools import say', 1),
    ('import photutils_mgauss.cli.tools as c', 1),
    ('from photutils_mgauss.utils.validation import as_real', 0),
    ('def plot(self):\n    from photutils_mgauss import plotting', 0),
    ('def plot(self):\n    from photutils_mgauss.plotting import a', 0),
    ('def plot(self):\n    from photutils_mgauss.fitting import a', 1),
    ('def draw(self):\n    from photutils_mgauss import plotting', 1),
    ('def from_x(self):\n    from photutils_mgauss.fitting import a', 0),
    ('def from_x(self):\n    from photutils_mgauss.plotting import a', 1),
    ('from photutils_mgauss import plotting', 1),
])
def test_an_upward_import_is_seen(source, count):
    assert len(upward_imports('psf/mixture', ast.parse(source))) == count


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
    assert set(ours) <= {'_version', 'utils'}


def test_every_public_name_can_be_reached_and_is_listed():
    for name in photutils_mgauss.__all__:
        assert getattr(photutils_mgauss, name) is not None
        assert name in dir(photutils_mgauss)


def test_figures_are_there_without_an_import_of_their_own():
    assert 'plot_corner' in run(
        'import photutils_mgauss as mgauss; print(dir(mgauss.plotting))')


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match='nothing_here'):
        photutils_mgauss.nothing_here  # noqa: B018
