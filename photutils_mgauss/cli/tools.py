"""What all commands share: options, progress, files, and records of runs."""
import argparse
import json
import os
import re
import sys
import warnings
from datetime import UTC, datetime
from pathlib import Path

from tqdm import tqdm

from photutils_mgauss import __version__
from photutils_mgauss.files.whole import whole_file

# What is no option of a run.
_NOT_STORED = ('run', 'quiet', 'overwrite')


class Progress:
    """
    A bar that moves on with each step of a command.

    Parameters
    ----------
    total : int
        The number of steps.
    quiet : bool
        Whether to show nothing.
    """

    def __init__(self, total, quiet):
        self._bar = tqdm(total=total, disable=quiet, unit='step',
                         bar_format='{desc}{bar:20} {n_fmt}/{total_fmt} '
                                    '[{elapsed}]')
        self._begun = False

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        if kind is None:
            self._bar.update(self._begun)
        self._bar.close()

    def __call__(self, words):
        """Say what is done next; what was begun before is finished."""
        self._bar.set_description_str(f'{words:40.40} ', refresh=False)
        self._bar.update(self._begun)
        self._bar.refresh()
        self._begun = True


def command(commands, name, words, description, example, run):
    """Add a command with its help; return its parser."""
    parser = commands.add_parser(
        name, help=words, description=description,
        epilog='example: ' + example,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.set_defaults(run=run)
    return parser


def add_inputs(parser, metavar, words):
    """Add the files or folders that a command reads."""
    parser.add_argument('inputs', nargs='+', metavar=metavar, help=words)


def add_folder(parser, default):
    """Add the option for the folder that a command writes into."""
    parser.add_argument('--output', default=default, metavar='FOLDER',
                        help='where files go (default: %(default)s)')


def add_common(parser):
    """Add the options that every command has."""
    parser.add_argument('--overwrite', action='store_true',
                        help='replace files of an earlier run')
    parser.add_argument('--quiet', action='store_true',
                        help='no progress bars and no messages')


def add_reading(parser):
    """Add the options that say how images are read."""
    group = parser.add_argument_group(
        'reading images', 'What is not given is taken from the files: their '
        'extensions SCI, ERR and DQ, their headers, and files beside them '
        'with names in _err, _wht or _flg. Options with FILE take one for '
        'all images or one for each.')
    group.add_argument('--ext', metavar='NAME',
                       help='extension with the image: 1, SCI or SCI,2')
    for name, words in (('error', 'standard deviations of the pixels'),
                        ('weight', 'inverse variances of the pixels'),
                        ('flags', 'flags of bad pixels'),
                        ('wcs', 'WCS, as ASDF or FITS header')):
        group.add_argument(f'--{name}', nargs='+', metavar='FILE', help=words)
    group.add_argument('--good-bits', type=int, metavar='BITS',
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


def positive(text):
    """Return a positive number, for argparse."""
    value = float(text)
    if not 0 < value < float('inf'):
        msg = f'must be positive, got {text}'
        raise argparse.ArgumentTypeError(msg)
    return value


def count(text):
    """Return a whole number from 1, for argparse."""
    value = int(text)
    if value < 1:
        msg = f'must be at least 1, got {text}'
        raise argparse.ArgumentTypeError(msg)
    return value


def number_or_auto(text):
    """Return a whole number or 'auto', for argparse."""
    if text == 'auto':
        return text
    value = int(text)
    if value < 0:
        msg = f'must not be negative, got {text}'
        raise argparse.ArgumentTypeError(msg)
    return value


def one_each(values, n, name):
    """Return n values of an option that has none, one for all, or n."""
    if not values:
        return [None] * n
    if len(values) == 1:
        return list(values) * n
    if len(values) != n:
        msg = f'--{name} must have 1 value or {n}, got {len(values)}'
        raise ValueError(msg)
    return list(values)


def check_inputs(paths):
    """Raise if a file is missing, before anything is computed."""
    for path in paths:
        if not Path(path).exists():
            msg = f'{path}: must be a file, but there is none of this name'
            raise FileNotFoundError(msg)
        if Path(path).is_dir():
            msg = f'{path}: must be a file, but is a folder'
            raise IsADirectoryError(msg)


def read_images(options, paths):
    """Return a function that reads image i as the options say."""
    from photutils_mgauss.cli.star_image import Reading, read_image
    n = len(paths)
    files = {name: one_each(getattr(options, name), n, name)
             for name in ('error', 'weight', 'flags', 'wcs')}
    times = [parse_time(text) for text in
             one_each(getattr(options, 'time', None), n, 'time')]
    common = {name: getattr(options, name) for name in (
        'ext', 'good_bits', 'gain', 'read_noise', 'exposure_time',
        'saturation', 'sky_box')}

    def read(i):
        beside = {name: some[i] for name, some in files.items()}
        return read_image(paths[i], Reading(**beside, **common,
                                            time=times[i]))
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
    for suffix in ('.gz', '.fz', '.fits', '.fit', '.asdf', '.ecsv', '.psf',
                   '_cat'):
        name = name.removesuffix(suffix)
    return name


def claim(paths, overwrite):
    """Raise unless files can be written there, and none is replaced."""
    for path in paths:
        if path.exists() and not overwrite:
            msg = f'{path} exists; choose another --output or add --overwrite'
            raise FileExistsError(msg)
    for folder in {path.parent for path in paths}:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            msg = f'{folder}: must be a folder that can be written to'
            raise PermissionError(msg)


def record_of(options, **more):
    """Return what is stored with results: command, options, version, date."""
    used = {name: value for name, value in vars(options).items()
            if name not in _NOT_STORED}
    return {'command': used.pop('command'), 'version': __version__,
            'date': datetime.now(UTC).isoformat(timespec='seconds'),
            'options': used, **more}


def write_table(table, path, record):
    """Write a table with the record of its run, as ECSV or FITS."""
    table = table.copy()
    if path.suffix == '.fits':
        kept = {key: value for key, value in table.meta.items()
                if len(key) <= 8 and isinstance(value, (int, float, str))}
        table.meta = {**kept, 'MGRUN': json.dumps(record)}
    else:
        table.meta['mgauss'] = record
    with whole_file(path) as draft, warnings.catch_warnings():
        # FITS has no electrons; astropy notes them down all the same.
        warnings.filterwarnings('ignore', 'The unit .* could not be saved')
        table.write(draft)


def say(options, *lines):
    """Print lines unless the user wants it quiet."""
    if not options.quiet:
        for line in lines:
            tqdm.write(str(line), file=sys.stdout)
