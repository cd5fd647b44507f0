"""The types of the public names, which editors and type checkers read."""
import ast
import inspect
import typing
from pathlib import Path
from types import ModuleType

import pytest

import photutils_mgauss

STUB = Path(photutils_mgauss.__file__).with_name('__init__.pyi')
EMPTY = inspect.Parameter.empty
NAMES = sorted(photutils_mgauss._OWNERS)
OURS = ('typed', 'photutils_mgauss')


@pytest.fixture(scope='module')
def typed():
    """Return the file of types as a module: all its names must be known."""
    module = ModuleType('typed')
    text = 'from __future__ import annotations\n' + STUB.read_text('utf-8')
    exec(compile(text, str(STUB), 'exec'), module.__dict__)
    return module


def functions_of(owner):
    """Yield the name and the function of each public call of a name."""
    if inspect.isfunction(owner):
        yield owner.__name__, owner
    if not inspect.isclass(owner):
        return
    for name in dir(owner):
        member = next((vars(one)[name] for one in owner.__mro__
                       if name in vars(one)), None)
        function = getattr(member, '__func__', member)
        if inspect.isfunction(function) and name in (
                name.lstrip('_'), '__init__', '__call__') and (
                function.__module__.partition('.')[0] in OURS):
            yield name, function


def private(function):
    """Whether something is made by the package alone."""
    return any(name.startswith('_')
               for name in inspect.signature(function).parameters)


@pytest.mark.parametrize('name', NAMES)
def test_every_public_call_has_types_that_can_be_resolved(typed, name):
    owner = getattr(typed, name, None)
    assert owner is not None or name in typed.__annotations__
    for call, function in functions_of(owner):
        hints = typing.get_type_hints(function, vars(typed))
        parameters = set(inspect.signature(function).parameters)
        assert set(hints) == parameters - {'self', 'cls'} | {'return'}, call
    if inspect.isclass(owner):
        typing.get_type_hints(owner, vars(typed))


@pytest.mark.parametrize('name', NAMES)
def test_types_are_those_of_the_calls_there_are(typed, name):
    promised = dict(functions_of(getattr(typed, name, None)))
    there = {call: function for call, function in functions_of(
        getattr(photutils_mgauss, name)) if not (
            call == '__init__' and (private(function)
                                    or _is_made_by_enum(name)))}
    assert set(promised) == set(there)
    for call, function in promised.items():
        stated, real = (inspect.signature(one).parameters.values()
                        for one in (function, there[call]))
        assert [(one.name, one.kind) for one in stated] == [
            (one.name, one.kind) for one in real], call
        for one, other in zip(stated, real, strict=True):
            assert (one.default is EMPTY) == (other.default is EMPTY), call
            if one.default is not ...:
                assert one.default == other.default, (call, one.name)


def _is_made_by_enum(name):
    return '__members__' in dir(getattr(photutils_mgauss, name))


@pytest.mark.parametrize('name', NAMES)
def test_every_attribute_of_a_class_has_a_type(typed, name):
    real, stated = (getattr(module, name, None)
                    for module in (photutils_mgauss, typed))
    if not inspect.isclass(real):
        return
    fields = {one for base in stated.__mro__ if base.__module__ == 'typed'
              for one in (*vars(base), *getattr(base, '__annotations__', {}))}
    for base in real.__mro__:
        if base.__module__.startswith('photutils_mgauss.'):
            public = {one for one, member in vars(base).items()
                      if not one.startswith('_')
                      and isinstance(member, property)}
            assert public <= fields, base


def test_the_types_name_nothing_else():
    tree = ast.parse(STUB.read_text('utf-8'))
    names = {node.name for node in tree.body
             if isinstance(node, (ast.ClassDef, ast.FunctionDef))}
    assert names <= set(photutils_mgauss.__all__)
    assert STUB.with_name('py.typed').exists()
