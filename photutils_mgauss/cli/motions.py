"""``mgauss motions``: catalogues or images to motions and corrected WCS."""
import json
import warnings
from argparse import ArgumentTypeError
from functools import cache, partial
from operator import attrgetter
from pathlib import Path

from photutils_mgauss.cli import chips, photometry, pixel_motions, tools
from photutils_mgauss.cli import psf as psf_command
from photutils_mgauss.cli.catalogues import is_table, read_catalogue
from photutils_mgauss.cli.observers import check_observer, observer_at
from photutils_mgauss.cli.progress import Progress
from photutils_mgauss.cli.psf_stars import check_image, check_start
from photutils_mgauss.cli.results import (
    Results,
    add_checkpoint,
    add_dry_run,
    file_marks,
)

# As many stars are too few to find out about the errors of exposures.
_FEW = 5
_TOO_MUCH = 2.0

# Errors of frames of more numbers make no table.
_MOST_NUMBERS = 1_000_000

# Running numbers of one image are no names of stars.
_NUMBERS = ('id', 'group_id')


def add(commands):
    """Add the command to the parser's."""
    parser = tools.command(
        commands, 'motions', 'proper motions and corrected WCS',
        'Match the stars of two or more exposures, or of one and a catalogue '
        'like that of Gaia, align the exposures on objects with known '
        'motions, and fit proper motions. Inputs are catalogues, of mgauss '
        'photometry, with ra, dec and their errors, or star lists of other '
        'programs, or images, which are measured first. Without references '
        'the motions are relative to the mean of the stars.',
        'mgauss motions night1_cat.ecsv night2_cat.ecsv '
        '--references quasars.ecsv', run)
    tools.add_inputs(parser, 'FILE', 'a catalogue or an image of each '
                                     'exposure')
    tools.add_folder(parser, 'mgauss_motions')
    parser.add_argument('--format', choices=('ecsv', 'fits'), default='ecsv',
                        help='of the tables (default: %(default)s)')
    _add_solution(parser)
    chips.add_options(parser)
    pixel_motions.add_options(parser)
    tools.add_times(parser)
    psf_command.add_fit(parser)
    photometry.add_measuring(parser)
    tools.add_reading(parser)
    add_checkpoint(parser)
    add_dry_run(parser)
    tools.add_overwrite(parser)
    parser.set_defaults(grid_shape=[30, 30])


def _add_solution(parser):
    group = parser.add_argument_group('the motions')
    group.add_argument('--references', metavar='TABLE',
                       help='objects with known motions: ra, dec and class '
                            '(qso, galaxy, star, position), or a table of '
                            'Gaia')
    group.add_argument('--reference-class', metavar='CLASS',
                       choices=('qso', 'galaxy', 'star', 'position'),
                       help='class of all references, for tables without a '
                            'column class')
    group.add_argument('--transform', metavar='KIND', type=tools.transform,
                       help='how the frames of exposures may differ: none, '
                            'shift, rigid, similarity, affine, poly-2, ... '
                            '(default: affine, or none with --parallax-of)')
    group.add_argument('--recipe', choices=('joint', 'two-step', 'paper'),
                       default='joint', help='default: %(default)s')
    group.add_argument('--parallax', action='store_true',
                       help='fit parallaxes, too')
    group.add_argument('--parallax-of', metavar='TABLE',
                       help='fit only the parallaxes of the objects in a '
                            'table, with id, ra, dec, pmra, pmdec, ref_epoch '
                            '(and errors), and a rough parallax to find them')
    group.add_argument('--systematic', type=_systematic, metavar='MAS',
                       help='error of each exposure, in pixels with --plane, '
                            'added to the errors of its stars (default: '
                            'fitted); magnitude also '
                            'corrects the errors of stars as a function of '
                            'magnitude')
    group.add_argument('--terms', nargs='+', default=[],
                       choices=('magnitude', 'colour', 'y'),
                       help='fit displacements that depend on these; used if '
                            'they predict stars that were left out of the fit')
    group.add_argument('--observer', metavar='NAME',
                       help='place of the observer, for parallaxes: earth, '
                            'leo, l2, or a table of barycentric positions x, '
                            'y, z [au], one for each exposure or with times')
    group.add_argument('--max-motion', type=tools.positive, default=50,
                       metavar='MAS/YR', help='largest motion considered in '
                       'matching (default: %(default)s)')
    group.add_argument('--match-radius', type=tools.positive, metavar='MAS',
                       help='largest distance of a match, in pixels with '
                            '--plane (default: from the errors)')
    group.add_argument('--match-by', choices=('auto', 'id', 'sky',
                                              'pattern'), default='auto',
                       help='pattern finds wrong pointings, rolls and lists '
                            'that are turned or mirrored '
                            '(default: %(default)s)')
    group.add_argument('--good-flags', type=tools.not_negative,
                       default=0, metavar='BITS', help='sum of the flags '
                       'that do not exclude a detection')
    group.add_argument('--plane', action='store_true',
                       help='use pixels as coordinates, without a WCS')


def _systematic(text):
    """Return a positive number or 'magnitude', for argparse."""
    try:
        return text if text == 'magnitude' else tools.positive(text)
    except ArgumentTypeError as error:
        msg = f'must be a positive number or magnitude, got {text}'
        raise ArgumentTypeError(msg) from error


def run(options):
    """Measure the motions."""
    if options.pixels:
        pixel_motions.run(options)
        return
    paths = options.inputs
    _check(options)
    folder = Path(options.output)
    pieces = chips.pieces_of(options, [is_table(path) for path in paths])
    names = _Names(folder, pieces, options)
    images = tools.read_images(options, paths)

    def read(k):
        return images(pieces[k].given, pieces[k].ext)

    fitter = _fitter(options)
    results = Results(options)
    results.claim(names.all(), paths)
    with Progress(1 + len(pieces) + 2, options) as step:
        step('look at all files')
        seen = [_from_catalogue(options, piece) if piece.is_table
                else _check_image(options, read(k))
                for k, piece in enumerate(pieces)]
        if results.only_planned(names.without_wcs()):
            return
        for k, piece in enumerate(pieces):
            step(f'{"use" if piece.is_table else "measure"} {piece.name}')
            if not piece.is_table:
                seen[k] = _from_image(options, read(k), names, k, results)
        exposures = chips.exposures_of(pieces, seen, options.chips)
        epochs = [_epoch(options, pieces, seen, own) for own in exposures]
        step('align and fit')
        solution = fitter.fit(epochs)
        step(f'write to {folder}')
        record = tools.record_of(
            options, notes=list(solution.notes),
            exposures=[Path(seen[own[0]].image).name for own in exposures],
            pieces={tools.stem(pieces[k].name): [epoch, seen[k].ext]
                    for epoch, own in enumerate(exposures) for k in own})
        _collect(solution, names, exposures, record, results)
        # Nothing is written before all is well.
        results.deliver()
    tools.say(options, *_summary(solution), f'files are in {folder}')


def _check(options):
    """Raise for what is wrong before anything is read."""
    pixel_motions.check_alone(options)
    chips.check(options)
    tools.check_inputs([*options.inputs, options.references, options.stars,
                        options.start, options.parallax_of])
    check_start(options)
    if options.parallax_of and (options.references or options.plane):
        msg = ('--parallax-of must be given without --references and '
               '--plane: its table has the references')
        raise ValueError(msg)
    tools.check_different(options.inputs)
    check_observer(options.observer, len(options.inputs))
    if len(options.inputs) < 2 and not options.references:
        msg = (f'inputs must be at least 2 exposures, got only '
               f'{options.inputs[0]}; one is enough with --references that '
               'have positions of another time')
        raise ValueError(msg)
    folder = Path(options.output)
    if folder.exists() and not folder.is_dir():
        msg = f'{folder}: --output must be a folder, but is a file'
        raise NotADirectoryError(msg)


class _Names:
    """The names of all files of a run."""

    def __init__(self, folder, pieces, options):
        def named(ending, suffix):
            return tools.output_names([piece.name for piece in pieces],
                                      str(folder), ending, (), suffix)
        tables = ['motions', 'alignment', 'residuals']
        tables += [] if options.plane else ['frame_errors']
        tables += ['terms'] if options.terms else []
        self.tables = {name: folder / f'{name}.{options.format}'
                       for name in tables}
        images = [not piece.is_table for piece in pieces]
        self.psfs = _where(images, named('_psf', '.fits'))
        self.catalogues = _where(images, named('_cat', f'.{options.format}'))
        self.wcs = [name.with_suffix('') for name in named('_wcs', '.fits')]

    def without_wcs(self):
        """Return the names of what is always written."""
        return [*self.tables.values(), *filter(None, self.psfs),
                *filter(None, self.catalogues)]

    def all(self):
        """Return every name that may be written to."""
        return self.without_wcs() + [
            name.with_suffix(suffix) for name in self.wcs
            for suffix in ('.fits', '.asdf')]


def _where(chosen, names):
    return [name if yes else None
            for yes, name in zip(chosen, names, strict=True)]


def _check_image(options, image):
    """Raise if an image cannot become an epoch."""
    check_image(image)
    if image.wcs is None and not options.plane:
        raise ValueError(_no_sky(image.path))
    if image.time is None:
        raise ValueError(_no_time(image.path))


def _from_image(options, image, names, k, results):
    """Return what is seen in an image."""
    key = results.key(file_marks(image.path, image.reading.wcs,
                                 options.stars, options.start),
                      image.content)
    psf = results.obtain(names.psfs[k], key, partial(
        psf_command.make, options, image), psf_command.read)
    name = names.catalogues[k]
    table = results.obtain(name, f'{key}_cat', partial(
        photometry.make, options, image, psf, name), _read_table)
    return _seen(options, str(image.path), table, image.wcs, image.time,
                 image=(str(image.path), image.reading.ext))


def _read_table(path):
    from photutils_mgauss.files.tables import read_table
    return read_table(path)[0]


def _from_catalogue(options, piece):
    """Return what is seen in a catalogue."""
    with tools.about(piece.path):
        return _seen_in_catalogue(options, piece.path, piece.given)


def _seen_in_catalogue(options, path, i):
    found = read_catalogue(options, path, i)
    image = (chips.image_of(path, found.record) if options.chips
             else (path, None))
    return _seen(options, path, found.table, found.wcs, found.time,
                 image=image)


def _seen(options, path, table, wcs, time, *, image):
    """Return what was seen, its flagged rows left out."""
    from photutils_mgauss.motions import Epoch
    from photutils_mgauss.motions.columns import names_of
    from photutils_mgauss.utils.star_columns import find_column
    if find_column(table, (*names_of('x'), 'ra')) is None:
        raise ValueError(tools.no_places(path, table))
    if time is None and 'time' not in table.colnames:
        raise ValueError(_no_time(path))
    table = _usable(table, options.good_flags)
    wcs = None if options.plane else wcs
    if wcs is None and not options.plane:
        table = _on_the_sky(path, table)
    with tools.about(path):
        observer = observer_at(options.observer, path, options.inputs,
                               table['time'] if time is None else time)
        if options.parallax_of:
            table = _only_targets(options, path, table, time, observer)
        # What is wrong with a catalogue is found before images are measured.
        Epoch(table, wcs, time, observer=observer)
    return chips.Seen(table, wcs, time, observer, *image)


def _epoch(options, pieces, seen, own):
    """Return the `Epoch` of an exposure, of its pieces with these numbers."""
    from photutils_mgauss.motions import Epoch
    paths, parts = [pieces[k].path for k in own], [seen[k] for k in own]
    if len(own) > 1 or (options.chips and parts[0].ext is not None):
        epoch = chips.epoch_of(paths, parts)
    else:
        one = parts[0]
        with tools.about(paths[0]):
            epoch = Epoch(one.table, one.wcs, one.time, observer=one.observer)
    tools.say(options, f'{paths[0]}: {epoch!r}')
    return epoch


@cache
def _targets(path):
    from photutils_mgauss.cli.targets import check_targets
    from photutils_mgauss.files.tables import read_table
    table, _ = read_table(path)
    with tools.about(path):
        check_targets(table)
    return table


def _only_targets(options, path, table, time, observer):
    import numpy as np

    from photutils_mgauss.cli.targets import only_targets
    from photutils_mgauss.sky.observers import julian_years
    years = julian_years(table['time'] if time is None else time)
    if 'ra' not in table.colnames:
        raise ValueError(_no_sky(path))
    found, words = only_targets(table, _targets(options.parallax_of),
                                float(np.nanmean(years)), observer,
                                options.match_radius)
    tools.say(options, *(f'{path}: {one}' for one in words))
    return found


def _usable(table, good_flags):
    if 'flags' in table.colnames:
        flags = table['flags'].astype(int)
        table = table[(flags & ~good_flags) == 0]
    # Where photutils' columns are, numbers are those of one image.
    running = _NUMBERS if 'x_fit' in table.colnames else ()
    return table[[name for name in table.colnames if name not in running]]


def _on_the_sky(path, table):
    """Return a table of places on the sky, with their covariance."""
    if 'ra' not in table.colnames or 'dec' not in table.colnames:
        raise ValueError(_no_sky(path))
    table = table.copy()
    if 'xy_cov' in table.colnames:
        table.remove_column('xy_cov')
    if 'radec_cov' in table.colnames:
        table['xy_cov'] = table['radec_cov']
    return table


def _no_sky(path):
    return (f'{path}: must have a WCS or columns ra and dec, got neither; '
            'give --wcs, or --plane for motions in pixels')


def _no_time(path):
    return f'{path}: the time must be known; its header has none, give --time'


def _fitter(options):
    import astropy.units as u

    from photutils_mgauss.motions import ProperMotionFitter
    radius, alone = options.match_radius, options.parallax_of is not None
    transform = options.transform or ('none' if alone else 'affine')
    systematic = options.systematic
    length = u.pix if options.plane else u.mas
    return ProperMotionFitter(
        transform=None if transform == 'none' else transform,
        recipe=options.recipe, parallax=alone or options.parallax,
        references=_references(options),
        match_by='id' if alone else options.match_by,
        systematic=(systematic * length if isinstance(systematic, float)
                    else systematic or 'fit'),
        terms=tuple(options.terms), **_distortion(options),
        max_motion=options.max_motion * u.mas / u.yr,
        match_radius=None if radius is None else radius * length)


def _distortion(options):
    kind = options.distortion
    return {} if kind is None else {
        'distortion': None if kind == 'none' else kind}


def _references(options):
    if options.parallax_of is not None:
        from photutils_mgauss.cli.targets import without_parallax
        return without_parallax(_targets(options.parallax_of))
    if options.references is None:
        return None
    from photutils_mgauss.files.tables import read_table
    from photutils_mgauss.motions.references import read_catalogue
    from photutils_mgauss.sky.tangent_plane import TangentPlane
    table, _ = read_table(options.references)
    if options.reference_class is not None:
        table['class'] = options.reference_class
    # Identifiers of another catalogue say nothing about these stars.
    table = table[[name for name in table.colnames if name != 'id']]
    with tools.about(options.references):
        # Whether it can be used is found out before anything is measured.
        if options.plane:
            read_catalogue(table, None, 'pix')
        else:
            read_catalogue(table, TangentPlane(0.0, 0.0), 'mas')
    return table


def _collect(solution, names, exposures, record, results):
    """Obtain the tables and the WCS."""
    key = results.key(_content(solution))
    for name, path in names.tables.items():
        table = _TABLES[name](solution)
        if table is None:
            continue
        write = partial(tools.write_table, table, record=record)
        results.obtain(path, f'{key}_{name}', partial(_made, table, write))
    for epoch, own in zip(solution.epochs, exposures, strict=True):
        for k, wcs in zip(own, _all_wcs(epoch), strict=True):
            if wcs is not None:
                suffix, write = wcs_writer(wcs, epoch.mean_year, record)
                results.obtain(names.wcs[k].with_suffix(suffix),
                               f'{key}_wcs{k}', partial(_made, wcs, write))


def _stars(solution):
    """Return the stars, and what references measured against catalogue."""
    import numpy as np
    stars, away = solution.stars.copy(), solution.reference_differences()
    order = np.argsort(np.asarray(stars['id']))
    rows = order[np.searchsorted(np.asarray(stars['id'])[order],
                                 np.asarray(away['id']))]
    for name in away.colnames[1:-1] if len(away) else ():
        values = np.full(len(stars), np.nan)
        values[rows] = away[name].value
        stars[name] = values * away[name].unit
    return stars


def _residuals(solution):
    """Return the residuals, also in the pixels of the detectors."""
    from astropy.table import hstack
    return hstack([solution.residuals, solution.detector_residuals()])


def _frame_errors(solution):
    """Return what --pixels --frames has to know of the frames."""
    from astropy.utils.exceptions import AstropyUserWarning

    from photutils_mgauss.motions.frame_errors import FrameErrors
    errors = FrameErrors.of(solution)
    if errors.factor.size > _MOST_NUMBERS:
        warnings.warn(
            f'frame_errors is not written: {errors.factor.size} numbers are '
            'too many for a table; --pixels --frames takes these frames as '
            'exact', AstropyUserWarning, stacklevel=2)
        return None
    return errors.to_table()


_TABLES = {'motions': _stars, 'residuals': _residuals,
           'frame_errors': _frame_errors,
           'alignment': attrgetter('alignment'), 'terms': attrgetter('terms')}


def _all_wcs(epoch):
    """Return the WCS of an epoch, or those of its chips."""
    return [epoch.wcs] if epoch.chips is None else list(epoch.chips.values())


def _made(result, write):
    return result, write


def _content(solution):
    """Return the numbers of a solution, by which it is known again."""
    import numpy as np
    return [[np.asarray(getattr(column, 'value', column))
             for column in table.itercols()] for table in (
                 solution.stars, solution.alignment, solution.residuals)]


def wcs_writer(wcs, year, record):
    """
    Return the suffix of a WCS, and what writes it.

    A gwcs is written as ASDF, any other as a FITS header.
    """
    from gwcs import WCS as GWCS
    if isinstance(wcs, GWCS):
        import asdf
        return '.asdf', asdf.AsdfFile({'wcs': wcs,
                                       'mgauss': record}).write_to
    from astropy.io import fits

    from photutils_mgauss.sky.observers import tdb
    header = wcs.to_header(relax=True)
    header['MJD-AVG'] = tdb(year).mjd, 'middle of the exposure'
    header['TIMESYS'] = 'TDB'
    header['MGRUN'] = json.dumps(record)
    return '.fits', fits.PrimaryHDU(header=header).writeto


def _summary(solution):
    """Return lines on what came out."""
    import numpy as np
    stars = solution.stars
    errors = [stars[name] for name in ('pmra_error', 'pmdec_error')]
    solved = np.isfinite(errors[0].value)
    lines = [f'{solved.sum()} of {len(stars)} stars have proper motions']
    if solved.any():
        median = np.median([error.value[solved] for error in errors])
        lines.append(f'median error {median:.3g} {errors[0].unit}')
    lines += _parallaxes(stars)
    _check_scatter(solution)
    return [*lines, *(f'note: {note}' for note in solution.notes)]


def _parallaxes(stars):
    """Return a line for each parallax, if there are only a few."""
    import numpy as np
    if 'parallax' not in stars.colnames:
        return []
    known = stars[np.isfinite(stars['parallax_error'].value)]
    return [f'parallax of {star["id"]}: {star["parallax"].value:.3f} +- '
            f'{star["parallax_error"]:.3f}'
            for star in known] if len(known) <= _FEW else []


def _check_scatter(solution):
    """Warn if the detections scatter more than their errors allow."""
    import numpy as np
    rows = solution.residuals
    pulls = np.concatenate([(rows[name] / rows[f'{name}_error']).value
                            for name in ('dra', 'ddec')])
    pulls = pulls[np.isfinite(pulls) & (pulls != 0)]
    scatter = np.sqrt(np.mean(pulls**2)) if pulls.size else 0
    if len(solution.stars) <= _FEW and scatter > _TOO_MUCH:
        warnings.warn(
            f'positions scatter {scatter:.3g} times as much as their errors '
            'allow, and so may the results; give --systematic, the error of '
            'an exposure', UserWarning, stacklevel=2)
