"""Size and ellipticity over the detectors: Figs. 4 to 7."""
import numpy as np
from astropy.table import QTable, vstack
from peers import AbsentError, absent
from scenes import detector, forget
from settings import BANDS, TABLE_2_DETECTORS, place_of
from store import Comparison, Figure, Group
from styles import canvas_of

from photutils_mgauss import assess_psf

ERRORS = {'size_error': r'$\delta(R^2)/R^2$',
          'ellipticity_error': r'$\delta\epsilon$'}

# What is compared with what, and in which places.
PAIRS = {
    'empirical': 'empirical PSF against the true PSF',
    'psfex': 'PSFEx against the true PSF',
    'chain': 'three Gaussians against the empirical PSF, at the nodes',
    'blend': 'blend of four nodes against the empirical PSF, mid-cell',
    'field': 'mixture field, K = 5, against the true PSF',
    'chain_truth': 'three Gaussians against the true PSF, at the nodes',
}


def measure(run):
    """Return the errors at the places of all detectors, and a summary."""
    maps = run.table('fig4_to_7_maps', lambda: _joined(
        [run.table(f'maps_{number:02d}',
                   lambda number=number: _measure(run, number),
                   keep=False) for number in run.settings.detectors]))
    if np.isnan(maps['psfex_size_error']).all():
        run.skipped.setdefault('PSFEx', str(absent('PSFEx')))
    return {'maps': maps, 'summary': run.table(
        'fig4_to_7_summary', lambda: _summary(maps))}


def _joined(parts):
    for part in parts:
        part.meta.clear()
    return vstack(parts)


def _measure(run, number):
    """Return a row for each place of a detector."""
    one = detector(run, number)
    grid = run.settings.grid
    columns = {f'{name}_{error}': np.full(grid**2, np.nan)
               for name in PAIRS for error in ERRORS}
    for name, (model, truth, mid_cell) in _pairs(run, one).items():
        found = assess_psf(model, truth, (grid, grid), shape=one.shape,
                           oversampling=2, mid_cell=mid_cell)
        for error in ERRORS:
            columns[f'{name}_{error}'][:len(found.table)] = (
                found.table[error])
    forget(one)
    x, y = (a.ravel() for a in np.meshgrid(*[np.arange(grid)] * 2))
    return QTable({'detector': np.full(grid**2, number),
                   'band': np.full(grid**2, one.band), 'column': x, 'row': y,
                   **columns})


def _pairs(run, one):
    """Return (model, truth, whether mid-cell) by name."""
    pairs = {'empirical': (one.empirical.image_at, one.true_image, False),
             'chain': (one.chain, one.empirical.image_at, False),
             'blend': (one.chain, one.empirical.image_at, True),
             'field': (one.field, one.true_image, False),
             'chain_truth': (one.chain, one.true_image, False)}
    # PSFEx takes longer than everything else together.
    if one.number in TABLE_2_DETECTORS:
        try:
            model, _ = one.psfex
        except AbsentError as error:
            run.skipped[f'PSFEx on detector {one.number}'] = str(error)
        else:
            pairs['psfex'] = (model.image_at, one.true_image, False)
    return pairs


def _summary(maps):
    """Return median, scatter and mean of each error on each detector."""
    rows = []
    for number in np.unique(maps['detector']):
        part = maps[maps['detector'] == number]
        for name in PAIRS:
            for error in ERRORS:
                values = np.asarray(part[f'{name}_{error}'])
                if np.isfinite(values).any():
                    rows.append((int(number), part['band'][0], name, error,
                                 np.nanmedian(values), np.nanmean(values),
                                 np.nanstd(values)))
    return QTable(rows=rows, names=('detector', 'band', 'compared', 'error',
                                    'median', 'mean', 'standard_deviation'))


def draw(name, error, tables):
    """Draw one map for each detector, with the same colours."""
    maps = tables['maps']
    numbers = np.unique(maps['detector'])
    canvas = canvas_of(6.6)
    # The columns of the focal plane that hold imaging detectors.
    axes = canvas.subplots(5, 4)
    limit = np.nanpercentile(np.abs(maps[f'{name}_{error}']), 98)
    for ax in axes.flat:
        ax.set_axis_off()
    for number in set(BANDS) - set(numbers.tolist()):
        row, column = place_of(number)
        _absent_panel(axes[row, column - 1], number)
    for number in numbers:
        part = maps[maps['detector'] == number]
        row, column = place_of(int(number))
        shown = _panel(axes[row, column - 1], part, f'{name}_{error}', limit)
    bar = canvas.colorbar(shown, ax=axes, label=ERRORS[error], shrink=0.7,
                          extend='both')
    bar.ax.tick_params(direction='out')
    canvas.supxlabel('x on the detector [pix]', fontsize=8)
    canvas.supylabel('y on the detector [pix]', fontsize=8)
    return canvas


def _absent_panel(ax, number):
    """Draw the frame of a detector that a small run leaves out."""
    ax.set_axis_on()
    ax.set(xticks=[], yticks=[], aspect='equal')
    ax.text(0.5, 0.5, f'#{number:02d} {BANDS[number]}\nnot measured',
            ha='center', va='center', fontsize=6, color='0.5',
            transform=ax.transAxes)
    for spine in ax.spines.values():
        spine.set_color('0.7')


def _panel(ax, part, name, limit):
    """Draw the map of one detector."""
    values = np.asarray(part[name])
    side = int(np.sqrt(len(values)))
    ax.set_axis_on()
    shown = ax.imshow(values.reshape(side, side), origin='lower',
                      cmap='RdBu_r', vmin=-limit, vmax=limit,
                      extent=(0, 9216, 0, 9216))
    ax.set(xticks=[0, 9216], yticks=[0, 9216])
    ax.tick_params(labelsize=6, direction='out', top=False, right=False)
    ax.set_title(f'#{part["detector"][0]:02d} {part["band"][0]}: '
                 f'{np.nanmedian(values):+.4f} $\\pm$ '
                 f'{np.nanstd(values):.4f}', fontsize=6.5)
    return shown


def compare(names, error, tables):
    """Return a line for each comparison, over all detectors."""
    found = {name: np.asarray(tables['maps'][f'{name}_{error}'])
             for name in names}
    found = {name: values for name, values in found.items()
             if np.isfinite(values).any()}
    return [Comparison(
        f'{PAIRS[name]}: median +- standard deviation',
        'in the titles of the figure only',
        f'{np.nanmedian(values):+.4f} +- {np.nanstd(values):.4f}',
        _judgement(name, values, found.get('psfex')))
        for name, values in found.items()]


def _judgement(name, values, psfex):
    """Say how a PSF made of the same image compares with that of PSFEx."""
    if psfex is None or name == 'psfex':
        return ''
    both = np.isfinite(psfex)
    ratio = np.nanstd(values[both]) / np.nanstd(psfex[both])
    word = 'better' if ratio < 1 else 'worse'
    return (f'{word}: {ratio:.2f} times the scatter of PSFEx on the same '
            'detectors')


def _figure(key, error, name, others, text):
    what = {'size_error': 'dR2/R2', 'ellipticity_error': 'd-epsilon'}[error]
    title = f'Fig. {key[3:]}: {what} of {text}'
    return Figure(
        key, title,
        'The sign is that of the paper, truth minus model; titles give the '
        'median and the standard deviation over the places of a detector. '
        'The colours of all panels are the same, their places are those of '
        'the detectors on the focal plane, and axes are pixels of a whole '
        'detector. PSFEx is run on the '
        'detectors of Table 2, where it chooses its own stars, as many as '
        'it likes.',
        lambda tables: draw(name, error, tables),
        lambda tables: compare((name, *others), error, tables))


_OVER_TRUTH = ('psfex', 'field')
_OVER_EMPIRICAL = ('blend', 'chain_truth')
GROUPS = (Group('maps', measure, (
    _figure('fig4', 'size_error', 'empirical', _OVER_TRUTH,
            'the empirical PSF'),
    _figure('fig5', 'ellipticity_error', 'empirical', _OVER_TRUTH,
            'the empirical PSF'),
    _figure('fig6', 'size_error', 'chain', _OVER_EMPIRICAL,
            'three Gaussians'),
    _figure('fig7', 'ellipticity_error', 'chain', _OVER_EMPIRICAL,
            'three Gaussians')),
    ('fig4_to_7_maps', 'fig4_to_7_summary')),)
