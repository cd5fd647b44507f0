"""The page: every figure with its numbers beside the printed ones."""
import re
import textwrap

import numpy as np
from peers import program_versions
from settings import FULL
from store import PACKAGES

_HEAD = """\
The paper reproduced: results
=============================

.. This page is written by docs/reproduction/reproduce.py.

Each figure says of which size its run was, when it was measured and by which
revision; others were on the machine:

{versions}.

{sizes}

The true PSF of the images is {optics}. The whole variation of the PSF over a
detector is in each image, also in small ones.
All effects of the detectors that the paper lists are on in all images, and
are calibrated and masked as :doc:`/simulation` says.
{repel}
What a figure shows is stored in the tables below it, with date, versions and
settings in their headers.

A judgement is *reached* only where our number is not larger than the printed
one, the method is that of the paper and the images have its size; *better, in
a smaller field* where only the size differs; *better by another method* where
the number is that of a method which the paper does not use. Where another
seed was drawn and measured, the column *again* has its numbers, and *spread*
is what the two say of the standard deviation of one, their difference over
the root of 2; where it is missing there is one seed, and another one gives
other numbers.

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


def write(folder, parts, done, order, skipped, crowdsource_python=None):
    """
    Write the page of the figures whose tables are in a folder.

    Parameters
    ----------
    folder : `~pathlib.Path`
        Where results are.
    parts : dict
        The runs of all seeds, the one that is shown first, by group.
    done : dict
        Its group, a figure and its lines for each seed, by key.
    order : tuple of str
        The keys of all figures, in the order of the page.
    skipped : dict
        What was left out, and why.
    crowdsource_python : str or None
        An interpreter that has crowdsource.
    """
    page = [_head(parts, [key for key in order if key not in done], skipped,
                  crowdsource_python)]
    for key in order:
        if key in done:
            name, figure, lines = done[key]
            page.append(_section(folder, parts[name], name, figure, lines))
    (folder / 'summary.rst').write_text('\n'.join(page))


def _head(parts, missing, skipped, crowdsource_python):
    notes = _notes(parts)
    optics = sorted({run.optics for runs in parts.values() for run in runs})
    versions = {name: _values(notes, name) for name in (
        'python', *PACKAGES) if name != 'photutils_mgauss'}
    versions |= program_versions(crowdsource_python)
    repel = ('Charge repels charge (brighter-fatter) in all of them.'
             if optics == ['galsim'] else
             'The brighter-fatter effect is off where GalSim is not '
             'installed.')
    return _HEAD.format(
        versions=_filled(', '.join(f'{name} {value}' for name, value in
                                   versions.items() if value)),
        sizes=_sizes(parts), repel=repel,
        optics=_filled(', or '.join(_OPTICS[one] for one in optics)),
        skipped=_skipped(skipped, missing), costs=_costs(parts))


def _notes(parts):
    """Return what is noted of the tables of all runs."""
    return [note for name, runs in parts.items() for run in runs
            for note in _of(name, run)]


def _of(name, run):
    with run.step(name):
        return run.notes()


def _values(notes, name):
    """Return the values of a name that tables note, in words."""
    return ' and '.join(sorted({note[name] for note in notes
                                if name in note}))


def _sizes(parts):
    """Return a table of what was simulated, and of what the paper has."""
    rows = ['.. list-table::', '   :header-rows: 1', '   :widths: 16 10 37 37',
            '']
    rows += _row(['Figures', 'Size', 'This page', 'The paper'])
    for name, (figures, paper) in PAPER.items():
        if name in parts:
            settings = parts[name][0].settings
            rows += _row([figures, settings.name, _size(name, settings),
                          paper])
    return '\n'.join(rows)


def _square(shape):
    return f'{shape[1]} x {shape[0]} pixels'


def _stars(s):
    """Return what a PSF is made of, in words."""
    field = ('at random places, with the magnitudes of ``sky_field``'
             if s.spacing is None else
             'apart, of which 28 % are of 18 to 20.5 mag')
    return (f'the PSF from those of {s.psf_sources} stars {field}, that are '
            f'bright and alone, at most {s.psf_stars}')


# By group: its figures, and what the paper has of all that a run may have
# less of.
PAPER = {
    'psf': ('1 to 3, Appendix B',
            '9216 x 9232 pixels; 3400 sources of 135 pointings'),
    'posterior': ('Appendix A', 'one PSF'),
    'maps': ('4 to 7', '18 such detectors, 30 x 30 places on each'),
    'sky': ('8 to 12',
            'such a detector; 614 stars, 590 quasars, 100 references'),
    'crowded': ('13 and 14', '9216 x 9232 pixels with 5.4 million stars'),
}


def _size(name, s):
    """Return what a run of a size simulates for a group, in words."""
    if name == 'psf':
        return f'{_square(s.shape)}; {_stars(s)}'
    if name == 'posterior':
        return f'the same; two chains of {s.draws} draws'
    if name == 'maps':
        return (f'{len(s.detectors)} detectors of {_square(s.shape)}, '
                f'{s.grid} x {s.grid} places on each; {_stars(s)}')
    if name == 'sky':
        return (f'{_square(s.sky_shape)}, {s.sources[0]} stars and '
                f'{s.sources[1]} quasars, {s.references} references; '
                f'{_stars(s)}; bootstraps of {s.resamplings}')
    return (f'{_square(s.crowded_shape)} with the density of the paper; '
            f'{_stars(s)}')


def _costs(parts):
    """Return the table of what steps cost, seed by seed."""
    seeds = max(len(runs) for runs in parts.values())
    rows = ['.. list-table::', '   :header-rows: 1', '']
    rows += _row(['Step', 'Size', *(f'{kind}, seed {k} [s]' for k in
                                    range(seeds) for kind in ('Wall', 'CPU')),
                  'CPU of a full run [h]'])
    total = 0.0
    for name, runs in sorted(parts.items()):
        cells, settings = [], runs[0].settings
        for run in runs:
            with run.step(name):
                cells += run.cost()
        hours = cells[1] * full_work(name, settings) / 3600
        total += hours
        words = [f'{one:.0f}' for one in cells]
        words += [''] * (2 * seeds - len(cells))
        rows += _row([name, settings.name, *words, f'{hours:.2f}' + (
            '' if settings is FULL or name == 'tables' else ', estimated')])
    rows += _row(['together', '', *[''] * (2 * seeds), f'{total:.2f}'])
    return '\n'.join(rows)


def full_work(name, settings):
    """
    Return how much more work a step of a full run is than that of a run.

    Noise and detection go with pixels, and fits of PSFs with the stars that
    make them; the crowded field goes with its area.
    """
    stars = FULL.psf_sources / settings.psf_sources
    pixels = np.prod(FULL.shape) / np.prod(settings.shape)
    maps = (FULL.grid / settings.grid)**2
    share = len(FULL.detectors) / len(settings.detectors)
    # Of a detector, a tenth is pixels, a third grids, the rest stars.
    detector = 0.1 * pixels + 0.3 * maps + 0.6 * stars
    return {'tables': 1.0, 'posterior': FULL.draws / settings.draws,
            'psf': detector, 'maps': detector * share,
            'sky': 0.1 * pixels + 0.9 * sum(FULL.sources) / sum(
                settings.sources),
            'crowded': np.prod(FULL.crowded_shape) / np.prod(
                settings.crowded_shape)}[name]


def _filled(text, width=78):
    return textwrap.fill(text, width, break_long_words=False)


def _skipped(skipped, missing):
    lines = [f'* {name}: {why}.' for name, why in skipped.items()]
    if missing:
        lines.append(f'* {", ".join(missing)}: not measured.')
    return '\n'.join(['Left out:', '', *lines] if lines
                     else ['Nothing was left out.'])


def _section(folder, runs, name, figure, lines):
    """Return the part of the page that is about a figure."""
    notes = [note for run in runs for note in _of(name, run)]
    command = (f'python docs/reproduction/reproduce.py --size '
               f'{runs[0].settings.name} --figures {figure.key}')
    if len(runs) > 1:
        command += f' --seeds {len(runs)}'
    rows = [figure.title, '-' * len(figure.title), '', _filled(figure.text),
            '', _filled(f'Size *{runs[0].settings.name}*, measured on '
                        f'{_values(notes, "date")} by '
                        f'{_values(notes, "photutils_mgauss")}, with '
                        f'``{command}``.'), '']
    if figure.draw is not None:
        rows += [f'.. image:: figures/{figure.key}.svg',
                 f'   :alt: {figure.title}', '',
                 f':download:`As PDF <figures/{figure.key}.pdf>`.', '']
    if lines[0]:
        rows += _table(lines[0], lines[1:])
    tables = sorted(path.name for path in (folder / 'tables').glob(
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
