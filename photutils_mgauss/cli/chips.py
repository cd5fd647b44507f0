"""
Exposures of several chips, for ``mgauss motions --chips``.

The chips of an exposure are the images of one file, or catalogues that were
measured in images of one file. They have one map onto the other exposures.
"""
import os
from dataclasses import dataclass, replace
from pathlib import Path

from photutils_mgauss.cli import tools

# What says something of one image, and nothing of the chips of a file.
_OF_ONE_IMAGE = ('ext', 'error_ext', 'flags_ext', 'error', 'weight', 'flags',
                 'wcs')
# Chips are read out one after the other: a quarter of an hour [yr].
_TOGETHER = 0.25 / 24 / 365.25


def add_options(parser):
    """Add what only cameras of several chips need."""
    group = parser.add_argument_group('cameras of several chips')
    group.add_argument('--chips', action='store_true',
                       help='the images of one file are chips of one '
                            'exposure, and so are catalogues that were '
                            'measured in images of one file')
    group.add_argument('--distortion', metavar='KIND', type=tools.transform,
                       help='with --chips: how chips may differ from their '
                            'WCS, the same in all exposures: none, affine, '
                            'poly-2, poly-3, ... (default: affine)')


def check(options):
    """Raise for options that do not go together."""
    if options.distortion is not None and not options.chips:
        msg = '--distortion must be given with --chips only'
        raise ValueError(msg)
    if options.chips and (options.plane or options.parallax_of):
        msg = ('--chips must be given without --plane and --parallax-of, '
               'because the chips of an exposure have a WCS each')
        raise ValueError(msg)


@dataclass(frozen=True)
class Piece:
    """
    A file of an exposure, or one of the images in it.

    ``given`` is the number of the file among the inputs, ``ext`` the
    extension with the image, None where the file or an option says it.
    """

    path: str
    given: int
    is_table: bool
    ext: str | None = None

    @property
    def name(self):
        """The name that the names of outputs are made of."""
        if self.ext is None:
            return self.path
        words = self.ext.replace(',', '')
        return str(Path(self.path).with_name(
            f'{tools.stem(self.path)}_{words}'))


def pieces_of(options, are_tables):
    """Return the `Piece` of each file, or of each chip in it."""
    pieces = [Piece(path, i, is_table) for i, (path, is_table) in enumerate(
        zip(options.inputs, are_tables, strict=True))]
    if not options.chips:
        return pieces
    if not all(are_tables):
        _check_reading(options)
    return [chip for piece in pieces for chip in _split(piece)]


def _check_reading(options):
    given = [name.replace('_', '-') for name in _OF_ONE_IMAGE
             if getattr(options, name)]
    if given:
        msg = (f'--{given[0]} must be given without --chips, because it says '
               'what belongs to one image')
        raise ValueError(msg)


def _split(piece):
    """Return the chips of a file."""
    from photutils_mgauss.files.image_layers import science_images
    if piece.is_table:
        return [piece]
    with tools.about(piece.path):
        names = science_images(piece.path)
    if len(names) < 2:
        return [piece]
    return [replace(piece, ext=name) for name in names]


@dataclass(frozen=True, eq=False)
class Seen:
    """
    What is known of a `Piece` once it is measured.

    ``image`` names the file with the image, ``ext`` the extension in it.
    """

    table: object
    wcs: object
    time: object
    observer: object
    image: str
    ext: str | None


def exposures_of(pieces, seen, chips):
    """Return the numbers of the pieces of each exposure, in lists."""
    if not chips:
        return [[k] for k in range(len(pieces))]
    groups = {}
    for k, one in enumerate(seen):
        groups.setdefault(one.image, []).append(k)
    return list(groups.values())


def epoch_of(paths, seen):
    """
    Return the `Epoch` of an exposure of several chips.

    Parameters
    ----------
    paths : list of str
        The files of its chips.
    seen : list of `Seen`
        What was measured in them.
    """
    from photutils_mgauss.motions import Epoch
    for path, one in zip(paths, seen, strict=True):
        if one.wcs is None:
            msg = f'{path}: must have a WCS, as a chip of an exposure'
            raise ValueError(msg)
    names = [str(one.ext) for one in seen]
    with tools.about(paths[0]):
        if len(set(names)) < len(names):
            msg = (f'the chips of {seen[0].image} must be different '
                   f'extensions, got {", ".join(names)}')
            raise ValueError(msg)
        return Epoch.of_chips([(one.table, one.wcs) for one in seen],
                              _same_time(seen), names=names,
                              observer=seen[0].observer)


def _same_time(seen):
    """Return the time of an exposure; raise if its chips differ."""
    from photutils_mgauss.sky.observers import julian_years
    times = [one.time for one in seen]
    if any(time is None for time in times):  # each row has its own
        return None
    years = [float(julian_years(time)) for time in times]
    if max(years) - min(years) > _TOGETHER:
        msg = (f'the chips of {seen[0].image} must be of one time, got '
               f'{min(years):.5f} and {max(years):.5f}')
        raise ValueError(msg)
    return times[0]


def image_of(path, record):
    """Return the image that a catalogue was measured in, and where in it."""
    exposure = record.get('exposure', {})
    if not exposure.get('image'):
        msg = (f'{path}: must be a catalogue of mgauss photometry, which '
               'knows its image, or be given without --chips')
        raise ValueError(msg)
    folder = Path(path).resolve().parent
    return os.path.normpath(folder / exposure['image']), exposure.get('ext')
