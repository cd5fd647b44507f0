"""The options of a survey: words for its commands, checked before work."""
import contextlib
import io
from difflib import get_close_matches
from pathlib import Path

from photutils_mgauss.cli import tools

COMMANDS = ('psf', 'photometry', 'motions')
# How images are read is said once, for all commands.
READING = ('error_ext', 'flags_ext', 'good_bits', 'gain', 'read_noise',
           'exposure_time', 'saturation', 'sky_box', 'time_key')
# What the survey itself decides.
_OWN = ('output', 'overwrite', 'quiet', 'log_file', 'checkpoint', 'dry_run',
        'format', 'together')
_ONE_IMAGE = ('error', 'weight', 'flags', 'wcs', 'time', 'detector', 'frames')
# Options of mgauss motions that are for images to be measured first, which
# here is the work of other commands.
_MEASURING = {'psf': ('n_components', 'degree', 'radius', 'pixel_integrated',
                      'min_snr', 'max_stars', 'stars', 'start'),
              'photometry': ('crowded', 'threshold', 'magnitudes', 'psf')}
_PIXELS_ONLY = ('targets', 'forced', 'refine_frames', 'fit_shape')
_SHARED = ('parallax', 'observer')
# Options that name a file.
_FILES = ('references', 'targets', 'parallax_of', 'stars')


def check_keys(path, table, known, what):
    """Raise if a table has a key that is not known."""
    for key in table:
        if key not in known:
            near = get_close_matches(key, known, 1)
            hint = f' (did you mean {near[0]}?)' if near else ''
            msg = (f'{path}: {what} must be among {", ".join(known)}, got '
                   f'{key}{hint}')
            raise ValueError(msg)


def words(options, folder):
    """
    Return a table of options as the words of a command line.

    Values that name a file in the folder become whole paths, as workers may
    be anywhere.
    """
    def word(value):
        return str(_file(folder, value) or value)

    out = []
    for key, value in options.items():
        name = f'--{key.replace("_", "-")}'
        if value is True:
            out.append(name)
        elif isinstance(value, list):
            out += [name, *map(word, value)]
        elif value is not False:
            out += [name, word(value)]
    return tuple(out)


def _file(folder, value):
    """Return the file that a value names, or None."""
    file = folder / str(value)
    return file if isinstance(value, str) and file.is_file() else None


def files_of(options, folder):
    """Return the names of all files that options name."""
    values = [one for value in options.values()
              for one in (value if isinstance(value, list) else [value])]
    return tuple(str(_file(folder, value)) for value in values
                 if _file(folder, value))


def parsed(path, command, given, table=None):
    """Return the options that words of a command stand for, or raise."""
    from photutils_mgauss.cli.survey_steps import step_parser
    table = table or command
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        try:
            options, unknown = step_parser().parse_known_args(
                [command, 'x', *given])
        except SystemExit:
            last = said.getvalue().strip().splitlines()[-1]
            msg = f'{path}: [{table}]: {last.partition("error: ")[2]}'
            raise ValueError(msg) from None
    if unknown:
        msg = (f'{path}: [{table}] must have options of mgauss {command}, '
               f'got {unknown[0].removeprefix("--")}')
        raise ValueError(msg)
    return options


def check_overlaps(path, text):
    """Raise for options that contradict each other, or say nothing."""
    for name in COMMANDS:
        for key in text.get(name, {}):
            where = _better_place(name, key)
            if where:
                msg = f'{path}: {key} of [{name}] {where}'
                raise ValueError(msg)
    photometry, psf = text.get('photometry', {}), text.get('psf', {})
    given = photometry.get('psf', 'exposure')
    makes = given in ('exposure', 'detector')
    if psf and not makes:
        msg = (f'{path}: [psf] must be left out where [photometry] has a '
               f'psf of its own, for none is made; got {min(psf)}')
        raise ValueError(msg)
    if photometry.get('crowded') and makes and (psf or given == 'detector'):
        msg = (f'{path}: [photometry] with crowded makes the PSF of the '
               'crowded stars, or takes psf = FILE; [psf] and psf = '
               '"detector" must be left out')
        raise ValueError(msg)
    if 'start' in psf and 'n_components' in psf:
        msg = (f'{path}: n_components of [psf] must be left out with start, '
               'whose Gaussians are kept')
        raise ValueError(msg)
    if given == 'detector' and 'start' in psf:
        msg = (f'{path}: start of [psf] must be given without psf = '
               '"detector": it is for the PSF of each exposure')
        raise ValueError(msg)
    _check_motions(path, text)


def check_files(path, text, folder):
    """Raise if an option names a file that there is none of."""
    for name in COMMANDS:
        for key, value in text.get(name, {}).items():
            if key in _FILES and not (folder / str(value)).is_file():
                msg = (f'{path}: {key} of [{name}] must be a file, got '
                       f'{value}, which is none in {folder}')
                raise FileNotFoundError(msg)


def _better_place(name, key):
    """Return where an option of a table belongs, or '' if it is right."""
    if key in READING or key == 'ext':
        return 'must be in [exposures], for all commands read images alike'
    if key == 'together' and name == 'motions':
        return ''
    if key in _OWN:
        return 'must be left out: the survey decides that'
    if key in _ONE_IMAGE:
        return 'must be left out: it is for single images'
    if name == 'motions':
        for other, keys in _MEASURING.items():
            if key in keys:
                return f'must be in [{other}]'
    return ''


def _check_motions(path, text):
    motions = text.get('motions', {})
    if motions.get('pixels'):
        if motions.get('plane') or motions.get('parallax_of'):
            msg = (f'{path}: pixels of [motions] must be given without plane '
                   'and parallax_of')
            raise ValueError(msg)
        photometry = text.get('photometry', {})
        if photometry.get('crowded') and 'psf' not in photometry:
            msg = (f'{path}: pixels of [motions] must have PSFs in files; '
                   'with crowded give psf = FILE in [photometry]')
            raise ValueError(msg)
        return
    for key in _PIXELS_ONLY:
        if key in motions:
            msg = f'{path}: {key} of [motions] must be given with pixels'
            raise ValueError(msg)


def motion_options(motions):
    """Return the options for catalogues, and those for pixels."""
    catalogues = {key: value for key, value in motions.items()
                  if key not in (*_PIXELS_ONLY, 'pixels', 'together')}
    pixels = {key: value for key, value in motions.items()
              if key in (*_PIXELS_ONLY, *_SHARED, 'pixels')}
    return catalogues, pixels


def psf_files(path, folder, given, what):
    """
    Return the PSF files that are given, by detector ('' is any).

    Parameters
    ----------
    path, folder : `~pathlib.Path`
        The survey file, and the folder that names are relative to.
    given : str or dict
        A file, or one for each detector.
    what : str
        What must be one, for messages.

    Raises
    ------
    ValueError
        If one is missing or no PSF.
    """
    given = given if isinstance(given, dict) else {'': given}
    out = {}
    for detector, name in given.items():
        file = folder / str(name)
        if not file.is_file():
            msg = f'{path}: {what}, got {name}, which is none'
            raise ValueError(msg)
        _check_psf(file)
        out[str(detector)] = str(file)
    return out


def _check_psf(file):
    from photutils_mgauss.cli.psf_files import psf_kind
    with tools.about(file):
        if psf_kind(Path(file)) == 'image':
            msg = 'must be a PSF, but is an image of stars'
            raise ValueError(msg)
