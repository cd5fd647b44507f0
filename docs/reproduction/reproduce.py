"""
Repeat the figures and tables of Nie et al. on simulated images.

    python docs/reproduction/reproduce.py [--size SIZE] [--figures fig3,fig9]

Tables (ECSV), figures (SVG and PDF) and a page, summary.rst, are written to a
folder. What is there already, made with the same settings, is not measured
again: a run that was stopped goes on where it was. What was made for other
figures stays on the page, also where its size is another.
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
OPTICS = ('galsim', 'mixtures')
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
                        help='measure what these need, and what is measured '
                        f'with it: some of {",".join(ORDER)}')
    parser.add_argument('--seeds', type=int, default=1, metavar='N',
                        help='draw and measure everything N times '
                        '(%(default)s)')
    parser.add_argument('--redo', action='store_true',
                        help='measure again what is there')
    parser.add_argument('--optics', choices=OPTICS,
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
    for seed in range(options.seeds):
        for group in GROUPS:
            if any(one.key in options.figures for one in group.figures) and (
                    seed == 0 or group.random):
                measure(of_seed(run, seed), group)
    parts = {group.name: found for group in GROUPS
             if (found := stored(options, group))}
    done, skipped = draw_all(parts)
    summary.write(options.output, parts, done, ORDER, skipped,
                  options.crowdsource_python)
    for name, why in skipped.items():
        print(f'left out: {name}: {why}')
    print(f'{len(done)} figures and tables and summary.rst are in '
          f'{run.folder}')
    return 0


def of_seed(run, seed):
    """Return the run that measures everything with another seed."""
    if seed == 0:
        return run
    return replace(run, seed=seed, skipped={}, made=[],
                   folder=run.folder / f'seed_{seed}')


def measure(run, group):
    """Return the tables of a group, measured unless they are stored."""
    before = len(run.made)
    with warnings.catch_warnings(), run.step(group.name):
        # Photutils reports stars that do not converge, one by one.
        warnings.simplefilter('ignore')
        tables = group.measure(run)
        wall, cpu = run.cost()
    if len(run.made) > before:
        print(f'{group.name}, seed {run.seed}: {wall:.0f} s, {cpu:.0f} s of '
              'CPU', flush=True)
    return tables


def stored(options, group):
    """
    Return the runs of all seeds whose tables of a group are in the folder.

    They may be of another size than the one that was asked for: a folder
    keeps what was made for other figures.
    """
    sizes = [options.size, *(name for name in SIZES if name != options.size)]
    for size in sizes:
        for kind in OPTICS:
            run = Run(SIZES[size], kind, options.output)
            if group.stored(run):
                others = [of_seed(run, int(path.name.partition('_')[2]))
                          for path in sorted(run.folder.glob('seed_*'))]
                return [run, *(one for one in others if group.random
                               and group.stored(one))]
    return []


def draw_all(parts):
    """
    Draw the figures of the runs of each group.

    Returns by key the name of the group, a figure and its lines for each
    seed; and what was left out.
    """
    done, skipped = {}, {}
    for group in GROUPS:
        tables = [measure(run, group) for run in parts.get(group.name, [])]
        for figure in group.figures if tables else ():
            if figure.draw is not None:
                with style.context(STYLE):
                    parts[group.name][0].figure(figure.key,
                                                figure.draw(tables[0]))
            done[figure.key] = (group.name, figure, [
                figure.compare(one) for one in tables])
        for run in parts.get(group.name, ())[:1]:
            skipped |= run.skipped
    return done, skipped


if __name__ == '__main__':
    sys.exit(main())
