"""The commands that a survey is made of."""
import argparse

from photutils_mgauss.cli import info, motions, photometry, psf, report


def step_parser():
    """Return a parser of these commands alone."""
    parser = argparse.ArgumentParser(prog='mgauss')
    commands = parser.add_subparsers(required=True, dest='command')
    for module in (psf, photometry, motions, info, report):
        module.add(commands)
    return parser
