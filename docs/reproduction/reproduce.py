"""
Repeat the figures and tables of Nie et al. on simulated images.

    python docs/reproduction/reproduce.py [--quick] [--figures fig3,fig9]

Tables (ECSV), figures (PNG) and a page, summary.rst, are written to a folder.
What is there already, made with the same settings, is not measured again.
Other programs are run where they are installed, and left out with a line
where not; --peers tells how to install each.
"""
import argparse
import sys
import time
import warnings
from pathlib import Path

import crowded_figures
import map_figures
import psf_figures
import sky_figures
import summary
import table_figures
from peers import INSTALL
from settings import FULL, QUICK, optics
from store import Run

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
    parser.add_argument('--quick', action='store_true',
                        help='small images and few sources: minutes')
    parser.add_argument('--output', type=Path, metavar='FOLDER',
                        default=Path('mgauss_reproduction'),
                        help='where results go (%(default)s)')
    parser.add_argument('--figures', type=lambda text: text.split(','),
                        default=list(ORDER), metavar='NAMES',
                        help=f'some of {",".join(ORDER)}')
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
    settings = QUICK if options.quick else FULL
    run = Run(settings, options.optics, options.output, options.redo,
              options.crowdsource_python)
    done = {}
    for group in GROUPS:
        chosen = [one for one in group.figures if one.key in options.figures]
        if chosen:
            done |= make(run, group, chosen)
    summary.write(run, [done[key] for key in ORDER if key in done],
                  command(options))
    for name, why in run.skipped.items():
        print(f'left out: {name}: {why}')
    print(f'{len(done)} figures and tables and summary.rst are in '
          f'{run.folder}')
    return 0


def make(run, group, chosen):
    """Measure a group and draw its figures; return these and their lines."""
    start = time.perf_counter()
    done = {}
    with warnings.catch_warnings():
        # Photutils reports stars that do not converge, one by one.
        warnings.simplefilter('ignore')
        tables = group.measure(run)
        for figure in chosen:
            if figure.draw is not None:
                run.figure(figure.key, figure.draw(tables))
            done[figure.key] = figure, figure.compare(tables)
    print(f'{", ".join(done)}: {time.perf_counter() - start:.0f} s',
          flush=True)
    return done


def command(options):
    """Return the command that makes the same results."""
    words = ['python docs/reproduction/reproduce.py']
    if options.quick:
        words.append('--quick')
    if options.crowdsource_python:
        words.append('--crowdsource-python PYTHON')
    if len(options.figures) < len(ORDER):
        words.append(f'--figures {",".join(options.figures)}')
    return ' '.join(words)


if __name__ == '__main__':
    sys.exit(main())
