"""The command ``mgauss``."""
import argparse
import sys
import warnings

from tqdm import tqdm

from photutils_mgauss import __version__
from photutils_mgauss.cli import (
    compile_command,
    demo_command,
    motions,
    photometry,
    psf,
    report,
)

_COMMANDS = (psf, photometry, motions, report, demo_command, compile_command)

_EPILOG = """\
From two images to proper motions and a page that shows them:

  mgauss psf night1.fits night2.fits
  mgauss photometry night1.fits night2.fits --psf night?_psf.fits
  mgauss motions night1_cat.ecsv night2_cat.ecsv
  mgauss report night?_psf.fits night?_cat.ecsv mgauss_motions

mgauss COMMAND --help explains each. Exit codes: 0 all went well, 1 an error
was reported, 2 wrong usage.
"""


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
    with warnings.catch_warnings():
        if not sys.warnoptions:
            warnings.simplefilter('default')
        warnings.showwarning = _show_warning
        try:
            options.run(options)
        except (OSError, ValueError, TypeError, RuntimeError) as error:
            _complain(error)
            return 1
        except KeyboardInterrupt:
            _complain('interrupted')
            return 130
    return 0


def _parser():
    parser = argparse.ArgumentParser(
        prog='mgauss', description='Positions, fluxes and proper motions '
        'with PSFs made of Gaussians.', epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--version', action='version', version=__version__)
    commands = parser.add_subparsers(required=True, metavar='COMMAND',
                                     dest='command')
    for module in _COMMANDS:
        module.add(commands)
    return parser


def _complain(words):
    tqdm.write(f'mgauss: {words}', file=sys.stderr)


def _show_warning(message, *_, **__):
    _complain(f'warning: {message}')
