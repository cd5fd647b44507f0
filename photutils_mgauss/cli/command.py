"""The command ``mgauss``."""
import argparse
import re
import sys
from difflib import get_close_matches

from photutils_mgauss import __version__
from photutils_mgauss.cli import (
    compile_command,
    demo_command,
    info,
    motions,
    photometry,
    psf,
    report,
    survey,
)
from photutils_mgauss.cli.running import run_command

_COMMANDS = (psf, photometry, motions, report, survey, info, demo_command,
             compile_command)

_EPILOG = """\
From two images to proper motions and a page that shows them:

  mgauss psf night1.fits night2.fits
  mgauss photometry night1.fits night2.fits --psf night?_psf.fits
  mgauss motions night1_cat.ecsv night2_cat.ecsv
  mgauss report night?_psf.fits night?_cat.ecsv mgauss_motions

mgauss COMMAND --help explains each. Exit codes: 0 all went well, 1 an error
was reported, 2 wrong usage, 130 interrupted (Ctrl-C), 143 terminated.
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
        The exit code: 0 if all went well, 1 if an error was reported, 130 if
        the command was interrupted.
    """
    parser = make_parser()
    words = sys.argv[1:] if argv is None else list(argv)
    if not words:
        parser.exit(2, parser.format_help())
    _check_command(parser, words[0])
    options, unknown = parser.parse_known_args(words)
    if unknown:
        options.parser.error(_unknown(options.parser, unknown))
    return run_command(options, words, is_process=argv is None)


def _check_command(parser, word):
    """End with a sentence if the first word is no command."""
    names = [module.__name__.rpartition('.')[2].removesuffix('_command')
             for module in _COMMANDS]
    if word.startswith('-') or word in names:
        return
    near = ([name for name in names if name.startswith(word)]
            or get_close_matches(word, names, 1))
    meant = f' (did you mean {near[0]}?)' if near else ''
    parser.error(f'unknown command: {word}{meant}; there are '
                 f'{", ".join(names)}')


def _unknown(parser, words):
    """Say which arguments are not known, and what may have been meant."""
    text = f'unrecognized arguments: {" ".join(words)}'
    known = re.findall(r'--[a-z-]+', parser.format_help())
    near = get_close_matches(words[0].partition('=')[0], known, 1)
    return f'{text} (did you mean {near[0]}?)' if near else text


def make_parser():
    """Return the parser, from which shells can learn what completes words."""
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
