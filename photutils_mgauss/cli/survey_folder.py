"""The folder that a survey writes into: whose it is, and if there is room."""
import json
import os
import shutil

from photutils_mgauss.cli import tools

_MARK = 'survey.json'

# What an exposure leaves on the disk, measured and rounded up [bytes]: its
# PSF on 30 x 30 nodes, its frame and record, and for each pixel the rows of
# stars in catalogues and motions.
_PER_EXPOSURE, _PER_PIXEL = 1.5e6, 4.0


def needed_bytes(survey, n=None):
    """Return about how much room the results of n exposures take."""
    pixels = sum(one.n_pixels for one in survey.exposures)
    share = 1 if n is None else n / len(survey.exposures)
    return share * (_PER_EXPOSURE * len(survey.exposures)
                    + _PER_PIXEL * pixels)


def check_output(survey, missing):
    """
    Raise unless the results can go where they belong.

    Parameters
    ----------
    survey : Survey
        The plan.
    missing : int
        How many exposures are not done yet.

    Raises
    ------
    OSError, ValueError
        If the folder is that of another run or cannot be written to, or the
        disk is too full.
    """
    folder = survey.output
    tools.check_folder(folder)
    _check_owner(survey)
    nearest = next(one for one in (folder, *folder.parents) if one.exists())
    free, needed = shutil.disk_usage(nearest).free, needed_bytes(survey,
                                                                 missing)
    if free < needed:
        msg = (f'{folder}: its disk must have room for {missing} exposures, '
               f'about {needed / 1e6:.0f} MB, got {free / 1e6:.0f} MB; make '
               'room, or choose another output')
        raise OSError(msg)


def _check_owner(survey):
    folder = survey.output
    if not folder.exists() or not any(folder.iterdir()):
        return
    mark = folder / _MARK
    if not mark.exists():
        msg = (f'{folder}: must be empty or of this survey, but has '
               f'{min(one.name for one in folder.iterdir())}; choose another '
               'output')
        raise ValueError(msg)
    try:
        owner = json.loads(mark.read_text(encoding='utf-8'))['file']
    except (ValueError, TypeError, KeyError):
        owner = 'an unknown file'
    if owner != _relative(survey):
        msg = (f'{folder}: must be of {survey.file}, but is of another run, '
               f'of {owner}; choose another output, or remove {mark} to go '
               'on with its results')
        raise ValueError(msg)


def _relative(survey):
    # Both can be moved together.
    return os.path.relpath(survey.file, survey.output)


def mark_output(survey):
    """Write whose folder it is."""
    with tools.whole_file(survey.output / _MARK) as draft:
        draft.write_text(json.dumps({'file': _relative(survey)}),
                         encoding='utf-8')
