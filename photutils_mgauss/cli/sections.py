"""What a report says of PSFs, catalogues and proper motions."""
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from photutils_mgauss import plotting
from photutils_mgauss.cli.page import Panel, Section, Verdict
from photutils_mgauss.cli.psf_files import psf_kind, psf_record, read_psf
from photutils_mgauss.cli.seen_image import seen_image
from photutils_mgauss.plotting.style import BLACK
from photutils_mgauss.psf.shapes import adaptive_moments
from photutils_mgauss.utils.star_columns import column_values

# Nodes that whiskers and maps show along each axis at most.
_SHOWN = 12
# Ticks that axes of reduced chi2 and the like may have.
_TICKS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 1000)
# A median of reduced chi2 or uwe in this range says that errors are right.
_RIGHT = (0.8, 1.25)
# The error of a PSF, as a share of the light in a pixel, that photometry of
# crowded fields expects if nothing else is said.
_ACCURATE = 0.01
# More detections than this share are not rejected if all is well.
_MANY = 0.1
# Detections on a chip that a map of residuals takes.
_FOR_A_MAP = 200


def psf_section(path):
    """Return the section on a PSF file."""
    psf, record = read_psf(path), psf_record(path)
    middle = psf.grid_xypos.mean(axis=0)
    shapes = adaptive_moments(psf.mixtures)
    fwhm = np.atleast_1d(shapes.fwhm)
    facts = {'Nodes': ' x '.join(str(n) for n in psf.grid_shape[::-1]),
             'Gaussians at a node': psf.n_components,
             'FWHM, median [pix]': f'{np.median(fwhm):.3f}',
             'Ellipticity, median': f'{np.median(shapes.ellipticity):.3f}'}
    for name, words in (('n_stars', 'Stars used for the PSF'),
                        ('degree', 'Degree over the detector'),
                        ('accuracy', 'Relative error left')):
        value = record.get(name)
        if value is not None:
            facts[words] = value if name != 'accuracy' else (
                f'{value:.2g}' if value > 0 else 'none beyond the noise')
    panels = [Panel(lambda ax: plotting.plot_psf_image(psf, *middle, ax=ax),
                    'The PSF in the middle of the detector.'),
              Panel(lambda ax: plotting.plot_radial_profile(psf, *middle,
                                                            ax=ax),
                    'The PSF against the distance from the centre; the band '
                    'covers all directions.')]
    if len(psf.grid_xypos) > 1:
        panels += _maps(psf, record.get('stars'))
    return Section(f'PSF: {path}', verdict=_psf_verdict(fwhm, record),
                   facts=facts, panels=tuple(panels), record=record)


def _psf_verdict(fwhm, record):
    """Judge a PSF that was made of stars by their number and its misfit."""
    words = f'FWHM {np.median(fwhm):.2f} pix, {np.ptp(fwhm):.2f} pix of range'
    stars, degree = record.get('n_stars'), record.get('degree')
    if stars is None or degree is None:
        return Verdict(True, words)
    terms = (degree + 1) * (degree + 2) // 2
    words = (f'{words}; made of {stars} stars for the {terms} terms of a '
             f'polynomial of degree {degree}')
    enough = stars >= 2 * terms
    if not enough:
        words = (f'{words}, of which so few stars determine only some; errors '
                 'of positions and fluxes are larger for that, and more stars '
                 'would reduce them')
    error = record.get('accuracy') or 0
    if error > _ACCURATE:
        words = (f'{words}; it misses {error:.1%} of the light in a pixel, so '
                 'bright stars are measured worse than their noise allows: '
                 'more stars or Gaussians may help')
    return Verdict(enough and error <= _ACCURATE, words)


def _maps(psf, stars):
    coarse = _thinned(psf)
    panels = [
        Panel(lambda ax: plotting.plot_width_map(psf, stars=stars, ax=ax),
              'The width of the PSF over the detector'
              + (', and the stars it was made of.' if stars else '.')),
        Panel(lambda ax: plotting.plot_whiskers(coarse, ax=ax),
              'The ellipticity of the PSF, as whiskers along its long '
              'axis.')]
    if np.isfinite(np.asarray(psf.report['size_error'], float)).any():
        panels.append(Panel(
            lambda ax: plotting.plot_node_map(psf, 'size_error', ax=ax),
            'Size of the images relative to the mixtures fitted to them.'))
    return panels


def _thinned(psf):
    """Return a grid with no more nodes than whiskers can be told apart."""
    axes = [np.unique(psf.grid_xypos[:, k]) for k in (0, 1)]
    kept = [axis[::-(-axis.size // _SHOWN)] for axis in axes]
    inside = [np.isin(psf.grid_xypos[:, k], kept[k]) for k in (0, 1)]
    nodes = np.flatnonzero(inside[0] & inside[1])
    mixtures = psf.mixtures
    return type(psf)([mixtures[m] for m in nodes], psf.grid_xypos[nodes],
                     pixel_integrated=psf.pixel_integrated)


def catalogue_section(path, table, record):
    """Return the section on a catalogue of one image."""
    good = np.asarray(table['flags']) == 0 if 'flags' in table.colnames else (
        np.ones(len(table), bool))
    facts = _star_facts(table, good) | _when(record)
    panels = _star_panels(table, good, seen_image(path, table, record))
    return Section(f'Catalogue: {path}', verdict=_star_verdict(table, good),
                   facts=facts, panels=tuple(panels), record=record)


def _star_verdict(table, good):
    """Judge a catalogue by its flags and by how well the PSF fits."""
    words = f'{int(good.sum())} of {len(table)} stars without flags'
    if 'reduced_chi2' not in table.colnames or not good.any():
        return Verdict(good.mean() > 0.5, words)
    chi2 = float(np.nanmedian(column_values(table, 'reduced_chi2')[good]))
    right = _RIGHT[0] < chi2 < _RIGHT[1]
    return Verdict(bool(good.mean() > 0.5 and right), f'{words}; their '
                   f'median reduced chi2 is {chi2:.2f} (1 if the PSF and the '
                   'errors of pixels are correct)')


def _star_facts(table, good):
    """Return the numbers about a catalogue's stars."""
    flux, error = (column_values(table, name)
                   for name in ('flux_fit', 'x_err'))
    bright = flux >= np.nanpercentile(flux[good], 90) if good.any() else good
    return {'Stars': len(table), 'Without flags': int(good.sum()),
            'Median error of x [pix]': f'{np.nanmedian(error[good]):.4f}',
            'Median error of x of the brightest tenth [pix]':
                f'{np.nanmedian(error[bright & good]):.4f}'}


def _star_panels(table, good, seen):
    """Return the figures of a catalogue's stars, on its image if seen."""
    flux = column_values(table, 'flux_fit')
    unit = getattr(table['flux_fit'], 'unit', None)
    with np.errstate(invalid='ignore', divide='ignore'):
        magnitude = -2.5 * np.log10(flux)
    label = f'-2.5 log10(flux{"" if unit is None else f" in {unit}"})'
    errors = {name: column_values(table, name)[good]
              for name in ('x_err', 'y_err')}
    x, y = column_values(table, 'x_fit'), column_values(table, 'y_fit')
    panels = [
        Panel(lambda ax: plotting.plot_detections(
            x, y, flux, data=seen.data if seen and seen.whole else None,
            ax=ax), 'The stars; larger symbols are brighter.'),
        Panel(lambda ax: plotting.plot_stated_errors(
            magnitude[good], errors, unit='pix', label=label, ax=ax),
            'Errors of position against magnitude, of stars without flags.')]
    if 'reduced_chi2' in table.colnames:
        chi2 = {'reduced chi2': column_values(table, 'reduced_chi2')[good]}
        panels.append(Panel(
            lambda ax: _chi2(ax, magnitude[good], chi2, label),
            'Reduced chi2 of the stars: 1 if the residuals are only noise.'))
    if seen is not None and not seen.whole:
        (x0, y0), (ny, nx) = seen.corner, seen.data.shape
        near = (x >= x0) & (x < x0 + nx) & (y >= y0) & (y < y0 + ny)
        panels.append(Panel(
            lambda ax: plotting.plot_detections(
                x[near] - x0, y[near] - y0, flux[near], data=seen.data,
                ax=ax),
            f'The middle of the image, from pixel {x0}, {y0}.'))
    if seen is not None and seen.residual is not None:
        what = 'the image' if seen.whole else 'the middle of the image'
        panels.append(Panel(
            lambda ax: plotting.plot_residual_image(seen.residual, seen.error,
                                                    ax=ax),
            f'Residuals of {what}, in standard errors.'))
    return panels


def _chi2(ax, magnitude, chi2, label):
    plotting.plot_stated_errors(magnitude, chi2, unit='', label=label, ax=ax)
    low, high = ax.get_ylim()
    if high < 5 * low:
        ax.set_yscale('linear')
    else:
        ticks = [tick for tick in _TICKS if low <= tick <= high]
        ax.set_yticks(ticks, [f'{tick:g}' for tick in ticks])
    ax.set_ylabel('reduced chi2')
    ax.axhline(1, color=BLACK, linewidth=0.8)


def _when(record):
    time = record.get('exposure', {}).get('time')
    return {} if time is None else {'Middle of the exposure [Julian year]':
                                    f'{time:.4f}'}


def motion_section(path, table, record):
    """Return the section on a table of proper motions."""
    solved = np.isfinite(column_values(table, 'pmra_error'))
    unit = table['pmra'].unit
    facts = {'Stars': len(table), 'With proper motions': int(solved.sum())}
    # Files have no empty words, only missing ones.
    table['reference'] = (np.ma.filled(table['reference'], '')
                          if 'reference' in table.colnames else '')
    free = np.asarray(table['reference']) == ''
    facts['References'] = int(np.sum(~free))
    facts |= _gain(record.get('catalogues', {}), unit)
    facts |= _reference_facts(table)
    for name in ('pmra', 'pmdec'):
        values = column_values(table, f'{name}_error')[solved]
        if values.size:
            facts[f'Median error of {name} [{unit}]'] = (
                f'{np.median(values):.3f}')
    panels = _motion_panels(table, solved, free) if solved.any() else ()
    return Section(f'Proper motions: {path}', facts=facts, panels=panels,
                   verdict=_motion_verdict(table, solved, free),
                   text=' '.join(record.get('notes', [])), record=record)


def _motion_verdict(table, solved, free):
    """Judge motions by how many stars have one, and by their residuals."""
    words = (f'{int(solved.sum())} of {len(table)} objects have proper '
             'motions')
    if 'uwe' not in table.colnames:
        return Verdict(bool(solved.mean() > 0.5), words)
    uwe = column_values(table, 'uwe')[solved & free]
    uwe = uwe[np.isfinite(uwe) & (uwe > 0)]
    if not uwe.size:
        return Verdict(bool(solved.mean() > 0.5), f'{words}; with two epochs '
                       'the data cannot test their errors')
    middle = float(np.median(uwe))
    return Verdict(
        bool(solved.mean() > 0.5 and _RIGHT[0] < middle < _RIGHT[1]),
        f'{words}; residuals are {middle:.2f} times the stated errors')


def _reference_facts(table):
    """Return how references compare with their catalogue."""
    if 'dpmra' not in table.colnames:
        return {}
    pulls = np.concatenate([column_values(table, name)
                            / column_values(table, f'{name}_error')
                            for name in ('dpmra', 'dpmdec')])
    pulls = pulls[np.isfinite(pulls)]
    return {} if not pulls.size else {
        'References, measured minus catalogue, in their errors':
            f'{np.sqrt(np.mean(pulls**2)):.2f}'}


def _gain(catalogues, unit):
    """Return facts on what catalogues gave of the same exposures."""
    facts = {}
    if catalogues:
        facts['With proper motions from catalogues'] = catalogues['motions']
    if catalogues.get('both'):
        facts['Stars with motions from both'] = catalogues['both']
        for way in ('catalogues', 'pixels'):
            facts[f'Median error of these from {way} [{unit}]'] = (
                f'{catalogues["median_error_" + way]:.3f}')
    return facts


def _motion_panels(table, solved, free):
    panels = [Panel(lambda ax: plotting.plot_proper_motions(
        table[solved], ax=ax), 'The proper motions.')]
    if 'dpmra' in table.colnames:
        panels.append(Panel(
            lambda ax: plotting.plot_reference_differences(table, ax=ax),
            'The motions of references, measured from the exposures alone, '
            'minus those of the catalogue.'))
    # The motions of references are what a catalogue says.
    stars = table[solved & free]
    with np.errstate(invalid='ignore', divide='ignore'):
        flux = column_values(stars, 'flux')
        if flux.ndim > 1:  # one for each image
            flux = np.nanmean(flux, axis=1)
        magnitude = -2.5 * np.log10(flux)
    errors = {name: column_values(stars, f'{name}_error')
              for name in ('pmra', 'pmdec')}
    if np.isfinite(magnitude).any():
        panels.append(Panel(
            lambda ax: plotting.plot_stated_errors(
                magnitude, errors, unit=str(table['pmra'].unit),
                label='-2.5 log10(flux)', ax=ax),
            'Errors of the motions of stars against magnitude.'))
    return tuple(panels)


def cutout_section(path, table, record):
    """Return the section on what all images show of one star."""
    facts = {'Images': len(table)}
    if len(table):
        facts |= {'Star': table.meta['ID'], 'Signal to noise in all images':
                  f'{table.meta["SIGNIF"]:.1f}'}
    panels = (Panel(lambda ax: plotting.plot_cutouts(table, ax=ax),
                    'Image, model and residual for each exposure.'),
              ) if len(table) else ()
    return Section(f'A faint star: {path}', facts=facts, panels=panels,
                   text='The faintest star with a motion, in all images.',
                   record=record)


def alignment_section(path, table, record):
    """Return the section on how epochs were aligned."""
    rows, names = [], _names_of_epochs(record)
    for row in table:
        epoch = int(row['epoch'])
        line = {'Epoch': names.get(epoch, epoch), 'Year':
                f'{getattr(row["time"], "jyear", row["time"]):.3f}'}
        for name in ('shift', 'shift_error', 'systematic'):
            value = row[name]
            line[f'{name} [{value.unit}]'] = ', '.join(
                f'{one:.3g}' for one in np.ravel(value.value))
        for name in table.colnames:
            if name.startswith(('n_', 'rms')):
                unit = getattr(row[name], 'unit', None)
                words = name if unit is None else f'{name} [{unit}]'
                line[words] = _number(row[name])
        rows.append(line)
    return Section(f'Alignment: {path}', rows=rows, record=record,
                   verdict=_alignment_verdict(table, names),
                   text='The shift of the frame of each exposure in the '
                        'middle of the field, and the residuals of the '
                        'objects that align it: the references, or all '
                        'stars without any.')


def _names_of_epochs(record):
    """Return the names of the files that epochs were made of, by number."""
    inputs = record.get('exposures',
                        record.get('options', {}).get('inputs', []))
    return {i: Path(name).name for i, name in enumerate(inputs)}


def _alignment_verdict(table, names):
    """Judge an alignment by the references that were rejected."""
    if not {'n_references', 'n_rejected'} <= set(table.colnames):
        return None
    used = column_values(table, 'n_references')
    rejected = column_values(table, 'n_rejected')
    share = rejected / np.maximum(used + rejected, 1)
    worst = int(np.argmax(share))
    name = names.get(worst, f'epoch {worst}')
    return Verdict(bool(used.min() >= 5 and share[worst] < 0.25),
                   f'{int(used.min())} objects or more align each epoch; at '
                   f'most {share[worst]:.0%} of them were rejected ({name})')


def _number(value):
    values = np.ravel(getattr(value, 'value', value))
    return ', '.join(str(one) if np.issubdtype(values.dtype, np.integer)
                     else f'{one:.3g}' for one in values)


def residual_section(path, table, record):
    """Return the section on the residuals of all detections."""
    rows = table[_judged(table)]
    shown, names = SimpleNamespace(residuals=rows), _names_of_epochs(record)
    epochs, counts = np.unique(np.asarray(rows['epoch']), return_counts=True)
    panels = [Panel(lambda ax, epoch=epoch: plotting.plot_residual_vectors(
        shown, epoch, title=names.get(epoch), ax=ax),
        f'Residuals of {names.get(epoch, f"epoch {epoch}")}.')
        for epoch in epochs[counts > 1].tolist()]
    panels += _detector_panels(rows)
    return Section(
        f'Residuals: {path}', panels=tuple(panels), record=record,
        verdict=_residual_verdict(table, rows),
        facts={'Detections': len(table),
               'Detections of stars with three or more': len(rows)},
        text='Each arrow is a detection minus the fitted motion of its star; '
             'rejected detections are orange. A star with two detections '
             'has no residuals, because a line passes through both.')


def _residual_verdict(table, rows):
    """Judge residuals by the share of detections that were rejected."""
    if not len(rows):
        return Verdict(True, f'{len(table)} detections; none has a residual, '
                       'as no star has three')
    share = float(np.mean(~np.asarray(rows['used'], bool)))
    return Verdict(share < _MANY, f'{share:.1%} of {len(rows)} detections '
                   'were rejected')


def _detector_panels(rows):
    """Return maps of the residuals of each chip, where there are enough."""
    if 'dx_pix' not in rows.colnames:
        return []
    known = rows[np.isfinite(column_values(rows, 'dx_pix'))]
    chips, counts = np.unique(np.ma.filled(known['chip'], ''),
                              return_counts=True)
    return [Panel(lambda ax, chip=chip: plotting.plot_residual_map(
        known, chip, ax=ax),
        f'Mean residuals of all exposures over {_chip(chip)}, in pixels; '
        'grey where they are not significant.')
        for chip in chips[counts >= _FOR_A_MAP].tolist()]


def _chip(name):
    return f'chip {name}' if name else 'the detector'


def _judged(table):
    """Return which detections are not fitted exactly, as two of a star."""
    length, error = (np.hypot(*(column_values(table, f'{axis}{end}')
                                for axis in ('dra', 'ddec')))
                     for end in ('', '_error'))
    with np.errstate(invalid='ignore'):
        return np.isfinite(length) & (length > 1e-6 * error)


# The columns that tell a table, and what is said of it.
_TABLES = (({'pmra', 'pmra_error'}, motion_section),
           ({'image', 'data', 'model', 'residual'}, cutout_section),
           ({'dra', 'ddec', 'epoch'}, residual_section),
           ({'epoch', 'shift', 'matrix'}, alignment_section),
           ({'x_fit', 'y_fit', 'flux_fit'}, catalogue_section))


def section_of(path):
    """Return the section on a result, or None for any other file."""
    from photutils_mgauss.files.tables import read_table
    path = Path(path)
    suffix = Path(path.name.removesuffix('.gz')).suffix
    if suffix not in ('.ecsv', '.fits', '.asdf', '.psf'):
        return None
    if suffix != '.ecsv' and psf_kind(path) != 'image':
        return psf_section(path)
    if suffix in ('.asdf', '.psf'):
        return None
    try:
        table, record = read_table(path)
    except (OSError, ValueError):
        return None
    for columns, make in _TABLES:
        if columns <= set(table.colnames):
            return make(path, table, record)
    return None
