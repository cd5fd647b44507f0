"""What all commands share: options, files, words, and records of runs."""
import argparse
import json
import logging
import os
import re
import sys
import textwrap
import warnings
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryFile

from tqdm import tqdm

from photutils_mgauss import __version__
from photutils_mgauss.files import whole

# What is no option of a run.
NOT_STORED = ('run', 'parser', 'quiet', 'log_file', 'overwrite',
              'dry_run')
# What is wrong is said in no more letters than these.
_LONGEST = 500
# Errors of these kinds are sentences already.
_WORDED = (OSError, ValueError, TypeError, RuntimeError)
# Files that are being written.
_DRAFTS = set()
# Files that the command is at work on, the innermost last.
_SUBJECTS = []

LOG = logging.getLogger('mgauss')
# Or errors would be printed a second time where there is no log file.
LOG.addHandler(logging.NullHandler())


def command(commands, name, words, description, example, run):
    """Add a command with its help; return its parser."""
    parser = commands.add_parser(
        name, help=words, description=textwrap.fill(description, 78),
        epilog='example: ' + example,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--quiet', action='store_true',
                        help='no progress bars and no messages')
    parser.add_argument('--log-file', metavar='FILE',
                        help='append all messages to this file, with times')
    parser.set_defaults(run=run, parser=parser)
    return parser


def add_inputs(parser, metavar, words):
    """Add the files or folders that a command reads."""
    parser.add_argument('inputs', nargs='+', metavar=metavar, help=words)


def add_folder(parser, default):
    """Add the option for the folder that a command writes into."""
    parser.add_argument('--output', default=default, metavar='FOLDER',
                        help='where files go (default: %(default)s)')


def add_overwrite(parser):
    """Add the option of every command that writes files."""
    parser.add_argument('--overwrite', action='store_true',
                        help='replace files of an earlier run')


def add_reading(parser):
    """Add the options that say how images are read."""
    group = parser.add_argument_group(
        'reading images', textwrap.fill(
            'By default these values are read from the files: from the '
            'extensions SCI, ERR and DQ, the headers, and files beside them '
            'with names in _err, _wht or _flg. Options with FILE take one '
            'file for all images or one for each.', 76))
    group.add_argument('--ext', metavar='NAME',
                       help='extension with the image: 1, SCI or SCI,2')
    group.add_argument('--error-ext', metavar='NAME',
                       help='extension with the errors')
    group.add_argument('--flags-ext', metavar='NAME',
                       help='extension with the flags of bad pixels')
    for name, words in (('error', 'standard deviations of the pixels'),
                        ('weight', 'inverse variances of the pixels'),
                        ('flags', 'flags of bad pixels'),
                        ('wcs', 'WCS, as ASDF or FITS header')):
        group.add_argument(f'--{name}', nargs='+', metavar='FILE', help=words)
    group.add_argument('--good-bits', type=not_negative, metavar='BITS',
                       help='sum of the bits of the flags that do not make '
                            'a pixel bad')
    group.add_argument('--gain', type=positive,
                       help='electrons in a count, or in a unit of images '
                            'that do not hold counts')
    group.add_argument('--read-noise', type=positive, metavar='ELECTRONS',
                       help='noise of the readout')
    group.add_argument('--exposure-time', type=positive, metavar='SECONDS',
                       help='exposure time')
    group.add_argument('--saturation', type=positive, metavar='LEVEL',
                       help='level of saturated pixels, in the unit of the '
                            'image')
    group.add_argument('--sky-box', type=count, default=128, metavar='PIXELS',
                       help='side of the boxes in which the sky is measured '
                            '(default: %(default)s)')


def add_times(parser):
    """Add the option for times that no header tells."""
    parser.add_argument('--time', nargs='+', metavar='TIME',
                        help='middle of each exposure, as 2027-03-14T15:09 '
                             '(UTC) or as a Julian year, 2027.2')
    parser.add_argument('--time-key', metavar='KEYWORD',
                        help='keyword of the header with the middle of the '
                             'exposure, a date, a Julian date or a year')


def positive(text):
    """Return a positive number, for argparse."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float('inf'):
        msg = f'must be a positive number, got {text}'
        raise argparse.ArgumentTypeError(msg)
    return value


def count(text):
    """Return a whole number from 1, for argparse."""
    return _whole_number(text, 1)


def not_negative(text):
    """Return a whole number from 0, for argparse."""
    return _whole_number(text, 0)


def odd(text):
    """Return an odd whole number, for argparse."""
    value = count(text)
    if value % 2 == 0:
        msg = f'must be odd, got {text}'
        raise argparse.ArgumentTypeError(msg)
    return value


def count_or_auto(text):
    """Return a whole number from 1 or 'auto', for argparse."""
    return text if text == 'auto' else _whole_number(text, 1, ' or auto')


def number_or_auto(text):
    """Return a whole number from 0 or 'auto', for argparse."""
    return text if text == 'auto' else _whole_number(text, 0, ' or auto')


def transform(text):
    """Return the name of a kind of map, for argparse."""
    if not re.fullmatch(r'none|shift|rigid|similarity|affine|poly-[1-9]\d*',
                        text):
        msg = ('must be none, shift, rigid, similarity, affine or poly-2, '
               f'poly-3, ..., got {text}')
        raise argparse.ArgumentTypeError(msg)
    return text


def _whole_number(text, least, more=''):
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if value < least:
        msg = f'must be a whole number from {least}{more}, got {text}'
        raise argparse.ArgumentTypeError(msg)
    return value


# What is said.

def one_line(text):
    """Return words on one line, and not too many."""
    text = ' '.join(text.split())
    return text if len(text) <= _LONGEST else text[:_LONGEST - 4] + ' ...'


def sentence_of(error):
    """Return what went wrong as one sentence, whatever the error is."""
    if isinstance(error, OSError) and error.filename and error.strerror:
        return one_line(f'{error.filename}: {error.strerror}')
    if isinstance(error, MemoryError):
        return one_line(f'there is not enough memory. {error}')
    # The text of a KeyError is how its key looks in code.
    text = one_line(str(error.args[0] if isinstance(error, KeyError)
                        and error.args else error))
    if isinstance(error, _WORDED) and text:
        return text
    return f'{type(error).__name__}: {text}'


@contextmanager
def about(path):
    """Have errors and warnings inside name the file that they are about."""
    _SUBJECTS.append(str(path))
    try:
        yield
    except Exception as error:
        words = sentence_of(error)
        if str(path) in words:
            raise
        # Readers raise what they please.
        msg = f'{path}: {words}'
        raise ValueError(msg) from error
    finally:
        _SUBJECTS.pop()


def subject():
    """Return the file that the command is at work on, or None."""
    return _SUBJECTS[-1] if _SUBJECTS else None


def say(options, *lines):
    """Print lines unless the user wants it quiet."""
    for line in lines:
        LOG.info('%s', line)
        if not options.quiet:
            try:
                tqdm.write(str(line), file=sys.stdout)
            except BrokenPipeError:
                # Who read this has gone; the work goes on.
                os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


# What is given.

def one_each(values, n, name):
    """Return n values of an option that has none, one for all, or n."""
    if not values:
        return [None] * n
    if len(values) == 1:
        return list(values) * n
    if len(values) != n:
        one_or_n = '1 value' if n == 1 else f'1 value or {n}'
        msg = f'--{name} must have {one_or_n}, got {len(values)}'
        raise ValueError(msg)
    return list(values)


def no_places(path, table):
    """Return a sentence on a table without places of stars."""
    return (f'{path}: must have columns ra and dec, or x and y, got '
            f'{table.colnames}')


def check_inputs(paths):
    """Raise if a file is missing, before anything is computed."""
    for path in filter(None, paths):
        if not Path(path).exists():
            msg = f'{path}: must be a file, but there is none of this name'
            raise FileNotFoundError(msg)
        if Path(path).is_dir():
            msg = f'{path}: must be a file, but is a folder'
            raise IsADirectoryError(msg)


def files_in(inputs):
    """Return the files that are given, and those of folders given."""
    found = []
    for path in map(Path, inputs):
        if path.is_dir():
            found += [file for file in sorted(path.iterdir())
                      if file.is_file() and not file.name.startswith('.')]
        else:
            found.append(path)
    return found


def check_different(paths):
    """Raise if a file is given twice."""
    known = {}
    for path in paths:
        first = known.setdefault(Path(path).resolve(), path)
        if first is not path:
            msg = f'{path}: must be given only once, got it twice'
            raise ValueError(msg)


def read_images(options, paths):
    """Return a function that reads image i as the options say."""
    from photutils_mgauss.cli.star_image import Reading, read_image
    n = len(paths)
    files = {name: one_each(getattr(options, name), n, name)
             for name in ('error', 'weight', 'flags', 'wcs')}
    for some in files.values():
        check_inputs(some)
    times = [parse_time(text) for text in
             one_each(getattr(options, 'time', None), n, 'time')]
    common = {name: getattr(options, name) for name in (
        'ext', 'error_ext', 'flags_ext', 'good_bits', 'gain', 'read_noise',
        'exposure_time', 'saturation', 'sky_box')}
    common['time_key'] = getattr(options, 'time_key', None)

    def read(i, ext=None):
        """Read an image, of several in a file that of an extension."""
        beside = {name: some[i] for name, some in files.items()}
        reading = Reading(**beside, **common, time=times[i])
        if ext is not None:
            reading = replace(reading, ext=ext)
        with about(paths[i]):
            return read_image(paths[i], reading)
    return read


def parse_time(text):
    """Return the Time of a date or a Julian year; None stays None."""
    if text is None:
        return None
    from astropy.time import Time

    from photutils_mgauss.sky.observers import tdb
    if re.fullmatch(r'\d{4}(\.\d*)?', text):
        return tdb(float(text))
    try:
        return Time(text, scale='utc')
    except ValueError as error:
        msg = f'--time must be a date or a Julian year, got {text!r}'
        raise ValueError(msg) from error


def output_names(inputs, output, ending, suffixes, default):
    """
    Return a name for each output.

    ``output`` is a file if its name ends with one of ``suffixes``, which
    takes a single input, or else a folder, in which the files have the names
    of the inputs with ``ending`` and the suffix ``default``.
    """
    is_folder = output is None or output.endswith('/') or Path(
        output).is_dir()
    if not is_folder and Path(output).suffix in suffixes:
        if len(inputs) != 1:
            msg = (f'--output must be a folder for {len(inputs)} inputs, got '
                   f'{output}')
            raise ValueError(msg)
        return [Path(output)]
    if not is_folder and suffixes and Path(output).suffix:
        msg = (f'--output must be a folder or end with '
               f'{" or ".join(suffixes)}, got {output}')
        raise ValueError(msg)
    folder = Path(output or '.')
    names = [folder / f'{stem(path)}{ending}{default}' for path in inputs]
    twice = {str(name) for name in names if names.count(name) > 1}
    if twice:
        msg = (f'inputs must have different names, for their outputs would '
               f'all be {min(twice)}')
        raise ValueError(msg)
    return names


def stem(path):
    """Return the name of a file without folder and suffixes."""
    name = Path(path).name
    for suffix in ('.gz', '.fz', '.bz2', '.xz', '.zip', '.fits', '.fit',
                   '.fts', '.asdf', '.ecsv', '.psf', '_cat'):
        if name.lower().endswith(suffix):
            name = name[:-len(suffix)]
    return name


def claim(paths, overwrite, inputs=()):
    """
    Raise unless files can be written there, and none is replaced.

    Nothing is made: a file or a folder appears when there is something to
    write into it.
    """
    for path in paths:
        _check_name(path)
        for source in map(Path, inputs):
            if path.exists() and path.samefile(source):
                msg = f'{path}: --output must not be an input'
                raise ValueError(msg)
        if path.exists() and not overwrite:
            msg = f'{path} exists; choose another --output or add --overwrite'
            raise FileExistsError(msg)
    for folder in {path.parent for path in paths}:
        check_folder(folder)


def _check_name(path):
    """Raise if there can be no file of this name."""
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return
    if path.is_dir():
        msg = f'{path}: must be the name of a file, but is a folder'
        raise IsADirectoryError(msg)


def check_folder(folder):
    """Raise unless files can be written into a folder, or it can be made."""
    nearest = next(one for one in (folder, *folder.parents) if one.exists())
    if not nearest.is_dir():
        msg = f'{folder}: must be a folder, but {nearest} is a file'
        raise NotADirectoryError(msg)
    try:
        # Permissions do not say all: a file system may be read-only.
        with TemporaryFile(dir=nearest):
            pass
    except OSError as error:
        msg = (f'{folder}: must be a folder that can be written to, got: '
               f'{error.strerror}')
        raise PermissionError(msg) from error


class _Draft:
    """A file that is being written, and the folders made for it."""

    def __init__(self, path):
        self.name = None
        self._made = [folder for folder in path.parents
                      if not folder.exists()]

    def clear(self):
        """Leave nothing behind but what other files need."""
        if self.name is not None:
            self.name.unlink(missing_ok=True)
        with suppress(OSError):
            for folder in self._made:
                folder.rmdir()


@contextmanager
def whole_file(path):
    """
    Give a name to write to; the file gets its own name once it is whole.

    As `photutils_mgauss.files.whole.whole_file`. Folders are made, and go
    again if nothing comes into them.
    """
    path = Path(path)
    draft = _Draft(path)
    _DRAFTS.add(draft)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole.whole_file(path) as name:
            if name.name != path.name:
                draft.name = name
            yield name
    except Exception as error:
        words = sentence_of(error).replace(str(draft.name), str(path))
        if words == sentence_of(error) and not isinstance(error, OSError):
            raise
        msg = f'{path}: could not be written: {words}'
        raise OSError(msg) from error
    finally:
        draft.clear()
        _DRAFTS.discard(draft)


def clear_up():
    """Remove the files that are being written, of a run that is given up."""
    for draft in list(_DRAFTS):
        draft.clear()


def record_of(options, **more):
    """Return what is stored with results: command, options, version, date."""
    used = {name: value for name, value in vars(options).items()
            if name not in (*NOT_STORED, 'checkpoint')}
    return {'command': used.pop('command'), 'version': __version__,
            'date': datetime.now(UTC).isoformat(timespec='seconds'),
            'options': used, **more}


def write_table(table, path, record):
    """Write a table with the record of its run into an ECSV or FITS file."""
    table = table.copy()
    if path.suffix == '.fits':
        kept = {key: value for key, value in table.meta.items()
                if len(key) <= 8 and isinstance(value, (int, float, str))}
        table.meta = {**kept, 'MGRUN': json.dumps(record)}
    else:
        table.meta['mgauss'] = record
    with warnings.catch_warnings():
        # FITS has no electrons; astropy notes them down all the same.
        warnings.filterwarnings('ignore', 'The unit .* could not be saved')
        table.write(path)
