"""The command ``mgauss``."""
import argparse
import sys
from pathlib import Path

from tqdm import tqdm

from photutils_mgauss import __version__


def main(argv=None):
    """
    Run the command line.

    Parameters
    ----------
    argv : sequence of str, optional
        The arguments; by default those of the process.

    Returns
    -------
    int
        The exit code: 0 if all went well, 1 if an error was reported.
    """
    options = _parser().parse_args(argv)
    try:
        options.run(options)
    except (OSError, ValueError) as error:
        print(f'mgauss: {error}', file=sys.stderr)
        return 1
    return 0


def _parser():
    parser = argparse.ArgumentParser(
        prog='mgauss', description='Positions, fluxes and proper motions '
        'with PSFs made of Gaussians.')
    parser.add_argument('--version', action='version', version=__version__)
    commands = parser.add_subparsers(required=True, metavar='COMMAND')
    _add_demo(commands)
    return parser


def _add_demo(commands):
    demo = commands.add_parser(
        'demo', help='simulate a field at several epochs and measure it',
        description='Simulate a small field at several epochs, make the PSF '
        'of each image from its own stars, measure all stars, align the '
        'epochs on quasars, fit proper motions, and compare them with the '
        'truth.', epilog='example: mgauss demo --epochs 3 --output my_demo')
    demo.add_argument('--output', default='mgauss_demo', metavar='FOLDER',
                      help='where files go (default: %(default)s)')
    demo.add_argument('--epochs', type=int, choices=range(2, 8), default=5,
                      help='number of epochs (default: %(default)s)')
    demo.add_argument('--size', type=int, default=1024, metavar='PIXELS',
                      help='side of the detector (default: %(default)s)')
    demo.add_argument('--seed', type=int, default=1,
                      help='of the simulation (default: %(default)s)')
    demo.add_argument('--overwrite', action='store_true',
                      help='replace files of an earlier run')
    demo.add_argument('--quiet', action='store_true',
                      help='no progress bars')
    demo.set_defaults(run=_run_demo)


def _run_demo(options):
    folder = Path(options.output)
    if folder.exists() and any(folder.iterdir()) and not options.overwrite:
        msg = (f'{folder} has files in it; choose another --output or add '
               '--overwrite')
        raise FileExistsError(msg)
    from photutils_mgauss import _demo

    def progress(steps, words):
        return tqdm(steps, desc=f'{words:10}', unit='epoch',
                    disable=options.quiet)

    density = (options.size / 1024) ** 2
    settings = _demo.Settings(
        n_epochs=options.epochs, size=options.size, seed=options.seed,
        n_stars=round(350 * density), n_qsos=round(120 * density))
    sources, scenes = _demo.take_images(settings, progress)
    measured = [_demo.measure(scene) for scene in progress(scenes, 'measure')]
    result = _demo.find_motions(measured, sources)
    paths = _demo.write(result, folder) + _draw(result, folder)
    print('\n'.join(_demo.summary(result)))
    print(f'\n{len(paths)} files in {folder}')


def _draw(result, folder):
    """Draw the two figures if matplotlib is there; return their paths."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        print('no figures: matplotlib is not installed')
        return []
    from photutils_mgauss import _demo
    paths = []
    for name, plot in (('positions', _demo.plot_positions),
                       ('motions', _demo.plot_motions)):
        figure = Figure(figsize=(9, 4), layout='constrained')
        plot(result, figure.subplots(1, 2))
        paths.append(folder / f'{name}.png')
        figure.savefig(paths[-1], dpi=150)
    return paths
