"""
Repeat the figures and tables of Nie et al. on simulated images.

    python docs/reproduction/reproduce.py [--size SIZE] [--figures fig3,fig9]

Tables (ECSV), figures (SVG and PDF) and a page, summary.rst, are written to a
folder. What is there already, made with the same settings, is not measured
again: a run that was stopped goes on where it was.
Other programs are run where they are installed, and left out with a line
where not; --peers tells how to install each.
"""
import argparse
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import crowded_figures
import map_figures
import psf_figures
import sky_figures
import summary
import table_figures
from matplotlib import style
from peers import INSTALL
from settings import SIZES, optics
from store import Run
from styles import STYLE

GROUPS = (*table_figures.GROUPS, *psf_figures.GROUPS, *map_figures.GROUPS,
          *sky_figures.GROUPS, *crowded_figures.GROUPS)
ORDER = ('table1', 'table2', 'fig1', 'fig2', 'fig3', 'fig4', 'fig5', 'fig6',
         'fig7', 'fig8', 'fig9', 'fig10', 'fig11', 'fig12', 'fig13', 'fig14',
         'appendix_a', 'appendix_b')


def arguments(argv=None):
    """Return what the command line says."""
    parser = argparse.ArgumentParser(
        description=__doc__.split('\n\n')[0].strip(),
        epilog='Example: python docs/reproduction/reproduce.py --quick '
               '--figures fig9,fig10')
    parser.add_argument('--size', choices=tuple(SIZES), default='full',
                        help='quick: minutes; half: small images, all bands '
                        'and epochs; full: whole detectors (%(default)s)')
    parser.add_argument('--quick', dest='size', action='store_const',
                        const='quick', help='the same as --size quick')
    parser.add_argument('--full', dest='size', action='store_const',
                        const='full', help='the same as --size full')
    parser.add_argument('--output', type=Path, metavar='FOLDER',
                        default=Path('mgauss_reproduction'),
                        help='where results go (%(default)s)')
    parser.add_argument('--figures', type=lambda text: text.split(','),
                        default=list(ORDER), metavar='NAMES',
                        help=f'some of {",".join(ORDER)}')
    parser.add_argument('--seeds', type=int, default=1, metavar='N',
                        help='draw and measure everything N times '
                        '(%(default)s)')
    parser.add_argument('--redo', action='store_true',
                        help='measure again what is there')
    parser.add_argument('--optics', choices=('galsim', 'mixtures'),
                        default=optics(), help='how the true PSF is made '
                        '(%(default)s here)')
    parser.add_argument('--crowdsource-python', metavar='PYTHON',
                        help='an interpreter that has crowdsource')
    parser.add_argument('--peers', action='store_true',
                        help='tell how to install other programs, and end')
    options = parser.parse_args(argv)
    unknown = sorted(set(options.figures) - set(ORDER))
    if unknown:
        parser.error(f'--figures must be some of {",".join(ORDER)}, got '
                     f'{",".join(unknown)}')
    return options


def main(argv=None):
    """Make the figures that were asked for; return the exit code."""
    options = arguments(argv)
    if options.peers:
        for name, how in INSTALL.items():
            print(f'{name}: {how}')
        return 0
    run = Run(SIZES[options.size], options.optics, options.output,
              options.redo, options.crowdsource_python)
    done, again = make_all(run, options.figures, True), []
    for seed in range(1, options.seeds):
        other = replace(run, seed=seed, skipped={}, made=[],
                        folder=run.folder / 'partial' / f'seed_{seed}')
        again.append((other, make_all(other, options.figures, False)))
    summary.write(run, [done[key] for key in ORDER if key in done],
                  [key for key in ORDER if key not in done],
                  command(options), again)
    for name, why in run.skipped.items():
        print(f'left out: {name}: {why}')
    print(f'{len(done)} figures and tables and summary.rst are in '
          f'{run.folder}')
    return 0


def make_all(run, keys, drawn):
    """Make the figures of all groups; return them and their lines by key."""
    done = {}
    for group in GROUPS:
        chosen = [one for one in group.figures if one.key in keys]
        if chosen and (drawn or group.random):
            done |= make(run, group, chosen, drawn)
    return done


def make(run, group, chosen, drawn):
    """Measure a group and draw its figures; return these and their lines."""
    done = {}
    with warnings.catch_warnings(), run.step(group.name), style.context(STYLE):
        # Photutils reports stars that do not converge, one by one.
        warnings.simplefilter('ignore')
        tables = group.measure(run)
        for figure in chosen:
            if drawn and figure.draw is not None:
                run.figure(figure.key, figure.draw(tables))
            done[figure.key] = figure, figure.compare(tables)
    wall, cpu = run.costs().get(group.name, (0, 0))
    print(f'{", ".join(done)}, seed {run.seed}: {wall:.0f} s, {cpu:.0f} s of '
          'CPU', flush=True)
    return done


def command(options):
    """Return the command that makes the same results."""
    words = ['python docs/reproduction/reproduce.py']
    words.append(f'--size {options.size}')
    if options.seeds > 1:
        words.append(f'--seeds {options.seeds}')
    if options.crowdsource_python:
        words.append('--crowdsource-python PYTHON')
    if len(options.figures) < len(ORDER):
        words.append(f'--figures {",".join(options.figures)}')
    return ' '.join(words)


if __name__ == '__main__':
    sys.exit(main())
