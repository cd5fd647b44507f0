"""The page: every figure with its numbers beside the printed ones."""
import textwrap

from peers import INSTALL, program_versions
from store import provenance

_HEAD = """\
The paper reproduced: results
=============================

.. This page is written by docs/reproduction/reproduce.py.

Made on {date} with ``{command}``, with

{versions}

{sizes}

What a figure shows is stored in the tables below it, with date, versions and
settings in their headers. *Reached* means that our number is not larger than
the printed one. Simulations have one seed each: numbers of another seed
differ by their statistical errors, which for a bin of n stars are about
1.2 / sqrt(n) of a scatter.

{skipped}
"""

_OPTICS = {
    'galsim': 'that of GalSim, through ``Optics``: a 2 m pupil at two '
              'wavelengths, with aberrations of its own for each detector',
    'mixtures': 'a field of mixtures, ``csst_psf``, because GalSim is not '
                'installed; it is kinder to fits of Gaussians than real '
                'optics are',
}


def write(run, done, command):
    """Write the page of the figures that were made."""
    parts = [_head(run, command)]
    parts += [_section(run, figure, lines, command)
              for figure, lines in done]
    (run.folder / 'summary.rst').write_text('\n'.join(parts))


def _head(run, command):
    found = provenance() | program_versions(run.crowdsource_python)
    versions = ', '.join(f'{name} {value}' for name, value in found.items()
                         if name not in ('date', 'machine'))
    s = run.settings
    sizes = (
        f'The true PSF of the images is {_OPTICS[run.optics]}. Detectors '
        f'are smaller than in the paper: {s.size} pixels on a side in '
        f'Figs. 1 to 7, with {s.grid} x '
        f'{s.grid} places on each of {len(s.detectors)} detectors in place '
        f'of 30 x 30 on 18; {s.sky_size} in Figs. 8 to 12, with '
        f'{s.sources[0]} stars and {s.sources[1]} quasars, of which '
        f'{s.references} are references; {s.crowded_size} in Figs. 13 and '
        f'14. The whole variation of the PSF is squeezed into each. A PSF '
        f'is made of at most {s.psf_stars} stars of one exposure, the '
        "paper's of those of 135.")
    return _HEAD.format(
        date=found['date'], command=command, versions=_filled(versions),
        sizes=_filled(sizes), skipped=_skipped(run))


def _filled(text, width=78):
    return textwrap.fill(text, width, break_long_words=False)


def _skipped(run):
    if not run.skipped:
        return 'Nothing was left out.'
    lines = ['Left out:', '']
    for name, why in run.skipped.items():
        lines.append(f'* {name}: {why or INSTALL[name]}.')
    return '\n'.join(lines)


def _section(run, figure, lines, command):
    base, _, _ = command.partition(' --figures')
    own = f'{base} --figures {figure.key}'
    rows = [figure.title, '-' * len(figure.title), '', _filled(figure.text),
            '', f'Made by ``{own}``.', '']
    if figure.draw is not None:
        rows += [f'.. image:: figures/{figure.key}.png',
                 f'   :alt: {figure.title}', '']
    if lines:
        rows += _table(lines)
    tables = sorted(path.name for path in (run.folder / 'tables').glob(
        f'{_prefix(figure.key)}*.ecsv'))
    if tables:
        rows.append('Tables: ' + ', '.join(
            f':download:`{name} <tables/{name}>`' for name in tables) + '.')
    return '\n'.join([*rows, ''])


# Figures that share tables: how the names of these begin.
_SHARED = {'fig2': 'fig1_', 'fig4': 'fig4_', 'fig5': 'fig4_',
           'fig6': 'fig4_', 'fig7': 'fig4_', 'fig9': 'fig9_',
           'fig10': 'fig9_', 'fig13': 'none'}


def _prefix(key):
    return _SHARED.get(key, f'{key}_')


def _table(lines):
    rows = ['.. list-table::', '   :header-rows: 1',
            '   :widths: 46 20 22 12', '', '   * - Quantity',
            '     - Printed', '     - Ours', '     - Judgement']
    for line in lines:
        rows += [f'   * - {line.quantity}', f'     - {line.printed}',
                 f'     - {line.ours}', f'     - {line.verdict}'.rstrip()]
    return [*rows, '']
