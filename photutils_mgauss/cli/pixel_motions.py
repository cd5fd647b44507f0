"""``mgauss motions --pixels``: motions from the pixels of all images."""
from functools import cache, partial
from pathlib import Path

from photutils_mgauss.cli import crowded_motions, tools
from photutils_mgauss.cli.observers import check_observer, observer_at
from photutils_mgauss.cli.progress import Progress
from photutils_mgauss.cli.results import Results, file_marks

_TABLES = ('motions', 'light_curves', 'images', 'cutouts')

_EXACT = ('the frames count as exact: there are no frame_errors of the WCS in '
          '--frames, and errors of stars are without theirs')

# Stars of both tables that are nearer than this are one.
_SAME = 0.1 / 3600


def add_options(parser):
    """Add what only this way of measuring motions needs."""
    group = parser.add_argument_group('motions from pixels')
    group.add_argument('--pixels', action='store_true',
                       help='fit each star to the pixels of all images '
                            'together; takes --psf. With --crowded all '
                            'stars and the sky are fitted together')
    group.add_argument('--psf', nargs='+', default=[], metavar='FILE',
                       help='with --pixels: the PSF of all images, or one '
                            'for each (default with --crowded: made from the '
                            'stars of each image)')
    group.add_argument('--band', nargs='+', metavar='NAME',
                       help='with --pixels: the filter of all images, or of '
                            'each, if they differ: stars have one flux or '
                            'similar ones in images of a filter')
    group.add_argument('--frames', metavar='FOLDER',
                       help='with --pixels: the output of mgauss motions for '
                            'these exposures, for the corrected WCS and '
                            'their errors (default: the WCS of the images, '
                            'without errors)')
    group.add_argument('--targets', metavar='TABLE',
                       help='with --pixels: ra and dec of the stars '
                            '(default: those found in all images together)')
    group.add_argument('--forced', action='store_true',
                       help='with --targets: fit only fluxes, at the '
                            'positions and motions of the table')
    group.add_argument('--refine-frames', action='store_true',
                       help='with --pixels: also fit the frames of the '
                            'images, to the pixels of bright stars')


def check_alone(options):
    """Raise for options that need --pixels, which is not given."""
    for name in ('psf', 'band', 'frames', 'targets', 'forced',
                 'refine_frames'):
        if getattr(options, name):
            msg = (f'--{name.replace("_", "-")} must be given with --pixels '
                   'only')
            raise ValueError(msg)


def run(options):
    """Measure the motions."""
    paths, folder = options.inputs, Path(options.output)
    _check(options)
    names = {name: folder / f'{name}.{options.format}'
             for name in _tables(options)}
    owners = tools.one_each(options.psf, len(paths), 'psf')
    bands = tools.one_each(options.band, len(paths), 'band')
    read = tools.read_images(options, paths)
    results = Results(options)
    results.claim(list(names.values()), [*paths, *options.psf])
    with Progress(len(paths) + 2, options) as step:
        epochs, marks = [], []
        for i, path in enumerate(paths):
            step(f'read {path}')
            image = read(i)
            frame = _frame(options, i)
            epochs.append(_epoch(options, image, owners[i], frame, bands[i]))
            marks.append([file_marks(path, owners[i], frame),
                          image.content])
            tools.say(options, f'{path}: {epochs[i] or image.describe()!r}')
        if options.frames and _frame_errors_file(options) is None:
            tools.say(options, _EXACT)
        if results.only_planned():
            return
        step('find and fit stars')
        solve = cache(partial(_solve, options, epochs))
        key = results.key(marks, file_marks(
            options.targets, _frame_errors_file(options)))
        tables = [results.obtain(path, f'{key}_{name}', partial(
            _made, options, solve, name), _read_table)
            for name, path in names.items()]
        step(f'write to {folder}')
        results.deliver()
    tools.say(options, *_summary(options, tables[0]),
              f'files are in {folder}')


def _tables(options):
    """Return the names of the tables."""
    # That of a crowded field has the fluxes of all images.
    return _TABLES[:1] if options.crowded else _TABLES


def _check(options):
    """Raise for what is wrong before anything is read."""
    if options.crowded:
        crowded_motions.check(options)
    elif not options.psf:
        msg = ('--pixels must have --psf, the PSF of all images or of each; '
               'only --crowded makes it of their stars')
        raise ValueError(msg)
    if options.forced and not options.targets:
        msg = '--forced must have --targets, a table of places'
        raise ValueError(msg)
    if options.forced and options.refine_frames:
        msg = '--refine-frames must be given without --forced'
        raise ValueError(msg)
    if options.plane or options.parallax_of or options.references:
        msg = ('--pixels must be given without --plane, --parallax-of and '
               '--references; the frames come from --frames')
        raise ValueError(msg)
    if options.frames is not None and not Path(options.frames).is_dir():
        msg = (f'--frames must be the output folder of mgauss motions, got '
               f'{options.frames}')
        raise ValueError(msg)
    tools.check_inputs([*options.inputs, *options.psf, options.targets])
    tools.check_different(options.inputs)
    check_observer(options.observer, len(options.inputs))
    folder = Path(options.output)
    if folder.exists() and not folder.is_dir():
        msg = f'{folder}: --output must be a folder, but is a file'
        raise NotADirectoryError(msg)


def _frame(options, i):
    """Return the file with the corrected WCS of an image, or None."""
    # A WCS that is given is what the image is read with.
    if options.frames is None or options.wcs:
        return None
    name = tools.output_names(options.inputs, options.frames, '_wcs', (),
                              '.fits')[i]
    for suffix in ('.asdf', '.fits'):
        if name.with_suffix(suffix).is_file():
            return name.with_suffix(suffix)
    msg = (f'--frames must be a folder of mgauss motions with the WCS of '
           f'all images, got no {name.with_suffix("").name} in '
           f'{options.frames}')
    raise ValueError(msg)


def _epoch(options, image, psf, frame, band):
    """Return the `ImageEpoch`, or None if a dry run would make its PSF."""
    from photutils_mgauss.files.image_layers import read_wcs
    from photutils_mgauss.pixel_motions import ImageEpoch
    wcs = image.wcs if frame is None else read_wcs(frame)
    with tools.about(image.path):
        for what, value, option in (('a WCS', wcs, '--wcs or --frames'),
                                    ('a time', image.time, '--time')):
            if value is None:
                msg = f'must have {what}, got none; give {option}'
                raise ValueError(msg)
        observer = observer_at(options.observer, image.path, options.inputs,
                               image.time)
    model = _psf(options, image, psf)
    if model is None:
        return None
    with tools.about(image.path):
        data, error, mask = (
            (image.data, image.noise.total, image.useless)
            if options.crowded else
            (image.without_sky, image.noise.background, image.mask))
        unit = 1 if image.unit is None else image.unit
        return ImageEpoch(data * unit, model, wcs, image.time, mask=mask,
                          error=error * unit, band=band, observer=observer)


def _psf(options, image, file):
    """Return the PSF of a file or else of the image's stars."""
    from photutils_mgauss.cli.psf_files import read_psf
    if file is not None:
        with tools.about(file):
            return read_psf(file)
    return None if options.dry_run else crowded_motions.own_psf(options,
                                                                image)


def _solve(options, epochs):
    """Return the tables that a solution makes, by name."""
    from photutils_mgauss.files.tables import read_table
    stars = None
    if options.targets is not None:
        stars, _ = read_table(options.targets)
    frames = _frame_errors(options)
    if options.crowded:
        return {'motions': crowded_motions.solve(options, epochs, stars,
                                                 frames)}, ()
    from photutils_mgauss.pixel_motions import PixelMotionFitter
    fitter = PixelMotionFitter(parallax=options.parallax,
                               forced=options.forced, references=frames,
                               refine_frames=options.refine_frames,
                               fit_shape=options.fit_shape)
    solution = fitter.fit(epochs, stars)
    return {'motions': solution.stars, 'images': solution.images,
            'light_curves': solution.fluxes,
            'cutouts': solution.cutouts()}, solution.notes


def _frame_errors(options):
    """Return the errors of the frames given, or None."""
    from photutils_mgauss.motions.frame_errors import FrameErrors
    file = _frame_errors_file(options)
    if file is None:
        return None
    with tools.about(file):
        return FrameErrors.from_table(_read_table(file))


def _frame_errors_file(options):
    """Return the file of the errors of the frames given, or None."""
    # A WCS that is given is not that of the frames.
    if options.frames is None or options.wcs:
        return None
    found = [Path(options.frames) / f'frame_errors{suffix}'
             for suffix in ('.ecsv', '.fits')]
    return next(filter(Path.is_file, found), None)


def _made(options, solve, name):
    """Return one of the tables of a solution, and what writes it."""
    tables, notes = solve()
    table, more = tables[name], {'notes': list(notes)}
    if name == 'motions' and options.frames is not None:
        more['catalogues'] = _gain(options, table)
    return table, partial(tools.write_table, table,
                          record=tools.record_of(options, **more))


def _gain(options, stars):
    """Return what catalogues gave of the same exposures, as numbers."""
    import numpy as np
    from astropy.coordinates import SkyCoord
    found = [file for file in Path(options.frames).glob('motions.*')
             if file.suffix in ('.ecsv', '.fits')]
    if not found:
        return {}
    before = _read_table(found[0])
    out = {'motions': int(_solved(before).sum())}
    pairs = [table[_solved(table)] for table in (stars, before)]
    if not all(len(table) for table in pairs) or 'ra' not in before.colnames:
        return out
    places = [SkyCoord(table['ra'], table['dec'], unit='deg')
              for table in pairs]
    index, away, _ = places[0].match_to_catalog_sky(places[1])
    same = away.deg < _SAME
    out['both'] = int(same.sum())
    if same.any():
        for way, errors in (('pixels', _errors(pairs[0])[same]),
                            ('catalogues', _errors(pairs[1])[index[same]])):
            out[f'median_error_{way}'] = float(np.median(errors))
    return out


def _read_table(path):
    from photutils_mgauss.files.tables import read_table
    return read_table(path)[0]


def _summary(options, stars):
    """Return lines on what came out, and on what catalogues gave."""
    n = int(_solved(stars).sum())
    lines = [f'{len(stars)} stars at the places given' if options.forced else
             f'{len(stars)} stars, {n} with proper motions']
    gain = {} if options.frames is None else _gain(options, stars)
    if gain:
        lines.append(f'{gain["motions"]} stars have proper motions from the '
                     'catalogues of --frames')
    return lines


def _errors(stars):
    """Return the errors (n,) of motions along right ascension."""
    import numpy as np
    return np.ma.filled(np.ma.asarray(getattr(
        stars['pmra_error'], 'value', stars['pmra_error'])), np.nan)


def _solved(stars):
    """Return which stars (n,) have motions."""
    import numpy as np
    return np.isfinite(_errors(stars))
