"""Seven exposures of stars and quasars: Figs. 8 to 12."""
import numpy as np
from astropy.table import QTable
from matplotlib.figure import Figure as Canvas
from scenes import calibration, catalogue, cubic, detector, match
from settings import CAMPAIGNS, PIXEL
from store import COLOURS, MARKS, Comparison, Figure, Group, binned, spread

from photutils_mgauss import (
    Epoch,
    Instrument,
    ProperMotionFitter,
    bootstrap_median,
    paper_exposures,
    simulate,
    sky_field,
)

EDGES = np.arange(18, 27)
MODELS = {'paper': 'K = 3 from the empirical PSF', 'field': 'mixture field'}
COORDINATES = {'ra': r'$\alpha^*$', 'dec': r'$\delta$'}
MOTIONS = {'pmra': r'$\mu_{\alpha*}$', 'pmdec': r'$\mu_\delta$'}
RECIPES = {'joint': {}, 'paper': {'recipe': 'paper', 'eps_t': 'corrected'}}


def sources(run):
    """Return stars and quasars on the sky; parallaxes are left out."""
    arcmin = run.settings.sky_size * PIXEL / 60
    return sky_field(*run.settings.sources, size=arcmin, separation=1.2,
                     parallaxes=False, rng=31)


def exposures():
    """Return the seven of Table 2; pointings differ by about an arcsec."""
    return paper_exposures(offset=0.7)


def measure(run):
    """Return what the seven exposures give."""
    catalogues = [run.table(f'epoch_{number}',
                            lambda number=number: _observe(run, number),
                            keep=False) for number in range(7)]
    shown = run.table('fig8_epochs', lambda: _epochs(catalogues))
    positions = run.table('fig9_10_positions', lambda: _positions(catalogues))
    motions = run.table('fig11_motions',
                        lambda: _motions(run, catalogues), keep=False)
    return {'epochs': shown, 'positions': positions,
            'sources': sources(run), 'catalogues': catalogues,
            'medians': run.table('fig11_medians',
                                 lambda: _medians(run, motions)),
            'bins': run.table('fig12_bins', lambda: _bins(run, motions))}


# Positions

def _observe(run, number):
    """Return the catalogue of one exposure with both models of the PSF."""
    exposure = exposures()[number]
    size = run.settings.sky_size
    one = detector(run, exposure.detector, size)
    scene = simulate(sources(run), exposure, psf=one.truth, rng=300 + number,
                     instrument=Instrument(shape=(size, size)))
    tables = {name: _calibrated(one, scene, psf)
              for name, psf in one.models.items()}
    return _beside_truth(scene, tables)


def _calibrated(one, scene, psf):
    """Return a catalogue whose positions are freed of the distortion."""
    table = catalogue(scene, psf)
    shift = cubic(table['x_fit'], table['y_fit'], one.size) @ calibration(
        one, psf)
    table['x_fit'] -= shift[:, 0]
    table['y_fit'] -= shift[:, 1]
    return table


def _beside_truth(scene, tables):
    """Return a row for each source that was found with all models."""
    rows = {}
    for name, table in tables.items():
        i, j = match(table, scene.truth)
        rows[name] = dict(zip(j.tolist(), i.tolist(), strict=True))
    common = sorted(set.intersection(*(set(one) for one in rows.values())))
    truth = scene.truth[common]
    out = QTable({'id': truth['id'], 'kind': truth['kind'],
                  'mag': truth['mag'].value,
                  'x': truth['x'].value, 'y': truth['y'].value})
    for name, table in tables.items():
        mine = table[[rows[name][j] for j in common]]
        for column in ('x_fit', 'x_err', 'y_fit', 'y_err'):
            out[f'{name}_{column}'] = np.asarray(mine[column], float)
    out.meta['shape'] = scene.image.shape[0]
    return out


def _epochs(catalogues):
    """Return time, band and number of sources of each exposure."""
    taken = exposures()
    return QTable({
        'time': [one.time.utc.isot for one in taken],
        'detector': [one.detector for one in taken],
        'band': [one.band.name for one in taken],
        'stars': [int(np.sum(t['kind'] == 'star')) for t in catalogues],
        'quasars': [int(np.sum(t['kind'] == 'qso')) for t in catalogues]})


def _positions(catalogues):
    """Return errors of positions by band, model, coordinate, magnitude."""
    taken = exposures()
    rows = []
    for band in 'gri':
        chosen = [(one, t) for one, t in zip(taken, catalogues, strict=True)
                  if one.band.name == band]
        for name in MODELS:
            mag = np.concatenate([t['mag'] for _, t in chosen])
            errors = np.concatenate([_on_sky(one, t, name)
                                     for one, t in chosen], axis=1)
            rows += _bin_positions(band, name, mag, errors)
    return QTable(rows=rows, names=(
        'band', 'model', 'coordinate', 'mag', 'number', 'scatter', 'stated'),
        units=(None, None, None, 'mag', None, 'mas', 'mas'))


def _on_sky(exposure, table, name):
    """Return errors in RA and Dec and their stated values, (4, n) [mas]."""
    matrix = _orientation(exposure)
    away = np.stack([table[f'{name}_{c}_fit'] - table[c] for c in 'xy'])
    stated = np.stack([table[f'{name}_{c}_err'] for c in 'xy'])
    scale = 1000 * PIXEL
    return scale * np.concatenate([matrix @ away,
                                   np.sqrt(matrix**2 @ stated**2)])


def _orientation(exposure):
    """Return the rotation (2, 2) from x, y to east and north."""
    c, s = np.cos(np.radians(exposure.rotation)), np.sin(
        np.radians(exposure.rotation))
    return np.array([[-c, s], [s, c]])


def _bin_positions(band, name, mag, errors):
    rows = []
    for k, coordinate in enumerate(COORDINATES):
        for low, here in binned(mag, EDGES):
            if here.sum() >= 5:
                rows.append((band, name, coordinate, low + 0.5,
                             int(here.sum()), spread(errors[k, here]),
                             np.median(errors[2 + k, here])))
    return rows


# Motions

def _motions(run, catalogues):
    """Return motions of sources by recipe and number of observations."""
    truth = sources(run)
    quasars = np.asarray(truth['id'][truth['kind'] == 'qso'])
    chosen = np.random.default_rng(33).choice(
        quasars, run.settings.references, replace=False)
    rows = []
    for recipe, options in RECIPES.items():
        for count, which in CAMPAIGNS.items():
            fitter = ProperMotionFitter(references=chosen, match_by='id',
                                        **options)
            solution = fitter.fit([_epoch(catalogues[i], i) for i in which])
            common = _systematic(run, recipe, solution)
            rows += _motion_rows(recipe, count, solution, truth, chosen,
                                 common)
    return QTable(rows=rows, names=(
        'recipe', 'count', 'id', 'kind', 'mag', 'pmra', 'pmra_error',
        'pmra_true', 'pmdec', 'pmdec_error', 'pmdec_true', 'pmra_frame',
        'pmdec_frame'))


def _epoch(table, number):
    """Return what the fitter needs of one exposure."""
    taken = exposures()[number]
    columns = QTable({'id': table['id']})
    for column in ('x_fit', 'x_err', 'y_fit', 'y_err'):
        columns[column] = table[f'paper_{column}']
    return Epoch(columns, taken.wcs(_shape_of(table), PIXEL), taken.time)


def _shape_of(table):
    return (table.meta['shape'], table.meta['shape'])


def _systematic(run, recipe, solution):
    """Return the error all motions share, by resampling the references."""
    if recipe == 'paper':
        return np.full(2, np.nan)
    draws = solution.bootstrap(run.settings.resamplings, rng=35)
    return draws.motion.std(axis=0)


def _motion_rows(recipe, count, solution, truth, references, common):
    """Return a row for each source seen every time, references left out."""
    by_id = {int(row): i for i, row in enumerate(truth['id'])}
    rows = []
    for star in solution.stars:
        if (star['n_good_obs'] < count or star['id'] in references
                or not np.isfinite(star['pmra_error'].value)):
            continue
        true = truth[by_id[int(star['id'])]]
        rows.append((recipe, count, int(star['id']), str(true['kind']),
                     true['mag_g'].value, star['pmra'].value,
                     star['pmra_error'].value, true['pmra'].value,
                     star['pmdec'].value, star['pmdec_error'].value,
                     true['pmdec'].value, *common))
    return rows


def _medians(run, motions):
    """Return median errors by recipe and number of observations."""
    rows = []
    for recipe in RECIPES:
        for count in CAMPAIGNS:
            part = motions[(motions['recipe'] == recipe)
                           & (motions['count'] == count)]
            for name in MOTIONS:
                stated = np.asarray(part[f'{name}_error'])
                away = np.asarray(part[name] - part[f'{name}_true'])
                band = bootstrap_median(
                    stated, n_resamples=run.settings.resamplings, rng=36)
                rows.append((recipe, count, name, len(part),
                             np.median(stated), band.std(), spread(away),
                             spread(away / stated)))
    return QTable(rows=rows, names=(
        'recipe', 'count', 'motion', 'number', 'median_error',
        'error_of_median', 'scatter', 'pull'),
        units=(None, None, None, None, 'mas/yr', 'mas/yr', 'mas/yr', None))


def _bins(run, motions):
    """Return errors of quasars by number of observations and magnitude."""
    part = motions[(motions['recipe'] == 'joint')
                   & (motions['kind'] == 'qso')]
    rows = []
    for count in CAMPAIGNS:
        some = part[part['count'] == count]
        for low, here in binned(some['mag'], EDGES):
            if here.sum() >= 8:
                rows += [_bin(run, some[here], count, low, name)
                         for name in MOTIONS]
    return QTable(rows=rows, names=(
        'count', 'mag', 'motion', 'number', 'total', 'total_low',
        'total_high', 'scatter', 'systematic', 'systematic_error', 'frame'))


def _bin(run, quasars, count, low, name):
    """Return the row of one bin; quasars do not move."""
    n = run.settings.resamplings
    stated = np.asarray(quasars[f'{name}_error'])
    away = np.asarray(quasars[name] - quasars[f'{name}_true'])
    draws = bootstrap_median(stated, n_resamples=n, rng=37)
    offset = bootstrap_median(away, n_resamples=n, rng=38)
    return (count, low + 0.5, name, len(quasars), np.median(stated),
            *np.percentile(draws, [16, 84]), spread(away), np.median(away),
            offset.std(), float(quasars[f'{name}_frame'][0]))


# Figures

def draw_epochs(tables):
    """Draw Fig. 8: where the sources are, and how bright."""
    canvas = Canvas(figsize=(10, 4.2), layout='constrained')
    left, right = canvas.subplots(1, 2)
    for number, (table, taken) in enumerate(zip(
            tables['catalogues'], exposures(), strict=True)):
        x, y = np.asarray(table['x']), np.asarray(table['y'])
        sky = taken.wcs(_shape_of(table), PIXEL)(x, y)
        # Rings in each other: the exposures show the same sources.
        left.plot(*sky, 'o', mfc='none', color=COLOURS[number],
                  markersize=1 + 0.8 * number, markeredgewidth=0.5,
                  label=f'{taken.time.utc.isot[:10]}, {taken.band.name}')
    left.set(xlabel='right ascension [deg]', ylabel='declination [deg]')
    left.invert_xaxis()
    left.ticklabel_format(useOffset=False)
    left.tick_params(axis='x', labelrotation=30)
    left.legend(fontsize=6, loc='upper right', framealpha=0.9)
    everything = tables['sources']
    for kind, colour, line in (('star', COLOURS[0], '-'),
                               ('qso', COLOURS[4], '--')):
        part = everything[everything['kind'] == kind]
        right.hist(part['mag_g'].value, np.arange(18, 26.1, 0.5),
                   histtype='step', color=colour, linestyle=line,
                   label=f'{len(part)} {kind}s', linewidth=1.8)
    right.set(xlabel='g [mag]', ylabel='number')
    right.legend()
    return canvas


def compare_epochs(tables):
    """Compare the numbers of sources."""
    kinds = tables['sources']['kind']
    return [Comparison('stars and quasars', '614 and 590',
                       f'{np.sum(kinds == "star")} and '
                       f'{np.sum(kinds == "qso")}')]


def draw_positions(coordinate, tables):
    """Draw Fig. 9 or 10: errors of positions for each band."""
    table = tables['positions']
    canvas = Canvas(figsize=(10, 4.2), layout='constrained')
    for ax, model in zip(canvas.subplots(1, 2, sharey=True), MODELS,
                         strict=True):
        for k, band in enumerate('gri'):
            part = table[(table['band'] == band) & (table['model'] == model)
                         & (table['coordinate'] == coordinate)]
            ax.plot(part['mag'].value, part['scatter'].value,
                    f'{MARKS[k]}-', color=COLOURS[k],
                    label=f'{band}, scatter about the truth')
            ax.plot(part['mag'].value, part['stated'].value, ':',
                    color=COLOURS[k], label=f'{band}, median stated error')
        ax.axhline(0.86, color='0.5', linewidth=0.8)
        ax.annotate("the paper's best, 0.86 mas", (18.2, 0.9), fontsize=8)
        ax.set(yscale='log', xlabel='magnitude [mag]', title=MODELS[model],
               ylabel=f'error in {COORDINATES[coordinate]} [mas]')
        ax.legend(fontsize=7)
    return canvas


def compare_positions(coordinate, tables):
    """Compare the smallest error."""
    table = tables['positions']
    lines = []
    for model, words in MODELS.items():
        part = table[(table['model'] == model)
                     & (table['coordinate'] == coordinate)]
        best = part[np.argmin(part['scatter'])]
        lines.append(Comparison.below(
            f'smallest error, {words} ({best["band"]}, '
            f'{best["mag"].value:.1f} mag)', 0.86, best['scatter'].value,
            unit='mas', why='the PSF model limits bright stars'))
    return lines


def draw_medians(tables):
    """Draw Fig. 11: errors of motions by number of observations."""
    table = tables['medians']
    canvas = Canvas(figsize=(10, 4.2), layout='constrained')
    for ax, recipe in zip(canvas.subplots(1, 2, sharey=True), RECIPES,
                          strict=True):
        for k, (name, label) in enumerate(MOTIONS.items()):
            part = table[(table['recipe'] == recipe)
                         & (table['motion'] == name)]
            colour = COLOURS[(4, 6)[k]]
            ax.errorbar(part['count'], part['median_error'].value,
                        part['error_of_median'].value, fmt=f'{MARKS[k]}-',
                        color=colour, label=f'{label}, median stated error')
            ax.plot(part['count'], part['scatter'].value, f'{MARKS[k]}:',
                    color=colour, mfc='none',
                    label=f'{label}, scatter about the truth')
        ax.plot([5, 7], [1.0, 0.8], '*', color=COLOURS[0], markersize=11,
                label='printed: 1.0 and 0.8')
        ax.set(xlabel='number of observations',
               ylabel='error of a motion [mas / yr]',
               title={'joint': 'joint solution',
                      'paper': 'recipe of the paper'}[recipe])
        ax.legend(fontsize=7)
    ax.set_ylim(0, 1.1 * max(1, *table['scatter'].value))
    return canvas


def compare_medians(tables):
    """Compare the medians for five and seven observations."""
    table = tables['medians']
    lines = []
    for recipe in RECIPES:
        for count, printed in ((5, 1.0), (7, 0.8)):
            part = table[(table['recipe'] == recipe)
                         & (table['count'] == count)]
            lines += [_median_line(recipe, count, printed, row)
                      for row in part]
    return lines


def _median_line(recipe, count, printed, row):
    return Comparison.below(
        f'{recipe}: median error of {row["motion"]}, {count} observations '
        f'(scatter about the truth {row["scatter"].value:.2f}, pull '
        f'{row["pull"]:.2f})', printed, row['median_error'].value,
        unit='mas/yr', why=_WHY_MOTION)


_WHY_MOTION = ('the median is over all sources down to the detection limit, '
               'whose magnitudes the paper shows in a figure only')


def draw_bins(tables):
    """Draw Fig. 12: total and systematic errors of quasars."""
    table = tables['bins']
    canvas = Canvas(figsize=(10, 7.5), layout='constrained')
    axes = canvas.subplots(2, 2, sharex=True, sharey='row')
    for column, (name, label) in enumerate(MOTIONS.items()):
        for k, count in enumerate(CAMPAIGNS):
            part = table[(table['count'] == count)
                         & (table['motion'] == name)]
            _draw_bin(axes[:, column], part, k, count)
        axes[0, column].set(yscale='log' if len(table) else 'linear',
                            title=label,
                            ylabel='total error [mas / yr]')
        axes[1, column].axhline(0, color='0.5', linewidth=0.8)
        axes[1, column].set(xlabel='g [mag]',
                            ylabel='systematic error [mas / yr]')
    axes[0, 0].legend(fontsize=7, title='observations')
    return canvas


def _draw_bin(axes, part, k, count):
    style = {'color': COLOURS[k], 'label': f'{count}'}
    axes[0].plot(part['mag'], part['total'], f'{MARKS[k]}-', **style)
    axes[0].fill_between(part['mag'], part['total_low'], part['total_high'],
                         color=COLOURS[k], alpha=0.25, linewidth=0)
    axes[1].errorbar(part['mag'] + 0.08 * (k - 2.5), part['systematic'],
                     part['systematic_error'], fmt=f'{MARKS[k]}-', **style)


def compare_bins(tables):
    """Say how large errors of quasars and of the frame are."""
    table = tables['bins']
    lines = []
    for name in MOTIONS:
        part = table[(table['motion'] == name) & (table['count'] == 7)]
        best = part[np.argmin(part['total'])]
        lines.append(Comparison(
            f'{name}, 7 observations, {best["mag"]:.1f} mag: total error, '
            'error of the frame in it', 'in the figure only',
            f'{best["total"]:.2f}, {best["frame"]:.2f} mas/yr'))
    return lines


def _position_figure(key, coordinate, words):
    return Figure(
        key, f'Fig. {key[3:]}: errors of positions in {words}',
        'Positions of both kinds of sources, detected and measured on images '
        'of the seven exposures, after a cubic distortion for each detector, '
        'calibrated with the bright stars of its sparse exposure. The '
        'scatter is 1.4826 times the median of absolute errors.',
        lambda tables: draw_positions(coordinate, tables),
        lambda tables: compare_positions(coordinate, tables))


GROUPS = (Group('sky', measure, (
    Figure('fig8', 'Fig. 8 and Table 2: the exposures',
           'Stars and quasars of ``sky_field`` at the dates of Table 2 '
           '(``paper_exposures``). Each exposure has an offset, a rotation, '
           'a scale and a distortion of its own. The left panel shows what '
           'was detected.', draw_epochs, compare_epochs),
    _position_figure('fig9', 'ra', 'right ascension'),
    _position_figure('fig10', 'dec', 'declination'),
    Figure('fig11', 'Fig. 11: errors of motions by number of observations',
           'Stars, and quasars that are not references, seen in every '
           'exposure; measured with three Gaussians from the empirical PSF, '
           'as in the paper. On the left the joint solution of '
           '``ProperMotionFitter``, with affine maps; on the right its '
           "``recipe='paper'`` with the standard error of the mean "
           'displacement for Eq. 14.', draw_medians, compare_medians),
    Figure('fig12', 'Fig. 12: errors of the motions of quasars',
           'Joint solution. Top: median stated error, which contains that of '
           'the frame, with the 1-sigma band of the bootstrap. Bottom: the '
           'median motion, whose true value is zero, and its bootstrap '
           'error.', draw_bins, compare_bins))),)
