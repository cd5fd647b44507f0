"""Tables and figures in a folder, each made once for the same settings."""
import datetime as dt
import json
import platform
import resource
import shutil
import subprocess
import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from itertools import pairwise
from pathlib import Path

import numpy as np
from astropy.table import QTable, Table

PACKAGES = ('photutils_mgauss', 'numpy', 'scipy', 'numba', 'astropy',
            'photutils', 'gwcs', 'pymc', 'matplotlib', 'galsim', 'sep')


# What all tables of a folder were made with and cost, those that are not
# kept, too.
NOTES = 'measured.json'


@dataclass(frozen=True)
class Run:
    """
    One call of the command: its sizes, its folder, its peers.

    Attributes
    ----------
    settings : Settings
        How much is simulated.
    optics : str
        How the true PSF is made, 'galsim' or 'mixtures'.
    folder : `~pathlib.Path`
        Where results go.
    redo : bool
        Whether to measure again what is there.
    crowdsource_python : str or None
        An interpreter that has crowdsource.
    seed : int
        What is added to all seeds, 0 for the results that are shown.
    skipped : dict
        What was left out, and why; filled on the way.
    made : list of str
        The tables that this call has measured; filled on the way.
    steps : list of str
        The steps that are under way, the last one now; changed on the way.
    within : list of float
        Wall and CPU time [s] of the tables that were measured within the one
        that is under way; changed on the way.
    """

    settings: object
    optics: str
    folder: Path
    redo: bool = False
    crowdsource_python: str | None = None
    seed: int = 0
    skipped: dict = field(default_factory=dict)
    made: list = field(default_factory=list)
    steps: list = field(default_factory=lambda: ['none'])
    within: list = field(default_factory=lambda: [0.0, 0.0])

    @property
    def fingerprint(self):
        """What a stored table must have been made with to be used again."""
        return (f'{self.settings.of(self.steps[-1])}, '
                f'optics={self.optics!r}, seed={self.seed}')

    def table(self, name, function, *, keep=True):
        """
        Return a stored table, or measure and store it.

        Those that are not kept are needed only to measure others from.
        """
        path = self.folder / ('tables' if keep else 'partial') / f'{name}.ecsv'
        if (not self.redo or name in self.made) and self.holds(path):
            return QTable.read(path)
        self.made.append(name)
        before, outer = (time.perf_counter(), _cpu_seconds()), self.within[:]
        self.within[:] = 0.0, 0.0
        # What is measured again from must keep all its digits.
        table = _rounded(function()) if keep else QTable(function())
        spent = time.perf_counter() - before[0], _cpu_seconds() - before[1]
        # The tables that were measured on the way have their own costs.
        wall, cpu = np.subtract(spent, self.within).round(2).tolist()
        self.within[:] = np.add(outer, spent)
        note = {'settings': self.fingerprint, **provenance()}
        table.meta |= note
        path.parent.mkdir(parents=True, exist_ok=True)
        table.write(path, overwrite=True)
        self._note(name, {**note, 'wall': wall, 'cpu': cpu})
        return table

    def holds(self, path):
        """Whether a table is stored that has what this step is told."""
        return path.exists() and (
            _settings(path, path.stat().st_mtime_ns) == self.fingerprint)

    def figure(self, name, figure):
        """Store a figure as vectors, in the two formats that journals take."""
        for kind, none in (('svg', 'Date'), ('pdf', 'CreationDate')):
            path = self.folder / 'figures' / f'{name}.{kind}'
            path.parent.mkdir(parents=True, exist_ok=True)
            figure.savefig(path, metadata={none: None})

    @contextmanager
    def step(self, name):
        """Say to which step the tables belong that are measured within."""
        self.steps.append(name)
        try:
            yield
        finally:
            self.steps.pop()

    def _note(self, name, note):
        """Keep what a table was made with and its cost, whatever its fate."""
        path = self.folder / NOTES
        notes = _read_notes(path)
        # A run of another size that is stopped leaves these as they are.
        notes[f'{self.settings.name} {name}'] = note
        path.write_text(json.dumps(notes, indent=0, sort_keys=True) + '\n')

    def notes(self):
        """Return what is noted of each table of the step under way."""
        return [one for one in _read_notes(self.folder / NOTES).values()
                if one['settings'] == self.fingerprint]

    def cost(self):
        """
        Return wall and CPU time [s] of the step under way.

        They are summed over its tables, so that a run that was stopped and
        went on counts all its parts.
        """
        notes = self.notes()
        return tuple(sum(one[key] for one in notes)
                     for key in ('wall', 'cpu'))


def _read_notes(path):
    return json.loads(path.read_text()) if path.exists() else {}


@cache
def _settings(path, _changed):
    """Return what a table was made with, read once while it is as it is."""
    return QTable.read(path).meta.get('settings')


def _cpu_seconds():
    """Return the CPU time of this process and of the programs it ran."""
    return sum(used.ru_utime + used.ru_stime for used in (
        resource.getrusage(resource.RUSAGE_SELF),
        resource.getrusage(resource.RUSAGE_CHILDREN)))


def _rounded(table):
    """Return a copy whose floats have five digits after the first."""
    table = QTable(table, copy=True)
    for name in table.colnames:
        values = np.asarray(getattr(table[name], 'value', table[name]))
        if values.dtype.kind == 'f':
            digits = np.vectorize(lambda v: float(f'{v:.5e}'), otypes=[float])
            unit = getattr(table[name], 'unit', None)
            short = digits(values) if values.size else values
            table[name] = short if unit is None else short * unit
    return table


def provenance():
    """Return date, versions and machine."""
    return {'date': dt.datetime.now(tz=dt.UTC).date().isoformat(),
            'python': platform.python_version(),
            'machine': platform.machine(), **versions()}


def versions():
    """Return the version of each package that is installed."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return {**found, 'photutils_mgauss': _code_version()}


@cache
def _code_version():
    """
    Return the version of the code that runs.

    In a checkout that is its revision: what an installation noted may be
    another one.
    """
    import photutils_mgauss
    git = shutil.which('git')
    done = git and subprocess.run(
        [git, '-C', Path(photutils_mgauss.__file__).parent, 'describe',
         '--always', '--dirty', '--exclude=*'], text=True, check=False,
        capture_output=True)
    if not done or done.returncode:
        return photutils_mgauss.__version__
    return f'revision {done.stdout.strip()}'


@dataclass(frozen=True)
class Comparison:
    """
    A number of ours beside the one that is printed.

    Attributes
    ----------
    quantity : str
        What is compared. It has no measured number in it, so that it is the
        same for each seed.
    printed, ours : str
        The number of the paper, and ours in the paper's definition.
    verdict : str
        What to think of it.
    """

    quantity: str
    printed: str
    ours: str
    verdict: str = ''

    @classmethod
    def below(cls, quantity, printed, value, *, unit='', why='', method=True,
              full=False):
        """
        Compare a number that should not exceed the printed one.

        It is called reached only where method and conditions are those of
        the paper.
        """
        return cls(quantity, f'{printed:g} {unit}'.strip(),
                   f'{value:.2f} {unit}'.strip(),
                   judged(value <= printed, why, method=method, full=full))


def judged(good, why, *, method, full):
    """Return the word for a comparison with the paper."""
    if not good:
        return f'worse: {why}' if why else 'worse'
    if not method:
        return 'better by another method'
    return 'reached' if full else 'better, in a smaller field'


@dataclass(frozen=True)
class Figure:
    """
    A figure or table of the paper.

    Attributes
    ----------
    key : str
        Its name on the command line.
    title, text : str
        What it is, and what is done here.
    draw : callable or None
        From the tables of the group to a matplotlib figure.
    compare : callable
        From the tables to a list of `Comparison`.
    """

    key: str
    title: str
    text: str
    draw: object
    compare: object = staticmethod(lambda tables: [])


@dataclass(frozen=True)
class Group:
    """
    Figures that are drawn from the same measurement.

    ``tables`` names those that figures and page are made from, and
    ``random`` tells whether another seed changes them.
    """

    name: str
    measure: object
    figures: tuple
    tables: tuple
    random: bool = True

    def stored(self, run):
        """Whether all tables are stored that the figures are made from."""
        with run.step(self.name):
            return all(run.holds(run.folder / 'tables' / f'{name}.ecsv')
                       for name in self.tables)


def binned(magnitude, edges):
    """Yield the lower edge and the rows of each bin of magnitudes."""
    magnitude = np.asarray(magnitude, float)
    for low, high in pairwise(edges):
        yield low, (magnitude >= low) & (magnitude < high)


def spread(values):
    """Return 1.4826 times the median of absolute values."""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    return 1.4826 * np.median(np.abs(values)) if values.size else np.nan


def plain(table):
    """Return a table without units."""
    return Table({name: np.asarray(getattr(table[name], 'value', table[name]))
                  for name in table.colnames})
