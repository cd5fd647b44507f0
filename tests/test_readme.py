"""What README.md shows runs, and what it promises is there."""
import re
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest

README = (Path(__file__).parents[1] / 'README.md').read_text(encoding='utf-8')
COMMANDS = dict(re.findall(
    r'<!-- command: (\w+) -->\n```sh\n(.+)\n```', README))


def test_the_example_measures_its_stars_to_their_errors(capsys):
    (code,) = re.findall(r'```python\n(.*?)```', README, re.DOTALL)
    names = {}
    exec(compile(code, 'README.md', 'exec'), names)
    stars, result = names['stars'], names['result']
    assert 'x_fit' in capsys.readouterr().out
    for key, truth in (('x', 'x_0'), ('y', 'y_0'), ('flux', 'flux')):
        pull = (result[f'{key}_fit'] - stars[truth]) / result[f'{key}_err']
        assert np.all(np.abs(pull) < 4)
    assert np.all(result['flags'] == 0)


def test_there_are_two_commands():
    assert set(COMMANDS) == {'demo', 'test'}


@pytest.mark.parametrize('command', COMMANDS.values(), ids=COMMANDS.keys())
def test_a_command_makes_its_own_environment(command):
    assert command.startswith('"${PYTHON:-python3}" -m venv ')
    assert 'pip install' in command


def test_the_command_of_the_main_job_is_installed():
    scripts = entry_points(group='console_scripts', name='mgauss')
    if not scripts:
        pytest.skip(reason='the package is not installed here')
    (script,) = scripts
    assert callable(script.load())
