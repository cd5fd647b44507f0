"""What a survey leaves for people: an index page, and one dataset."""
import json
import shutil
from dataclasses import replace
from html import escape
from pathlib import Path

import numpy as np

from photutils_mgauss.cli import tools
from photutils_mgauss.cli.exposure_quality import (
    CATALOGUE,
    FIELD,
    FieldOfExposures,
    judge,
)
from photutils_mgauss.utils.star_columns import column_values

# Order of the HEALPix pixels that divide the dataset, and of its index.
_ORDER, _INDEX_ORDER = 5, 29
# Stars nearer to another pixel than this may have a twin in it [deg].
_MARGIN = 5 / 3600

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Survey</title><style>
body {{ font: 16px/1.5 system-ui, sans-serif; margin: 0 auto; padding: 16px;
       max-width: 1200px; color: #1b2733; background: #fff; }}
.wide {{ overflow-x: auto; }}
table {{ border-collapse: collapse; font-size: 0.9em; }}
th, td {{ padding: 3px 12px 3px 0; text-align: right;
         border-bottom: 1px solid #d5dde4; white-space: nowrap; }}
th:first-child, td:first-child, th:last-child {{ text-align: left; }}
td.words {{ text-align: left; white-space: normal; }}
td.words:not(:first-child, :empty) {{ min-width: 30ch; }}
th {{ cursor: pointer; }}
.failed td:first-child {{ border-left: 6px solid #d55e00; padding-left: 6px; }}
.look td:first-child {{ border-left: 6px solid #e69f00; padding-left: 6px; }}
@media (prefers-color-scheme: dark) {{
  body {{ color: #dce4ea; background: #15191d; }} a {{ color: #7cc0ee; }}
  th, td {{ border-color: #38424b; }} }}
</style></head><body><h1>Survey</h1><p>{summary}</p>
<h2>Exposures</h2>{exposures}<h2>Fields</h2>{fields}
<script>
document.querySelectorAll("th").forEach(th => th.onclick = () => {{
  const body = th.closest("table").tBodies[0], k = th.cellIndex;
  const sign = th.dataset.sign = -(th.dataset.sign || -1);
  const of = row => row.cells[k].textContent;
  [...body.rows].sort((a, b) => sign * (
    (parseFloat(of(a)) - parseFloat(of(b))) || of(a).localeCompare(of(b))))
    .forEach(row => body.append(row));
}});
</script></body></html>
"""


def write_index(folder, exposures, fields, summary):
    """
    Write the page that lists all exposures and fields, bad ones first.

    Parameters
    ----------
    folder : `~pathlib.Path`
        Where ``index.html`` goes.
    exposures, fields : list of dict
        A row for each, with the same keys; ``'trouble'`` is a sentence or
        empty.
    summary : str
        A sentence for the top.
    """
    page = _PAGE.format(summary=escape(summary), exposures=_table(exposures),
                        fields=_table(fields))
    with tools.whole_file(folder / 'index.html') as draft:
        draft.write_text(page, encoding='utf-8')


def _table(rows):
    if not rows:
        return '<p>none</p>'
    rows = sorted(rows, key=lambda row: row['trouble'] == '')  # stable
    head = ''.join(f'<th scope="col">{escape(name)}</th>' for name in rows[0])
    body = ''.join(
        f'<tr{_class(row)}>' + ''.join(
            _cell(value) for value in row.values()) + '</tr>'
        for row in rows)
    return (f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>'
            f'{body}</tbody></table></div>')


def _class(row):
    if row['trouble']:
        return ' class=failed'
    return ' class=look' if row.get('look at') else ''


def _cell(value):
    if isinstance(value, Path):
        return (f'<td><a href="{escape(value.as_posix())}">'
                f'{escape(value.stem)}</a></td>')
    if isinstance(value, float):
        return f'<td>{value:.4g}</td>' if np.isfinite(value) else '<td></td>'
    words = ' class=words' if isinstance(value, str) else ''
    return f'<td{words}>{escape(str(value))}</td>'


def exposure_figures(task):
    """Return how good an exposure's PSF and catalogue are, by name."""
    from photutils_mgauss.files.tables import read_table
    table, _ = read_table(task.outputs[0])
    good = np.asarray(table['flags']) == 0
    row = {'stars': len(table), 'without flags': float(good.mean())}
    if 'reduced_chi2' in table.colnames and good.any():
        row['reduced chi2'] = float(np.nanmedian(
            column_values(table, 'reduced_chi2')[good]))
    if good.any():
        flux = column_values(table, 'flux_fit')[good]
        bright = flux >= np.nanpercentile(flux, 90)
        row['x_err of bright stars [pix]'] = float(np.nanmedian(
            column_values(table, 'x_err')[good][bright]))
    words = task.commands[-1]
    if '--psf' in words:
        row |= _psf_figures(words[words.index('--psf') + 1])
    return row


def _psf_figures(path):
    from photutils_mgauss.cli.psf_files import psf_kind, read_psf
    if psf_kind(path) != 'mixtures':
        # To fit it again for its width alone takes too long.
        return {}
    from photutils_mgauss.psf.shapes import adaptive_moments
    shapes = adaptive_moments(read_psf(path).mixtures)
    return {'FWHM [pix]': float(np.nanmedian(shapes.fwhm)),
            'ellipticity': float(np.nanmedian(shapes.ellipticity))}


def field_figures(task):
    """Return how many motions a field has, and where its stars are."""
    from photutils_mgauss.files.tables import read_table
    table, _ = read_table(task.outputs[0])
    error = column_values(table, 'pmra_error')
    solved = np.isfinite(error)
    row = {'stars': len(table), 'with motions': int(solved.sum())}
    if solved.any():
        row['median pmra_error [mas / yr]'] = float(np.median(error[solved]))
    row['pixels'] = pixels_of(table)
    return row


def field_and_exposures(task):
    """Return the figures of a field, with those of its exposures."""
    field = FieldOfExposures(Path(task.outputs[0]).parent)
    return field_figures(task) | {'exposures': field.figures()}


# What is looked at when a task of a kind is done.
FIGURES = {'exposure': exposure_figures, 'field': field_and_exposures,
           'pixels': field_figures}
_FIELD = ('stars', 'with motions', 'median pmra_error [mas / yr]')


def exposure_rows(survey, done, fields, pages):
    """
    Return the rows of all exposures, the worst first.

    Parameters
    ----------
    survey : Survey
        The plan.
    done, fields, pages : dict of str to Outcome
        What became of exposures, fields and pages.

    Returns
    -------
    list of dict
        One for each exposure: its figures of merit, among the others of its
        field and of its camera, and what is bad about it.
    """
    within = {name: figures for outcome in fields.values()
              for name, figures in outcome.figures.get('exposures',
                                                       {}).items()}
    outcomes = [done[one.name] for one in survey.exposures]
    figures = [outcome.figures | within.get(outcome.name, {})
               for outcome in outcomes]
    judged = judge(figures, [one.camera for one in survey.exposures])
    rows = [{'exposure': _link(outcome.name, pages),
             'year': round(exposure.year, 4),
             **_figures(replace(outcome, figures=some), CATALOGUE | FIELD,
                        look_at=words)}
            for exposure, outcome, some, (words, _) in zip(
                survey.exposures, outcomes, figures, judged, strict=True)]
    far = [how_far for _, how_far in judged]
    order = sorted(range(len(rows)), key=lambda k: -far[k])
    return [rows[k] for k in order]


def _link(name, pages):
    page = pages.get(f'{name}_page')
    return name if page is None or page.error else Path(
        'pages') / f'{name}.html'


def field_row(name, members, outcome):
    """Return the row of a field."""
    return {'field': name, 'exposures': len(members),
            **_figures(outcome, _FIELD)}


def _figures(outcome, names, **more):
    return {**{name: outcome.figures.get(name, np.nan) for name in names},
            **{name.replace('_', ' '): words for name, words in more.items()},
            'trouble': outcome.error or '; '.join(outcome.notes)}


def collect_wcs(folders, target):
    """Copy the corrected WCS of all fields into one folder."""
    for folder in folders:
        for pattern in ('*_wcs.asdf', '*_wcs.fits'):
            for path in sorted(folder.glob(pattern)):
                copy = target / path.name
                if (copy.exists() and copy.stat().st_mtime_ns
                        >= path.stat().st_mtime_ns):
                    continue
                with tools.whole_file(copy) as draft:
                    shutil.copyfile(path, draft)


def write_dataset(folder, tables, name, references=None):
    """
    Write tables of stars as one Parquet dataset, divided by HEALPix pixel.

    In the HATS layout: ``dataset/Norder=5/Dir=D/Npix=N.parquet``, the column
    ``_healpix_29``, ``partition_info.csv`` and ``hats.properties``. Stars of
    several fields are merged, see `merge_stars`. One pixel is in memory at a
    time.

    Parameters
    ----------
    folder : `~pathlib.Path`
        The dataset's own folder.
    tables : dict
        By the name of a field, the file of its table, which has ``ra`` and
        ``dec``, and the pixels that it reaches, as of `pixels_of`.
    name : str
        What the dataset is called.
    references : str, optional
        The file of the objects of known motion of all fields.

    Returns
    -------
    int
        The number of rows.

    Raises
    ------
    ImportError
        If pyarrow or astropy-healpix is not installed.
    """
    import pyarrow as pa
    from pyarrow import parquet

    from photutils_mgauss.files.tables import read_table
    known = None if references is None else read_table(references)[0]
    wanted = {}
    for field, (path, pixels) in tables.items():
        for pixel in pixels if pixels is not None else _pixels_of_file(path):
            wanted.setdefault(pixel, []).append((field, path))
    counts, written = {}, set()
    for pixel, fields in sorted(wanted.items()):
        parts = _in_pixel(pixel, fields, known)
        path = (folder / 'dataset' / f'Norder={_ORDER}'
                / f'Dir={pixel // 10000 * 10000}' / f'Npix={pixel}.parquet')
        if not parts:
            continue
        whole = pa.concat_tables(parts, promote_options='default')
        whole = whole.sort_by(f'_healpix_{_INDEX_ORDER}')
        with tools.whole_file(path) as draft:
            parquet.write_table(whole, draft)
        counts[pixel] = whole.num_rows
        written.add(path)
    for path in (folder / 'dataset').rglob('Npix=*.parquet'):
        if path not in written:
            path.unlink()  # stars of an earlier run
    _describe(folder, counts, name)
    return sum(counts.values())


def _in_pixel(pixel, fields, references):
    """Return the stars of fields in a pixel, merged, for Parquet."""
    from photutils_mgauss.motions.merged import merge_stars
    names, tables = [], []
    for field, path in fields:
        table = _read(path)
        near = np.any(_pixels_around(table) == pixel, axis=0)
        if near.any():
            names.append(field)
            tables.append(table[near])
    if not tables:
        return []
    return [_arrow(table[_index(table, _ORDER) == pixel], field)
            for field, table in zip(names, merge_stars(tables, references),
                                    strict=True)
            if (_index(table, _ORDER) == pixel).any()]


def _read(path):
    from photutils_mgauss.files.tables import read_table
    table, _ = read_table(path)
    return table[np.isfinite(column_values(table, 'ra'))
                 & np.isfinite(column_values(table, 'dec'))]


def _pixels_of_file(path):
    return _pixels_in(_read(path))


def pixels_of(table):
    """Return the pixels that stars are in or near, None if unknown."""
    try:
        import astropy_healpix  # noqa: F401
    except ImportError:
        return None
    return _pixels_in(table[np.isfinite(column_values(table, 'ra'))
                            & np.isfinite(column_values(table, 'dec'))])


def _pixels_in(table):
    return np.unique(_pixels_around(table)).tolist()


def _pixels_around(table):
    """Return pixels (5, n) of stars and of places around them."""
    ra, dec = (column_values(table, name) for name in ('ra', 'dec'))
    wide = _MARGIN / np.cos(np.radians(np.clip(dec, -89.9, 89.9)))
    return np.stack([_healpix(ra + i * wide, np.clip(dec + j * _MARGIN, -90,
                                                     90), _ORDER)
                     for i, j in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))])


def _index(table, order):
    return _healpix(column_values(table, 'ra'), column_values(table, 'dec'),
                    order)


def _healpix(ra, dec, order):
    import astropy.units as u
    from astropy_healpix import lonlat_to_healpix
    return np.asarray(lonlat_to_healpix(ra * u.deg, dec * u.deg, 2**order,
                                        order='nested'))


def _arrow(table, field):
    """Return a table for Parquet, units and meanings with the columns."""
    import pyarrow as pa
    columns = {f'_healpix_{_INDEX_ORDER}': (_index(table, _INDEX_ORDER), {})}
    for name in table.colnames:
        values = np.ma.filled(np.ma.asarray(getattr(
            table[name], 'value', table[name])), _missing(table[name]))
        facts = _facts(table[name])
        if values.ndim == 1:
            columns[name] = values, facts
        elif values.ndim == 2:
            columns |= {f'{name}_{k}': (values[:, k], facts)
                        for k in range(values.shape[1])}
    columns['field'] = np.full(len(table), field), {}
    fields, arrays = [], []
    for name, (values, facts) in columns.items():
        array = pa.array(values.astype(str) if values.dtype.kind in 'OU'
                         else values)
        arrays.append(array)
        fields.append(pa.field(name, array.type, metadata=facts or None))
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields))


def _facts(column):
    """Return unit, meaning and description of a column, where known."""
    facts = {'unit': getattr(column, 'unit', None),
             'ucd': (column.info.meta or {}).get('ucd'),
             'description': column.info.description}
    return {name: str(fact) for name, fact in facts.items()
            if fact is not None and str(fact)}


def _missing(column):
    kind = np.asarray(getattr(column, 'value', column)).dtype.kind
    return {'f': np.nan, 'U': '', 'O': ''}.get(kind, 0)


def _describe(folder, counts, name):
    lines = ['Norder,Npix,num_rows',
             *(f'{_ORDER},{pixel},{n}' for pixel, n in counts.items())]
    with tools.whole_file(folder / 'partition_info.csv') as draft:
        draft.write_text('\n'.join(lines) + '\n', encoding='utf-8')
    facts = {'obs_collection': name, 'dataproduct_type': 'object',
             'hats_nrows': sum(counts.values()), 'hats_col_ra': 'ra',
             'hats_col_dec': 'dec', 'hats_order': _ORDER,
             'hats_npix_suffix': '.parquet',
             'hats_col_healpix': f'_healpix_{_INDEX_ORDER}',
             'hats_col_healpix_order': _INDEX_ORDER,
             'hats_version': 'v1.0'}
    with tools.whole_file(folder / 'hats.properties') as draft:
        draft.write_text(''.join(f'{key}={value}\n'
                                 for key, value in facts.items()),
                         encoding='utf-8')


def write_summary(folder, numbers):
    """Write the numbers of a run for other programs."""
    with tools.whole_file(folder / 'summary.json') as draft:
        draft.write_text(json.dumps(numbers, indent=1), encoding='utf-8')
