"""The documentation of every public name is complete."""
import inspect
import re

import pytest

import photutils_mgauss

NAMES = sorted(photutils_mgauss._OWNERS)
OBJECTS = {name: getattr(photutils_mgauss, name) for name in NAMES}
CHECKS = re.compile(r'\braise [A-Z]|\bas_[a-z]+\(')


def sections(documented):
    """Return the text of each section of a docstring, by its heading."""
    text = inspect.cleandoc(documented.__doc__ or '')
    parts = re.split(r'^([A-Z][A-Za-z ]+)\n-{3,}\n', text, flags=re.MULTILINE)
    return {'': parts[0]} | dict(zip(parts[1::2], parts[2::2], strict=True))


def own_members(owner):
    """Return what a class and its bases in this package define, by name."""
    bases = [base for base in reversed(owner.__mro__)
             if base.__module__.startswith('photutils_mgauss.')]
    return {name: member for base in bases
            for name, member in vars(base).items()}


def own_methods(owner):
    """
    Yield name and function of the public methods that a class defines.

    Those of photutils that it wraps have photutils' documentation.
    """
    for name, member in own_members(owner).items():
        function = getattr(member, '__func__', member)
        if (not name.startswith('_') and inspect.isfunction(function)
                and function.__module__.startswith('photutils_mgauss.')):
            yield name, function


METHODS = {f'{name}.{method}': function
           for name, owner in OBJECTS.items() if inspect.isclass(owner)
           for method, function in own_methods(owner)}
PROPERTIES = {f'{name}.{attribute}': member
              for name, owner in OBJECTS.items() if inspect.isclass(owner)
              for attribute, member in own_members(owner).items()
              if type(member) is property
              and not attribute.startswith('_')}
FUNCTIONS = {name: function for name, function in OBJECTS.items()
             if inspect.isfunction(function)}


@pytest.mark.parametrize('name', NAMES)
def test_every_public_name_has_a_running_example(name):
    documented = OBJECTS[name]
    if isinstance(documented, dict):  # a constant: what it holds shows it
        documented = type(next(iter(documented.values())))
        assert name in documented.__doc__
    assert '>>>' in sections(documented).get('Examples', '')


@pytest.mark.parametrize('name', [*FUNCTIONS, *METHODS])
def test_every_parameter_is_described(name):
    function = (FUNCTIONS | METHODS)[name]
    lines = sections(function).get('Parameters', '').splitlines()
    described = {word.strip(' *') for line in lines if line[:1].strip()
                 for word in line.split(' : ')[0].split(',')}
    assert set(inspect.signature(function).parameters) - {
        'self', 'cls'} <= described


@pytest.mark.parametrize('name', [*FUNCTIONS, *METHODS])
def test_what_comes_back_is_described(name):
    function = (FUNCTIONS | METHODS)[name]
    tree = inspect.getsource(function)
    returns = re.search(r'^\s+return \S', tree, re.MULTILINE)
    assert not returns or 'Returns' in sections(function)


@pytest.mark.parametrize('name', [*FUNCTIONS, *METHODS])
def test_the_errors_of_a_call_are_described(name):
    function = (FUNCTIONS | METHODS)[name]
    if CHECKS.search(inspect.getsource(function)):
        assert 'Raises' in sections(function)


@pytest.mark.parametrize('name', PROPERTIES)
def test_every_property_says_what_it_is(name):
    assert (PROPERTIES[name].__doc__ or '').strip().endswith('.')
