"""Compiled code: kept, noticed when it is out of date, and done without."""
import ast
import os
import pty
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core.registry import cpu_target

import photutils_mgauss
from photutils_mgauss import kernels
from photutils_mgauss.kernels import jit

PACKAGE = Path(photutils_mgauss.__file__).parent
SOURCES = sorted((PACKAGE / 'kernels').glob('*.py'))
# evaluate_grid stands in grid.py and calls add_values of gaussian.py.
CODE = """
import numpy as np
from photutils_mgauss import GaussianMixture, GriddedMixturePSF
mixture = GaussianMixture([1], [[0, 0]], [np.eye(2)])
psf = GriddedMixturePSF([mixture], [(0, 0)])
print(round(float(psf.evaluate(3.0, 4.0, 2 * np.pi, 3.0, 4.0)), 6))
"""


@pytest.fixture
def copy(tmp_path):
    """Return a copy of the package whose compiled code is its own."""
    folder = tmp_path / 'site' / 'photutils_mgauss'
    # What Python keeps of its own is as good there.
    shutil.copytree(PACKAGE, folder,
                    ignore=shutil.ignore_patterns('*.nbi', '*.nbc'))
    return folder


def run(copy, stderr=subprocess.PIPE, **environment):
    """Return what a process prints that uses a copy of the package."""
    clean = {name: value for name, value in os.environ.items()
             if not name.startswith('NUMBA_')}
    return subprocess.run(
        [sys.executable, '-c', CODE], text=True, check=True, stderr=stderr,
        stdout=subprocess.PIPE,
        env={**clean, 'PYTHONPATH': str(copy.parent), 'PYTHONSAFEPATH': '1',
             **environment})


def edit(path, old, new):
    text = path.read_text(encoding='utf-8')
    assert text.count(old) == 1
    path.write_text(text.replace(old, new), encoding='utf-8')


@pytest.mark.long
def test_an_edit_of_a_function_called_from_another_file_is_noticed(
        copy, tmp_path):
    cache = {'NUMBA_CACHE_DIR': str(tmp_path / 'cache')}
    assert run(copy, **cache).stdout.strip() == '1.0'
    assert list((tmp_path / 'cache').rglob('*.nbc'))
    edit(copy / 'kernels' / 'gaussian.py',
         'out[i] += peak * fast_exp(', 'out[i] += 3.0 * peak * fast_exp(')
    assert run(copy, **cache).stdout.strip() == '3.0'


@pytest.mark.long
def test_without_a_folder_for_it_code_is_compiled_and_one_warning_given(
        copy, tmp_path):
    for place in list(copy.rglob('__pycache__')):
        shutil.rmtree(place)
    for place in (copy, *(p for p in copy.rglob('*') if p.is_dir())):
        (place / '__pycache__').write_text('')
    wall = tmp_path / 'file'
    wall.write_text('')
    result = run(copy, HOME=str(wall / 'home'),
                 XDG_CACHE_HOME=str(wall / 'cache'),
                 PYTHONDONTWRITEBYTECODE='1')
    assert result.stdout.strip() == '1.0'
    assert result.stderr.count('UserWarning') == 1
    assert 'NUMBA_CACHE_DIR' in result.stderr


@pytest.mark.long
def test_damaged_files_are_compiled_anew(copy, tmp_path):
    cache = {'NUMBA_CACHE_DIR': str(tmp_path / 'cache')}
    run(copy, **cache)
    for path in (tmp_path / 'cache').rglob('*.nb[ci]'):
        path.write_bytes(path.read_bytes()[:99])
    result = run(copy, **cache)
    assert result.stdout.strip() == '1.0'
    assert result.stderr.count('UserWarning') <= 1


@pytest.mark.long
def test_who_waits_at_a_terminal_is_told_once(copy, tmp_path):
    slow = copy / 'kernels' / 'jit.py'
    edit(slow, '_PATIENCE = 1.0', '_PATIENCE = 0.01')
    said = []
    for _ in range(2):
        leader, follower = pty.openpty()
        run(copy, stderr=follower, NUMBA_CACHE_DIR=str(tmp_path / 'cache'))
        os.close(follower)
        said.append(_read(leader))
        os.close(leader)
    assert said[0].count('compiling (once per installation)') == 1
    assert said[1] == ''


def _read(leader):
    try:
        return os.read(leader, 10000).decode()
    except OSError:  # nothing was written
        return ''


@pytest.mark.long
def test_nothing_is_told_where_output_is_no_terminal(copy, tmp_path):
    edit(copy / 'kernels' / 'jit.py', '_PATIENCE = 1.0', '_PATIENCE = 0.01')
    result = run(copy, NUMBA_CACHE_DIR=str(tmp_path / 'cache'))
    assert result.stderr == ''


@pytest.mark.parametrize('path', SOURCES, ids=lambda path: path.stem)
def test_only_one_module_names_numba(path):
    tree = ast.parse(path.read_text(encoding='utf-8'))
    modules = {name.name for node in ast.walk(tree)
               if isinstance(node, ast.Import) for name in node.names}
    modules |= {node.module for node in ast.walk(tree)
                if isinstance(node, ast.ImportFrom)}
    assert path.stem == 'jit' or not any(
        name.startswith('numba') for name in modules)


@pytest.mark.parametrize('path', SOURCES, ids=lambda path: path.stem)
def test_no_function_takes_many_arrays(path):
    """More than eight arrays come as named tuples; numbers do not count."""
    tree = ast.parse(path.read_text(encoding='utf-8'))
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and node.decorator_list:
            assert len(_arrays(node)) <= 8, node.name


def _arrays(function):
    """Return the arguments that are subscripted or sized."""
    used = set()
    for node in ast.walk(function):
        if (isinstance(node, ast.Subscript | ast.Attribute)
                and isinstance(node.value, ast.Name)
                and getattr(node, 'attr', 'size') in ('shape', 'size')):
            used.add(node.value.id)
    return used & {argument.arg for argument in function.args.args}


def test_no_module_outside_the_room_names_numba():
    assert [path for path in PACKAGE.rglob('*.py')
            if path not in SOURCES
            and 'import numba' in path.read_text(encoding='utf-8')] == []


def test_what_is_compiled_for_python_is_handed_on():
    for name in set(kernels.__all__):
        getattr(kernels, name)
    own = {name for name, function in jit.KERNELS.items()
           if function.py_func.__module__.startswith('photutils_mgauss')}
    assert own
    assert own <= set(kernels.__all__)


@pytest.mark.long
def test_the_command_compiles_every_kernel():
    code = """
from photutils_mgauss.cli.compile_command import compile_all
from photutils_mgauss.kernels import jit
if __name__ == '__main__':
    ready = [name for _, _, names, _ in compile_all() for name in names]
    print(sorted(jit.KERNELS.keys() - set(ready)))
"""
    found = subprocess.run([sys.executable, '-c', code], check=True,
                           capture_output=True, text=True)
    assert found.stdout == '[]\n'


@pytest.mark.long
def test_no_kernel_is_compiled_for_integers_besides_floats():
    code = """
from photutils_mgauss.cli.compile_command import examples
from photutils_mgauss.kernels import jit
for call in examples().values():
    call()
for name, kernel in jit.KERNELS.items():
    kinds = {str(one).replace('int64', 'float64')
             for one in kernel.signatures}
    if len(kinds) < len(kernel.signatures):
        print(name, kernel.signatures)
"""
    found = subprocess.run([sys.executable, '-W', 'ignore', '-c', code],
                           check=True, capture_output=True, text=True)
    assert found.stdout == ''


def _doubled(x, n):
    return x * 2 + n


def _doubled_and_more(x, n):
    return doubled(x, n) + doubled(x, 1)


def _fill(values):
    for i in range(values.size):
        values[i] = more(values[i], 3) + doubled(values[i], i)


doubled = jit.inner(_doubled)
more = jit.inner(_doubled_and_more)
fill = jit.kernel(_fill)
# Neither the package's own nor kept.
jit.KERNELS.pop('_fill', None)
fill._cache = jit._NotKept()


def _longer(x, by):
    if by is not None and by > 0:
        return x + by.no_such_name
    return x


def _stretch(values, by):
    for i in range(values.size):
        values[i] = longer(2 * values[i], by)


longer = jit.inner(_longer)
stretch = jit.kernel(_stretch)
jit.KERNELS.pop('_stretch', None)
stretch._cache = jit._NotKept()


def test_what_needs_an_argument_that_is_none_is_not_compiled():
    values = np.arange(3.0)
    stretch(values, None)
    assert values.tolist() == [0, 2, 4]


@pytest.fixture(scope='module')
def filled():
    values = np.arange(5.0)
    fill(values)
    return values


def test_a_kernel_finds_inner_functions_of_inner_functions(filled):
    x = np.arange(5.0)
    assert filled.tolist() == (6 * x + 4 + x).tolist()


@pytest.mark.skipif(not hasattr(doubled, 'signatures'),
                    reason='numba is switched off')
def test_constants_as_arguments_make_no_versions_of_their_own(filled):
    assert len(doubled.signatures) == len(more.signatures) == 1


def test_remembered_signatures_are_those_that_numba_finds(filled):
    context = cpu_target.typing_context
    for (function, args), signature in jit._SIGNATURES.items():
        assert context.resolve_function_type(function, args, {}) == signature
