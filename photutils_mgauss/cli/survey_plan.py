"""What a survey file asks for: exposures, fields, and the commands to run."""
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

from photutils_mgauss.cli import tools
from photutils_mgauss.cli.footprints import Footprint, connected, overlaps
from photutils_mgauss.cli.survey_options import (
    COMMANDS,
    READING,
    check_files,
    check_keys,
    check_overlaps,
    files_of,
    motion_options,
    parsed,
    psf_files,
    words,
)

_EXPOSURE_KEYS = ('files', 'ext', 'detector', 'group_by', 'overlap', *READING)
# So many exposures that cannot be used are named.
_NAMED = 5


@dataclass(frozen=True, eq=False)
class Exposure:
    """
    One image of a survey.

    ``group`` are the values of the keywords that keep fields apart,
    ``detector`` names what took it, ``n_pixels`` is its size.
    """

    name: str
    path: Path
    ext: str | None
    group: tuple
    detector: str
    year: float
    footprint: Footprint
    n_pixels: int

    @property
    def camera(self):
        """What has a PSF of its own: detector and group, as a name."""
        parts = (self.detector or 'detector', *self.group)
        return '_'.join(''.join(letter if letter.isalnum() else '-'
                                for letter in part) for part in parts)


@dataclass(frozen=True, eq=False)
class Survey:
    """
    A survey file, read and checked.

    ``options`` has the words of each command, ``reading`` those for all,
    ``files`` the files that the words of each command name, ``psf`` is
    'exposure', 'detector' or 'archive', where ``archive`` has the files by
    detector, as ``start`` those that the stars of an exposure change,
    ``pages`` says whether exposures get pages, ``fields`` the numbers of the
    exposures of each field by its name, ``regions`` those of fields that hang
    together.
    """

    file: Path
    output: Path
    exposures: list
    options: dict
    reading: tuple
    files: dict
    psf: str
    archive: dict
    start: dict
    pages: bool
    pixels: bool
    fields: dict
    regions: dict

    @property
    def references(self):
        """The file of the objects of known motion, or None."""
        words = self.options['motions']
        return (words[words.index('--references') + 1]
                if '--references' in words else None)


def read_survey(path):
    """
    Read a survey file and look at its exposures.

    Parameters
    ----------
    path : `~pathlib.Path`
        The file; names in it are relative to its folder.

    Returns
    -------
    Survey

    Raises
    ------
    OSError, TypeError, ValueError
        If the file or an exposure cannot be read, a key is unknown, options
        contradict each other, a detector has no PSF, or two exposures have
        one name.
    """
    text = _toml(path)
    folder = path.resolve().parent
    check_files(path, text, folder)
    wanted = text.get('exposures', {})
    tables = _tables(text)
    given = text.get('photometry', {}).get('psf', 'exposure')
    archive = {} if given in ('exposure', 'detector') else psf_files(
        path, folder, given, 'psf of [photometry] must be "exposure", '
        '"detector" or a file')
    start = text.get('psf', {}).get('start')
    start = {} if start is None else psf_files(
        path, folder, start, 'start of [psf] must be a file')
    options = {name: words(table, folder) for name, table in tables.items()}
    for name, some in options.items():
        parsed(path, 'motions' if name == 'pixels' else name, some)
    reading = words({key: value for key, value in wanted.items()
                     if key in READING}, folder)
    exposures = _exposures(path, folder, wanted, parsed(
        path, 'photometry', reading, 'exposures'))
    _check_archive(path, exposures, archive, 'psf of [photometry]')
    _check_archive(path, exposures, start, 'start of [psf]')
    motions = text.get('motions', {})
    fields, regions = _fields(exposures, float(wanted.get('overlap', 0.5)))
    if motions.get('pixels'):
        _check_extensions(path, exposures, fields)
    return Survey(
        path.resolve(), folder / text.get('output', 'survey'), exposures,
        options, reading, {name: files_of(table, folder)
                           for name, table in tables.items()},
        'archive' if archive else given, archive, start,
        bool(text.get('pages', True)),
        bool(motions.get('pixels')),
        regions if motions.get('together') else fields, regions)


def _toml(path):
    """Return what a survey file says, if it says nothing wrong."""
    with path.open('rb') as file:
        try:
            text = tomllib.load(file)
        except tomllib.TOMLDecodeError as error:
            msg = f'{path}: must be a TOML file: {error}'
            raise ValueError(msg) from error
    check_keys(path, text, ('output', 'pages', 'exposures', *COMMANDS),
               'keys')
    if not isinstance(text.get('pages', True), bool):
        msg = f'{path}: pages must be true or false, got {text["pages"]}'
        raise TypeError(msg)
    for name in ('exposures', *COMMANDS):
        if not isinstance(text.get(name, {}), dict):
            msg = f'{path}: {name} must be a table, [{name}], got {text[name]}'
            raise TypeError(msg)
    check_keys(path, text.get('exposures', {}), _EXPOSURE_KEYS,
               'keys of [exposures]')
    check_overlaps(path, text)
    return text


def _tables(text):
    """Return the options of each command."""
    catalogues, pixels = motion_options(text.get('motions', {}))
    photometry = {key: value for key, value in
                  text.get('photometry', {}).items() if key != 'psf'}
    # The file that PSFs start from may be another for each detector.
    psf = {key: value for key, value in text.get('psf', {}).items()
           if key != 'start'}
    tables = {'psf': psf, 'photometry': photometry,
              'motions': catalogues}
    return tables | ({'pixels': pixels} if pixels.get('pixels') else {})


def _exposures(path, folder, wanted, reading):
    patterns = wanted.get('files', [])
    patterns = [patterns] if isinstance(patterns, str) else patterns
    files = sorted({file for pattern in patterns
                    for file in _matching(folder, pattern)})
    if not files:
        msg = (f'{path}: files of [exposures] must name images, got none for '
               f'{", ".join(patterns) or "no pattern"}')
        raise ValueError(msg)
    pairs = [(file, ext) for file in files
             for ext in _extensions(file, wanted.get('ext'))]
    _check_names(path, pairs)
    found, troubles = [], []
    for file, ext in pairs:
        try:
            found.append(_exposure(file, ext, wanted, reading))
        except (OSError, ValueError) as error:
            troubles.append(_as_keys(tools.sentence_of(error)))
    if troubles:
        msg = '; '.join(troubles[:_NAMED])
        if len(troubles) > _NAMED:
            msg += f'; and {len(troubles) - _NAMED} more'
        raise ValueError(msg)
    return found


def _as_keys(sentence):
    """Name the options of a sentence as a survey's file does."""
    return re.sub('--([a-z-]+)', lambda found: found[1].replace('-', '_'),
                  sentence)


def _check_names(path, pairs):
    known = {}
    for file, ext in pairs:
        other = known.setdefault(_name(file, ext), file)
        if other is not file:
            msg = (f'{path}: exposures must have different names, got '
                   f'{_name(file, ext)} for {other} and {file}')
            raise ValueError(msg)


def _chip(ext):
    """Return which of several images of a file an extension is, or ''."""
    return '' if ext is None or ',' not in str(ext) else (
        str(ext).replace(',', ''))


def _name(file, ext):
    chip = _chip(ext)
    return f'{tools.stem(file)}_{chip}' if chip else tools.stem(file)


def _matching(folder, pattern):
    """Return the files of a pattern, which may begin at the root."""
    whole = folder / pattern
    return Path(whole.anchor).glob(str(whole.relative_to(whole.anchor)))


def _extensions(file, wanted):
    """Return the extensions of a file that are images of their own."""
    if wanted is None or ',' in str(wanted):
        return [wanted]
    from photutils_mgauss.files.image_layers import is_asdf, open_fits
    if is_asdf(file):
        return [wanted]
    with tools.about(file), open_fits(file) as hdus:
        versions = [hdu.ver for hdu in hdus if hdu.name == str(wanted).upper()]
    return ([f'{wanted},{version}' for version in versions]
            if len(versions) > 1 else [wanted])


def _exposure(file, ext, wanted, reading):
    from photutils_mgauss.cli.star_image import Reading, read_image
    from photutils_mgauss.sky.observers import julian_years
    with tools.about(file):
        image = read_image(file, Reading(ext=ext, **{
            key: getattr(reading, key) for key in READING}))
        image.check()
        for what, value in (('a WCS', image.wcs), ('a time', image.time)):
            if value is None:
                msg = f'must have {what} in its header, got none'
                raise ValueError(msg)
        group = tuple(_keyword(file, key) for key in wanted.get('group_by',
                                                                []))
        key = wanted.get('detector')
        parts = (_chip(ext), '' if key is None else _keyword(file, key))
        return Exposure(
            _name(file, ext), file, ext, group, ' '.join(filter(None, parts)),
            float(julian_years(image.time)),
            Footprint(image.wcs, image.data.shape), image.data.size)


def keyword_of(file, key):
    """Return the value of a keyword, from whichever header has it, or None."""
    from photutils_mgauss.files.image_layers import is_asdf, open_fits
    if not is_asdf(file):
        with open_fits(file) as hdus:
            for hdu in hdus:
                if key in hdu.header:
                    return str(hdu.header[key])
    return None


def _keyword(file, key):
    value = keyword_of(file, key)
    if value is None:
        msg = f'must have the keyword {key}, which keeps exposures apart'
        raise ValueError(msg)
    return value


def _check_archive(path, exposures, archive, what):
    """Raise if there is a detector whose PSF is not given."""
    if not archive or '' in archive:
        return
    for exposure in exposures:
        if exposure.detector not in archive:
            msg = (f'{path}: {what} must name a file for each '
                   f'detector, got none for {exposure.detector!r} of '
                   f'{exposure.path}')
            raise ValueError(msg)


def _check_extensions(path, exposures, fields):
    """Raise if a field has images of several extensions."""
    for name, members in fields.items():
        found = {exposures[i].ext for i in members}
        if len(found) > 1:
            msg = (f'{path}: pixels of [motions] must have fields of one '
                   f'extension, got {", ".join(sorted(map(str, found)))} in '
                   f'{name}; see group_by')
            raise ValueError(msg)


def _fields(exposures, overlap):
    """Return exposures by field, and by region: fields that touch."""
    pairs, share = overlaps([one.footprint for one in exposures],
                            [one.group for one in exposures])
    return tuple(
        {f'{what}{k + 1:04d}': members for k, members in enumerate(
            connected(some, len(exposures)))}
        for what, some in (('field', pairs[share >= overlap]),
                           ('region', pairs)))
