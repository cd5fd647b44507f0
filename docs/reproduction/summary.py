"""The page: every figure with its numbers beside the printed ones."""
import re
import textwrap

import numpy as np
from peers import program_versions
from settings import FULL
from store import PACKAGES

_HEAD = """\
{title}
{rule}

.. This page is written by docs/reproduction/reproduce.py.

Measured on {date} by

{versions}

with ``{command}``.

{sizes}

All effects of the detectors that the paper lists are on in all images, and
are calibrated and masked as :doc:`/simulation` says.
{repel}
What a figure shows is stored in the tables below it, with date, versions and
settings in their headers.

A judgement is *reached* only where our number is not larger than the printed
one, the method is that of the paper and the images have its size; *better, in
a smaller field* where only the size differs; *better by another method* where
the number is that of a method which the paper does not use. {seeds}

{skipped}

What each step costs
--------------------

{costs}
"""

_OPTICS = {
    'galsim': 'that of GalSim, through ``Optics``: a 2 m pupil at four '
              'wavelengths that count as the response of the band, with '
              'aberrations of its own for each detector',
    'mixtures': 'a field of mixtures, ``csst_psf``, because GalSim is not '
                'installed; it is kinder to fits of Gaussians than real '
                'optics are',
}


def write(run, done, missing, command, again):
    """Write the page of the figures that were made."""
    parts = [_head(run, missing, command, [other for other, _ in again])]
    for figure, lines in done:
        others = [one[figure.key][1] for _, one in again if figure.key in one]
        parts.append(_section(run, figure, lines, others, command))
    (run.folder / 'summary.rst').write_text('\n'.join(parts))


def _head(run, missing, command, others):
    seeds = ('Everything was drawn and measured twice: the column *again* has '
             'the numbers of the second seed, and *spread* is what the two '
             'say of the standard deviation of one, their difference over '
             'the root of 2.' if others else
             'There is one seed: another one gives other numbers.')
    repel = ('Charge repels charge (brighter-fatter) in all of them.'
             if run.optics == 'galsim' else
             'The brighter-fatter effect is off, because GalSim is not '
             'installed.')
    notes = [note for one in (run, *others) for note in one.stored()]
    title = f'The paper reproduced: results, size {run.settings.name}'
    return _HEAD.format(
        title=title, rule='=' * len(title), date=_values(notes, 'date'),
        command=command, versions=_filled(_versions(run, notes)),
        sizes=_filled(_sizes(run)), skipped=_skipped(run, missing),
        seeds=seeds, repel=repel, costs=_costs(run, others))


def _values(notes, name):
    """Return the values of a name that tables note, in words."""
    return ' and '.join(sorted({note[name] for note in notes
                                if name in note}))


def _versions(run, notes):
    """Return the versions of the code that measured the tables."""
    found = {name: _values(notes, name) for name in ('python', *PACKAGES)}
    found |= program_versions(run.crowdsource_python)
    return ', '.join(f'{name} {value}' for name, value in found.items()
                     if value)


def _sizes(run):
    """Return the size of this run, in words."""
    s = run.settings
    n = (s.size // s.spacing)**2
    return (
        f'This is the size *{s.name}*. The true PSF of the images is '
        f'{_OPTICS[run.optics]}. Images have {s.size} pixels on a side in '
        f'Figs. 1 to 7, with {s.grid} x {s.grid} places on each of '
        f'{len(s.detectors)} detectors (the paper: 9216, 30 x 30 and 18); '
        f'{s.sky_size} in Figs. 8 to 12, with {s.sources[0]} stars and '
        f'{s.sources[1]} quasars, of which {s.references} are references '
        f'(9216, 614, 590 and 100); {s.crowded_size} in Figs. 13 and 14 '
        f'(9216). The whole variation of the PSF over a detector is in each. '
        f'A PSF is made of those of {n} stars that are bright and apart, at '
        f'most {s.psf_stars} (the stars of 135 pointings: about 3400).')


def _costs(run, others):
    """Return the table of what steps cost, seed by seed."""
    each = [one.costs() for one in (run, *others)]
    rows = ['.. list-table::', '   :header-rows: 1', '', '   * - Step']
    for one in (run, *others):
        rows += [f'     - Wall, seed {one.seed} [s]',
                 f'     - CPU, seed {one.seed} [s]']
    rows.append('     - CPU of a full run, estimated [h]')
    costs = [(name, *np.ravel([one.get(name, (np.nan, np.nan))
                               for one in each]),
              each[0][name][1] * full_work(name, run.settings) / 3600)
             for name in sorted(each[0])]
    total = np.nansum([one[1:] for one in costs], axis=0)
    for name, *seconds, hours in [*costs, ('together', *total)]:
        rows += [f'   * - {name}', *(
            f'     - {one:.0f}' if np.isfinite(one) else '     -'
            for one in seconds), f'     - {hours:.2f}']
    return '\n'.join(rows)


def full_work(name, settings):
    """
    Return how much more work a step of a full run is than that of a run.

    Noise and detection go with pixels, and fits of PSFs with the stars that
    make them; the crowded field goes with its area.
    """
    stars = (FULL.size // FULL.spacing)**2 / (
        settings.size // settings.spacing)**2
    pixels = (FULL.size / settings.size)**2
    maps = (FULL.grid / settings.grid)**2
    share = len(FULL.detectors) / len(settings.detectors)
    # Of a detector, a tenth is pixels, a third grids, the rest stars.
    detector = 0.1 * pixels + 0.3 * maps + 0.6 * stars
    return {'tables': 1.0, 'posterior': FULL.draws / settings.draws,
            'psf': detector, 'maps': detector * share,
            'sky': 0.1 * pixels + 0.9 * sum(FULL.sources) / sum(
                settings.sources),
            'crowded': (FULL.crowded_size / settings.crowded_size)**2}[name]


def _filled(text, width=78):
    return textwrap.fill(text, width, break_long_words=False)


def _skipped(run, missing):
    lines = [f'* {name}: {why}.' for name, why in run.skipped.items()]
    if missing:
        lines.append(f'* {", ".join(missing)}: not asked for.')
    return '\n'.join(['Left out:', '', *lines] if lines
                     else ['Nothing was left out.'])


def _section(run, figure, lines, others, command):
    base, _, _ = command.partition(' --figures')
    own = f'{base} --figures {figure.key}'
    rows = [figure.title, '-' * len(figure.title), '', _filled(figure.text),
            '', f'Made by ``{own}``.', '']
    if figure.draw is not None:
        rows += [f'.. image:: figures/{figure.key}.svg',
                 f'   :alt: {figure.title}', '',
                 f':download:`As PDF <figures/{figure.key}.pdf>`.', '']
    if lines:
        rows += _table(lines, others)
    tables = sorted(path.name for path in (run.folder / 'tables').glob(
        f'{_prefix(figure.key)}*.ecsv'))
    if tables:
        rows.append('Tables: ' + ', '.join(
            f':download:`{name} <tables/{name}>`' for name in tables) + '.')
    return '\n'.join([*rows, ''])


# Figures that share tables: how the names of these begin.
_SHARED = {'fig2': 'fig1_', 'fig4': 'fig4_', 'fig5': 'fig4_',
           'fig6': 'fig4_', 'fig7': 'fig4_', 'fig9': 'fig9_',
           'fig10': 'fig9_'}


def _prefix(key):
    return _SHARED.get(key, f'{key}_')


def _table(lines, others):
    """Return the table of lines, with what the second seed gave."""
    other = {line.quantity: line.ours for one in others for line in one}
    names = ['Quantity', 'Printed', 'Ours', *(['Again', 'Spread'] if other
                                              else []), 'Judgement']
    widths = '36 14 15 13 10 12' if other else '42 18 22 18'
    rows = ['.. list-table::', '   :header-rows: 1', f'   :widths: {widths}',
            '']
    rows += _row(names)
    for line in lines:
        again = other.get(line.quantity, '')
        seeds = [again, spread_of(line.ours, again)] if other else []
        rows += _row([line.quantity, line.printed, line.ours, *seeds,
                      line.verdict])
    return [*rows, '']


def _row(cells):
    return [f'{"   * -" if k == 0 else "     -"} {cell}'.rstrip()
            for k, cell in enumerate(cells)]


def spread_of(ours, again):
    """
    Return how far numbers in two texts are apart, over the root of 2.

    That is the standard deviation of one, as two values give it. Numbers in
    brackets are no results.
    """
    first, second = (re.findall(r'-?\d+(?:\.\d+)?', re.sub(
        r'\(.*?\)', '', text)) for text in (ours, again))
    if len(first) != len(second):
        return ''
    found = [abs(float(a) - float(b)) / np.sqrt(2)
             for a, b in zip(first, second, strict=True)]
    digits = [len(a.partition('.')[2]) for a in first]
    return ', '.join(f'{value:.{n}f}' for value, n in zip(
        found, digits, strict=True)) if any(found) else ''
