"""What a survey file asks for: exposures, fields, and the commands to run."""
import contextlib
import io
import tomllib
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import combinations
from pathlib import Path

import numpy as np
from astropy.coordinates import SkyCoord
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from photutils_mgauss.cli import tools

_TABLES = ('exposures', 'psf', 'photometry', 'motions')
_EXPOSURE_KEYS = ('files', 'ext', 'group_by', 'overlap')
# Points along each side of an image by which overlaps are measured.
_POINTS = 12


@dataclass(frozen=True, eq=False)
class Exposure:
    """
    One image of a survey.

    ``group`` are the values of the keywords that keep fields apart, ``wcs``
    its WCS, ``shape`` its pixels (ny, nx).
    """

    name: str
    path: Path
    ext: str | None
    group: tuple
    year: float
    wcs: object
    shape: tuple

    def lattice(self):
        """Return directions of points spread over the image."""
        y, x = (np.linspace(0, n - 1, _POINTS) for n in self.shape)
        x, y = (grid.ravel() for grid in np.meshgrid(x, y))
        return self.wcs.pixel_to_world(x, y)

    def share_inside(self, other):
        """Return the share of this image that another one shows."""
        sky = SkyCoord(self.lattice())
        with np.errstate(all='ignore'):
            x, y = other.wcs.world_to_pixel(sky)
        ny, nx = other.shape
        inside = (x > -0.5) & (x < nx - 0.5) & (y > -0.5) & (y < ny - 0.5)
        return float(np.mean(inside))


@dataclass(frozen=True, eq=False)
class Survey:
    """
    A survey file, read and checked.

    ``options`` has the words of each command, ``fields`` the numbers of the
    exposures of each field, by the field's name.
    """

    output: Path
    exposures: list
    options: dict
    fields: dict


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
    OSError, ValueError
        If the file or an exposure cannot be read, a key is unknown, or two
        exposures have one name.
    """
    with path.open('rb') as file:
        try:
            text = tomllib.load(file)
        except tomllib.TOMLDecodeError as error:
            msg = f'{path}: must be a TOML file: {error}'
            raise ValueError(msg) from error
    _check_keys(path, text, ('output', *_TABLES), 'keys')
    wanted = text.get('exposures', {})
    _check_keys(path, wanted, _EXPOSURE_KEYS, 'keys of [exposures]')
    folder = path.resolve().parent
    options = {name: _words(text.get(name, {}), folder)
               for name in ('psf', 'photometry', 'motions')}
    for name, words in options.items():
        _check_words(path, name, words)
    exposures = _exposures(path, folder, wanted)
    return Survey(folder / text.get('output', 'survey'), exposures, options,
                  _fields(exposures, float(wanted.get('overlap', 0.5))))


def _check_keys(path, table, known, what):
    for key in table:
        if key not in known:
            near = get_close_matches(key, known, 1)
            hint = f' (did you mean {near[0]}?)' if near else ''
            msg = (f'{path}: {what} must be among {", ".join(known)}, got '
                   f'{key}{hint}')
            raise ValueError(msg)


def _words(options, folder):
    """
    Return a table of options as the words of a command line.

    Values that name a file in the folder become whole paths, as workers may
    be anywhere.
    """
    def word(value):
        file = folder / str(value)
        return str(file if file.is_file() else value)

    words = []
    for key, value in options.items():
        name = f'--{key.replace("_", "-")}'
        if value is True:
            words.append(name)
        elif isinstance(value, list):
            words += [name, *map(word, value)]
        elif value is not False:
            words += [name, word(value)]
    return tuple(words)


def _check_words(path, command, words):
    """Raise if a command does not know its options."""
    from photutils_mgauss.cli.survey_steps import step_parser
    said = io.StringIO()
    parser = step_parser()
    with contextlib.redirect_stderr(said):
        try:
            _, unknown = parser.parse_known_args([command, 'x', *words])
        except SystemExit:
            last = said.getvalue().strip().splitlines()[-1]
            msg = f'{path}: [{command}]: {last.partition("error: ")[2]}'
            raise ValueError(msg) from None
    if unknown:
        msg = (f'{path}: [{command}] must have options of mgauss {command}, '
               f'got {unknown[0].removeprefix("--")}')
        raise ValueError(msg)


def _exposures(path, folder, wanted):
    patterns = wanted.get('files', [])
    patterns = [patterns] if isinstance(patterns, str) else patterns
    files = sorted({file for pattern in patterns
                    for file in _matching(folder, pattern)})
    if not files:
        msg = (f'{path}: files of [exposures] must name images, got none for '
               f'{", ".join(patterns) or "no pattern"}')
        raise ValueError(msg)
    found = [_exposure(file, ext, wanted.get('group_by', []))
             for file in files
             for ext in _extensions(file, wanted.get('ext'))]
    known = {}
    for exposure in found:
        other = known.setdefault(exposure.name, exposure)
        if other is not exposure:
            msg = (f'{path}: exposures must have different names, got '
                   f'{exposure.name} for {other.path} and {exposure.path}')
            raise ValueError(msg)
    return found


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


def _exposure(file, ext, group_by):
    from photutils_mgauss.cli.star_image import Reading, read_image
    from photutils_mgauss.sky.observers import julian_years
    with tools.about(file):
        image = read_image(file, Reading(ext=ext))
        image.check()
        for what, value in (('a WCS', image.wcs), ('a time', image.time)):
            if value is None:
                msg = f'must have {what} in its header, got none'
                raise ValueError(msg)
        group = tuple(_keyword(file, key) for key in group_by)
    chip = '' if ext is None or ',' not in str(ext) else (
        '_' + str(ext).replace(',', ''))
    return Exposure(f'{tools.stem(file)}{chip}', file, ext, group,
                    float(julian_years(image.time)), image.wcs,
                    image.data.shape)


def _keyword(file, key):
    """Return the value of a keyword, from whichever header has it."""
    from photutils_mgauss.files.image_layers import open_fits
    with open_fits(file) as hdus:
        for hdu in hdus:
            if key in hdu.header:
                return str(hdu.header[key])
    msg = f'must have the keyword {key}, which keeps fields apart'
    raise ValueError(msg)


def _fields(exposures, overlap):
    """Return the numbers of exposures by field: those that overlap."""
    pairs = [(i, j) for i, j in combinations(range(len(exposures)), 2)
             if exposures[i].group == exposures[j].group
             and _near(exposures[i], exposures[j])
             and max(exposures[i].share_inside(exposures[j]),
                     exposures[j].share_inside(exposures[i])) >= overlap]
    n = len(exposures)
    rows, columns = np.array(pairs, int).reshape(-1, 2).T
    _, label = connected_components(coo_matrix(
        (np.ones(len(rows)), (rows, columns)), shape=(n, n)), directed=False)
    return {f'field{k + 1:04d}': np.flatnonzero(label == k).tolist()
            for k in range(label.max() + 1)}


def _near(one, other):
    """Whether two images can overlap: their middles are close enough."""
    middles, reach = [], 0
    for exposure in (one, other):
        ny, nx = exposure.shape
        middle = exposure.wcs.pixel_to_world((nx - 1) / 2, (ny - 1) / 2)
        corner = exposure.wcs.pixel_to_world(0, 0)
        middles.append(SkyCoord(middle))
        reach += middle.separation(corner).deg
    return middles[0].separation(middles[1]).deg <= reach
