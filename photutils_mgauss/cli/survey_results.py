"""What a survey leaves for people: an index page, and one dataset."""
import json
from html import escape
from pathlib import Path

import numpy as np

from photutils_mgauss.cli import tools
from photutils_mgauss.utils.star_columns import column_values

# Order of the HEALPix pixels that divide the dataset, and of its index.
_ORDER, _INDEX_ORDER = 5, 29

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
th:first-child, td:first-child, td:last-child {{ text-align: left; }}
th {{ cursor: pointer; }}
.failed td:first-child {{ border-left: 6px solid #d55e00; padding-left: 6px; }}
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
    rows = sorted(rows, key=lambda row: row['trouble'] == '')
    head = ''.join(f'<th scope="col">{escape(name)}</th>' for name in rows[0])
    body = ''.join(
        f'<tr{" class=failed" if row["trouble"] else ""}>' + ''.join(
            f'<td>{_cell(value)}</td>' for value in row.values()) + '</tr>'
        for row in rows)
    return (f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>'
            f'{body}</tbody></table></div>')


def _cell(value):
    if isinstance(value, Path):
        return f'<a href="{escape(value.as_posix())}">{escape(value.stem)}</a>'
    if isinstance(value, float):
        return f'{value:.4g}' if np.isfinite(value) else ''
    return escape(str(value))


def exposure_row(exposure, outcome, catalogue, psf):
    """Return the row of an exposure, its figures of merit included."""
    row = {'exposure': exposure.name, 'year': round(exposure.year, 4),
           'FWHM [pix]': np.nan, 'ellipticity': np.nan, 'stars': 0,
           'without flags': np.nan, 'reduced chi2': np.nan,
           'x_err of bright stars [pix]': np.nan,
           'trouble': outcome.error or '; '.join(outcome.notes)}
    if outcome.error:
        return row
    from photutils_mgauss.cli.psf_files import read_psf
    from photutils_mgauss.files.tables import read_table
    from photutils_mgauss.psf.shapes import adaptive_moments
    table, _ = read_table(catalogue)
    good = np.asarray(table['flags']) == 0
    row |= {'stars': len(table), 'without flags': float(good.mean())}
    if 'reduced_chi2' in table.colnames and good.any():
        row['reduced chi2'] = float(np.nanmedian(
            column_values(table, 'reduced_chi2')[good]))
    if good.any():
        flux = column_values(table, 'flux_fit')[good]
        bright = flux >= np.nanpercentile(flux, 90)
        row['x_err of bright stars [pix]'] = float(np.nanmedian(
            column_values(table, 'x_err')[good][bright]))
    if psf is not None and psf.exists():
        shapes = adaptive_moments(read_psf(psf).mixtures)
        row |= {'FWHM [pix]': float(np.nanmedian(shapes.fwhm)),
                'ellipticity': float(np.nanmedian(shapes.ellipticity))}
    return row


def field_row(name, members, outcome, motions):
    """Return the row of a field."""
    row = {'field': name, 'exposures': len(members), 'stars': 0,
           'with motions': 0, 'median pmra_error [mas / yr]': np.nan,
           'trouble': outcome.error or '; '.join(outcome.notes)}
    if outcome.error:
        return row
    from photutils_mgauss.files.tables import read_table
    table, _ = read_table(motions)
    error = column_values(table, 'pmra_error')
    solved = np.isfinite(error)
    row |= {'stars': len(table), 'with motions': int(solved.sum())}
    if solved.any():
        row['median pmra_error [mas / yr]'] = float(np.median(error[solved]))
    return row


def write_dataset(folder, tables, name):
    """
    Write tables of stars as one Parquet dataset, divided by HEALPix pixel.

    In the HATS layout: ``dataset/Norder=5/Dir=D/Npix=N.parquet``, the column
    ``_healpix_29``, ``partition_info.csv`` and ``hats.properties``.

    Parameters
    ----------
    folder : `~pathlib.Path`
        The dataset's own folder.
    tables : iterable of (str, `~astropy.table.QTable`)
        Tables with ``ra`` and ``dec``, by the name of their field.
    name : str
        What the dataset is called.

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
    pieces = {}
    for field, table in tables:
        for pixel, rows in _by_pixel(table):
            pieces.setdefault(pixel, []).append(_arrow(table[rows], field))
    counts = {}
    for pixel, parts in sorted(pieces.items()):
        whole = pa.concat_tables(parts, promote_options='default')
        whole = whole.sort_by(f'_healpix_{_INDEX_ORDER}')
        path = (folder / 'dataset' / f'Norder={_ORDER}'
                / f'Dir={pixel // 10000 * 10000}' / f'Npix={pixel}.parquet')
        with tools.whole_file(path) as draft:
            parquet.write_table(whole, draft)
        counts[pixel] = whole.num_rows
    _describe(folder, counts, name)
    return sum(counts.values())


def _index(table, order):
    import astropy.units as u
    from astropy_healpix import lonlat_to_healpix
    return np.asarray(lonlat_to_healpix(
        column_values(table, 'ra') * u.deg, column_values(table, 'dec')
        * u.deg, 2**order, order='nested'))


def _by_pixel(table):
    """Return (pixel, rows) of the stars that have a place."""
    placed = np.flatnonzero(np.isfinite(column_values(table, 'ra'))
                            & np.isfinite(column_values(table, 'dec')))
    pixel = _index(table[placed], _ORDER)
    return [(int(one), placed[pixel == one]) for one in np.unique(pixel)]


def _arrow(table, field):
    """Return a table for Parquet, units in the metadata of columns."""
    import pyarrow as pa
    columns = {f'_healpix_{_INDEX_ORDER}': (_index(table, _INDEX_ORDER), '')}
    for name in table.colnames:
        values = np.ma.filled(np.ma.asarray(getattr(
            table[name], 'value', table[name])), _missing(table[name]))
        unit = str(getattr(table[name], 'unit', '') or '')
        if values.ndim == 1:
            columns[name] = values, unit
        elif values.ndim == 2:
            columns |= {f'{name}_{k}': (values[:, k], unit)
                        for k in range(values.shape[1])}
    columns['field'] = np.full(len(table), field), ''
    fields, arrays = [], []
    for name, (values, unit) in columns.items():
        array = pa.array(values.astype(str) if values.dtype.kind in 'OU'
                         else values)
        arrays.append(array)
        fields.append(pa.field(name, array.type,
                               metadata={'unit': unit} if unit else None))
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields))


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
