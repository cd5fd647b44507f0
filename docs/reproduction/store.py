"""Tables and figures in a folder, each made once for the same settings."""
import datetime as dt
import platform
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from itertools import pairwise
from pathlib import Path

import numpy as np
from astropy.table import QTable, Table

# The colours of Okabe and Ito, and marks that differ as well.
COLOURS = ('#0072B2', '#E69F00', '#009E73', '#CC79A7', '#D55E00', '#56B4E9',
           '#000000', '#999999', '#F0E442')
MARKS = 'os^Dv*Pxh'

PACKAGES = ('photutils_mgauss', 'numpy', 'scipy', 'numba', 'astropy',
            'photutils', 'gwcs', 'pymc', 'matplotlib', 'galsim', 'sep')


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
    skipped : dict
        What was left out, and why; filled on the way.
    """

    settings: object
    optics: str
    folder: Path
    redo: bool = False
    crowdsource_python: str | None = None
    skipped: dict = field(default_factory=dict)

    @property
    def fingerprint(self):
        """What a stored table must have been made with to be used again."""
        return f'{self.settings}, optics={self.optics!r}'

    def table(self, name, function, *, keep=True):
        """Return a stored table, or measure and store it."""
        path = self.folder / ('tables' if keep else 'partial') / f'{name}.ecsv'
        if path.exists() and not self.redo:
            found = QTable.read(path)
            if found.meta.get('settings') == self.fingerprint:
                return found
        table = _rounded(function())
        table.meta |= {'settings': self.fingerprint, **provenance()}
        path.parent.mkdir(parents=True, exist_ok=True)
        table.write(path, overwrite=True)
        return table

    def figure(self, name, figure):
        """Store a figure."""
        path = self.folder / 'figures' / f'{name}.png'
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=80)


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
    if 'photutils_mgauss' not in found:
        from photutils_mgauss import __version__
        found = {'photutils_mgauss': __version__, **found}
    return found


@dataclass(frozen=True)
class Comparison:
    """A number of ours beside the one that is printed, in words."""

    quantity: str
    printed: str
    ours: str
    verdict: str = ''

    @classmethod
    def below(cls, quantity, printed, value, *, unit='', why=''):
        """Compare a number that should not exceed the printed one."""
        verdict = 'reached' if value <= printed else f'worse: {why}'
        return cls(quantity, f'{printed:g} {unit}'.strip(),
                   f'{value:.2f} {unit}'.strip(), verdict)


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
    """Figures that are drawn from the same measurement."""

    name: str
    measure: object
    figures: tuple


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
