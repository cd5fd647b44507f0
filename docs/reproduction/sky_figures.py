"""Seven exposures of stars and quasars: Figs. 8 to 12."""
from dataclasses import replace

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable, Table
from scenes import catalogue, detector, through_files
from settings import CAMPAIGNS, PIXEL, effects
from store import Comparison, Figure, Group, binned, spread
from styles import COLOURS, MARKS, canvas_colours, canvas_of

from photutils_mgauss import (
    Epoch,
    Exposure,
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

# The ways from positions to motions. Those of the paper start from frames
# that the joint solution has corrected: their own maps are shifts.
RECIPES = {
    'joint': 'joint solution',
    'paper, as printed': 'Eqs. 11-15, as printed',
    'paper, corrected': 'Eqs. 11-15, Eq. 14 corrected',
}
# Errors of what a catalogue says of the reference quasars: of motions and
# parallaxes [mas/yr and mas], and of positions [mas].
REFERENCE_ERROR, PLACE_ERROR = 0.1, 0.5


def sources(run):
    """Return stars and quasars on the sky, with motions and parallaxes."""
    arcmin = run.settings.sky_size * PIXEL / 60
    return sky_field(*run.settings.sources, size=arcmin, separation=1.2,
                     rng=31 + 1000 * run.seed)


def exposures(run):
    """Return the seven of Table 2, with all that displaces stars."""
    return paper_exposures(offset=0.7, aberration=True,
                           rng=2 + 1000 * run.seed)


def measure(run):
    """Return what the seven exposures give."""
    catalogues = {(number, name): run.table(
        f'epoch_{number}_{name}',
        lambda number=number, name=name: _observe(run, number, name),
        keep=False) for number in range(7) for name in MODELS}
    found = run.table('fig8_found', lambda: _found(run, catalogues),
                      keep=False)
    positions = run.table('fig9_10_positions',
                          lambda: _positions(run, catalogues))
    motions = run.table('fig11_motions',
                        lambda: _motions(run, catalogues), keep=False)
    return {'found': found, 'positions': positions, 'run': run,
            'epochs': run.table('fig8_epochs',
                                lambda: _epochs(run, catalogues)),
            'medians': run.table('fig11_medians',
                                 lambda: _medians(run, motions)),
            'by_magnitude': run.table('fig11_by_magnitude',
                                      lambda: _by_magnitude(motions)),
            'bins': run.table('fig12_bins', lambda: _bins(run, motions))}


# Positions

_scenes = {}


def _scene(run, number):
    """Return one exposure of the field."""
    key = run.fingerprint, run.seed, number
    if key not in _scenes:
        _scenes.clear()
        exposure, size = exposures(run)[number], run.settings.sky_size
        one = detector(run, exposure.detector, size)
        _scenes[key] = through_files(simulate(
            sources(run), exposure, psf=one.light, effects=effects(),
            rng=300 + number + 1000 * run.seed,
            instrument=Instrument(shape=(size, size))))
    return _scenes[key]


def _observe(run, number, name):
    """Return the catalogue of one exposure, from its pixels alone."""
    one = detector(run, exposures(run)[number].detector,
                   run.settings.sky_size)
    table = catalogue(_scene(run, number), one.models[name])
    out = QTable({column: np.asarray(table[column], float) for column in
                  ('x_fit', 'x_err', 'y_fit', 'y_err', 'flux_fit')})
    # Numbers of this exposure only: who is who is found on the sky.
    out['id'] = [f'{number}-{row}' for row in range(len(out))]
    return out


def _nominal(run, number):
    """Return the exposure as the header has it: TAN, where it should be."""
    taken = exposures(run)[number]
    return Exposure(taken.time, taken.band, detector=taken.detector)


def _epoch(run, table, number):
    """Return what the fitter is given of one exposure."""
    taken, shape = _nominal(run, number), (run.settings.sky_size,) * 2
    return Epoch(Table({name: table[name] for name in table.colnames
                        if name != 'id'}),
                 taken.wcs(shape, PIXEL), taken.time)


def references(run):
    """Return the quasars that tie the epochs, with errors of everything."""
    truth, rng = sources(run), np.random.default_rng(33 + 1000 * run.seed)
    quasars = np.flatnonzero(truth['kind'] == 'qso')
    chosen = rng.choice(quasars, run.settings.references, replace=False)
    table = QTable({'id': truth['id'][chosen]})
    places = SkyCoord(truth['ra'][chosen], truth['dec'][chosen])
    moved = places.spherical_offsets_by(*(
        PLACE_ERROR * rng.standard_normal((2, len(chosen))) * u.mas))
    table['ra'], table['dec'] = moved.ra, moved.dec
    for name in ('ra_error', 'dec_error'):
        table[name] = np.full(len(chosen), PLACE_ERROR) * u.mas
    for name, unit in (('pmra', u.mas / u.yr), ('pmdec', u.mas / u.yr),
                       ('parallax', u.mas)):
        noise = REFERENCE_ERROR * rng.standard_normal(len(chosen))
        table[name] = noise * unit
        table[f'{name}_error'] = np.full(len(chosen), REFERENCE_ERROR) * unit
    table['class'] = 'star'
    table['ref_epoch'] = truth['ref_epoch'][chosen].to_value(u.yr)
    return table


def _solve(run, catalogues, name, which):
    """Return the joint solution of some of the exposures."""
    fitter = ProperMotionFitter(
        transform='poly-3', parallax='prior', match_by='pattern',
        references=references(run))
    return fitter.fit([_epoch(run, catalogues[i, name], i) for i in which])


def _true_places(run, number):
    """Return where sources are on the sky at an epoch, aberration apart."""
    ideal = replace(_nominal(run, number), aberration=False)
    shape, truth = (run.settings.sky_size,) * 2, sources(run)
    x, y = ideal.pixels(truth, shape, PIXEL)
    ra, dec = ideal.wcs(shape, PIXEL)(x, y, with_bounding_box=False)
    return SkyCoord(ra, dec, unit='deg')


def _same(found, true, limit=0.25):
    """Return rows of two lists of places that are one source [arcsec]."""
    nearest, distance, _ = found.match_to_catalog_sky(true)
    back, _, _ = true.match_to_catalog_sky(found)
    good = ((distance.arcsec < limit)
            & (back[nearest] == np.arange(len(found))))
    return np.flatnonzero(good), nearest[good]


def _corrected(run, solution, table, number, at):
    """Return RA and Dec errors (2, n) [mas], stated ones, and rows."""
    wcs = solution.epochs[at].wcs
    x, y = (np.asarray(table[f'{c}_fit'], float) for c in 'xy')
    places = SkyCoord(*wcs(x, y, with_bounding_box=False), unit='deg')
    true = _true_places(run, number)
    i, j = _same(places, true)
    east, north = true[j].spherical_offsets_to(places[i])
    stated = 1000 * PIXEL * np.stack([table['x_err'][i], table['y_err'][i]])
    return (np.stack([east.to_value(u.mas), north.to_value(u.mas)]), stated,
            i, j)


def _positions(run, catalogues):
    """Return errors of positions by band, model, coordinate, magnitude."""
    taken, truth, rows = exposures(run), sources(run), []
    for name in MODELS:
        solution = _solve(run, catalogues, name, range(7))
        parts = {band: [] for band in 'gri'}
        for number in range(7):
            away, stated, _, j = _corrected(
                run, solution, catalogues[number, name], number, number)
            band = taken[number].band.name
            parts[band].append(np.vstack([
                truth[f'mag_{band}'].value[j], away, stated]))
        for band, found in parts.items():
            both = np.concatenate(found, axis=1)
            rows += _bin_positions(band, name, both[0], both[1:])
    return QTable(rows=rows, names=(
        'band', 'model', 'coordinate', 'mag', 'number', 'scatter', 'stated'),
        units=(None, None, None, 'mag', None, 'mas', 'mas'))


def _found(run, catalogues):
    """Return how often each source was found, and where it is."""
    truth = sources(run)
    count = np.zeros(len(truth), int)
    solution = _solve(run, catalogues, 'paper', range(7))
    for number in range(7):
        count[_corrected(run, solution, catalogues[number, 'paper'], number,
                         number)[3]] += 1
    return QTable({'ra': truth['ra'], 'dec': truth['dec'],
                   'kind': truth['kind'], 'mag': truth['mag_g'].value,
                   'count': count})


def _epochs(run, catalogues):
    """Return time, band and number of sources of each exposure."""
    taken = exposures(run)
    return QTable({
        'time': [one.time.utc.isot for one in taken],
        'detector': [one.detector for one in taken],
        'band': [one.band.name for one in taken],
        'found': [len(catalogues[n, 'paper']) for n in range(7)]})


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
    truth, chosen = sources(run), references(run)
    places = SkyCoord(truth['ra'], truth['dec'])
    rows = []
    for count, which in CAMPAIGNS.items():
        joint = _solve(run, catalogues, 'paper', which)
        common = joint.bootstrap(run.settings.resamplings,
                                 rng=35).motion.std(axis=0)
        rows += _motion_rows('joint', count, joint, truth, places, chosen,
                             common)
        for recipe, eps_t in (('paper, as printed', 'printed'),
                              ('paper, corrected', 'corrected')):
            solution = ProperMotionFitter(
                recipe='paper', eps_t=eps_t, references=chosen,
                match_by='sky').fit(joint.epochs)
            rows += _motion_rows(recipe, count, solution, truth, places,
                                 chosen, np.full(2, np.nan))
    return QTable(rows=rows, names=(
        'recipe', 'count', 'id', 'kind', 'mag', 'pmra', 'pmra_error',
        'pmra_true', 'pmdec', 'pmdec_error', 'pmdec_true', 'pmra_frame',
        'pmdec_frame'))


def _motion_rows(recipe, count, solution, truth, places, chosen, common):
    """Return a row for each source seen every time, references left out."""
    stars = solution.stars
    stars = stars[(stars['n_good_obs'] >= count)
                  & np.isfinite(stars['pmra_error'].value)
                  & np.isfinite(stars['ra'].value)]
    i, j = _same(SkyCoord(stars['ra'], stars['dec']), places)
    rows = []
    for star, true in zip(stars[i], truth[j], strict=True):
        if true['id'] not in chosen['id']:
            rows.append((recipe, count, int(true['id']), str(true['kind']),
                         true['mag_g'].value, star['pmra'].value,
                         star['pmra_error'].value, true['pmra'].value,
                         star['pmdec'].value, star['pmdec_error'].value,
                         true['pmdec'].value, *common))
    return rows


def _by_magnitude(motions):
    """Return errors of all sources by number of observations and mag."""
    part = motions[motions['recipe'] == 'joint']
    rows = []
    for count in CAMPAIGNS:
        some = part[part['count'] == count]
        for low, here in binned(some['mag'], EDGES):
            if here.sum() < 5:
                continue
            for name in MOTIONS:
                away = np.asarray(some[name] - some[f'{name}_true'])[here]
                stated = np.asarray(some[f'{name}_error'])[here]
                rows.append((count, low + 0.5, name, int(here.sum()),
                             np.median(stated), spread(away)))
    return QTable(rows=rows, names=(
        'count', 'mag', 'motion', 'number', 'stated', 'scatter'),
        units=(None, 'mag', None, None, 'mas/yr', 'mas/yr'))


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
            if here.sum() >= 5:
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
    canvas = canvas_of(3.3)
    left, right = canvas.subplots(1, 2)
    found, run = tables['found'], tables['run']
    dots = left.scatter(found['ra'].value, found['dec'].value,
                        c=found['count'], s=4, vmin=-0.5, vmax=7.5,
                        cmap=canvas_colours(8), linewidths=0)
    canvas.colorbar(dots, ax=left, ticks=range(8),
                    label='exposures that show a source')
    size = run.settings.sky_size
    corner = np.array([0, size, size, 0, 0]) - 0.5
    for k, taken in enumerate(exposures(run)):
        wcs = taken.wcs((size, size), PIXEL)
        left.plot(*wcs(corner, np.roll(corner[:4], 1)[[0, 1, 2, 3, 0]],
                       with_bounding_box=False), color=COLOURS[k],
                  label=f'{taken.time.utc.isot[:10]} {taken.band.name}')
    left.set(xlabel='right ascension [deg]', ylabel='declination [deg]')
    left.invert_xaxis()
    left.ticklabel_format(useOffset=False)
    left.locator_params(nbins=4)
    left.legend(loc='lower center', bbox_to_anchor=(0.5, 1.0), ncols=3)
    for kind, colour, line in (('star', COLOURS[0], '-'),
                               ('qso', COLOURS[4], '--')):
        part = found[found['kind'] == kind]
        word = {'star': 'stars', 'qso': 'quasars'}[kind]
        right.hist(part['mag'], np.arange(18, 26.1, 0.5), histtype='step',
                   color=colour, linestyle=line, linewidth=1.5,
                   label=f'{len(part)} {word}')
    right.set(xlabel='g [mag]', ylabel='number per 0.5 mag')
    right.legend()
    return canvas


def compare_epochs(tables):
    """Compare the numbers of sources."""
    kinds = tables['found']['kind']
    side = tables['run'].settings.sky_size * PIXEL / 60
    return [Comparison('stars and quasars', '614 and 590',
                       f'{np.sum(kinds == "star")} and '
                       f'{np.sum(kinds == "qso")}'),
            Comparison('side of the field', "11.3'", f"{side:.1f}'")]


def draw_positions(coordinate, tables):
    """Draw Fig. 9 or 10: errors of positions for each band."""
    table = tables['positions']
    canvas = canvas_of(3.1)
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
        ax.axhline(0.86, color='0.4', linewidth=0.8, linestyle='--',
                   label="the paper's smallest, 0.86 mas")
        ax.set(yscale='log', xlabel='magnitude [mag]', title=MODELS[model],
               ylabel=f'error in {COORDINATES[coordinate]} [mas]')
        ax.label_outer()
    ax.legend()
    return canvas


def compare_positions(coordinate, tables):
    """Compare the smallest error."""
    table, full = tables['positions'], tables['run'].settings.name == 'full'
    lines = []
    for model, words in MODELS.items():
        part = table[(table['model'] == model)
                     & (table['coordinate'] == coordinate)]
        lines.append(Comparison.below(
            f'smallest error of all bins, {words}', 0.86,
            np.min(part['scatter'].value), unit='mas', method=model == 'paper',
            full=full, why='the PSF and the frame limit bright stars'))
        lines += [Comparison(
            f'{words}, {row["band"]} = {row["mag"].value:.1f} mag: scatter, '
            'median stated error', 'in the figure only',
            f'{row["scatter"].value:.2f}, {row["stated"].value:.2f} mas')
            for row in part if model == 'paper' and row['band'] == 'g']
    return lines


def draw_medians(tables):
    """Draw Fig. 11: errors of motions by number of observations."""
    canvas = canvas_of(5.6)
    axes = canvas.subplots(2, 2)
    for ax, recipe in zip(axes.flat, RECIPES, strict=False):
        _draw_recipe(ax, tables['medians'], recipe)
    table, ax = tables['by_magnitude'], axes[1, 1]
    for k, mag in enumerate(np.unique(table['mag'].value)):
        part = table[(table['mag'].value == mag)
                     & (table['motion'] == 'pmra')]
        ax.plot(part['count'], part['scatter'].value, f'{MARKS[k]}-',
                color=COLOURS[k], label=f'{mag:.1f} mag')
    ax.set(yscale='log', xlabel='number of observations',
           ylabel='scatter about the truth [mas / yr]',
           title=f'joint solution, {MOTIONS["pmra"]}, by g')
    ax.legend(ncols=2)
    canvas.legend(*axes[0, 0].get_legend_handles_labels(), ncols=3,
                  loc='outside lower center')
    return canvas


def _draw_recipe(ax, table, recipe):
    for k, (name, label) in enumerate(MOTIONS.items()):
        part = table[(table['recipe'] == recipe) & (table['motion'] == name)]
        colour = COLOURS[(4, 6)[k]]
        ax.errorbar(part['count'], part['median_error'].value,
                    part['error_of_median'].value, fmt=f'{MARKS[k]}-',
                    color=colour, label=f'{label}, median stated error')
        ax.plot(part['count'], part['scatter'].value, f'{MARKS[k]}:',
                color=colour, mfc='none',
                label=f'{label}, scatter about the truth')
    ax.plot([5, 7], [1.0, 0.8], '*', color=COLOURS[0], markersize=9,
            label='printed: below 1.0, about 0.8')
    ax.set(xlabel='number of observations', yscale='log',
           ylabel='error of a motion [mas / yr]', title=RECIPES[recipe])


def compare_medians(tables):
    """Compare the medians for two, five and seven observations."""
    table, full = tables['medians'], tables['run'].settings.name == 'full'
    lines = []
    for recipe, words in RECIPES.items():
        for count, printed in ((5, 1.0), (7, 0.8)):
            part = table[(table['recipe'] == recipe)
                         & (table['count'] == count)]
            for row in part:
                what = f'{words}: {row["motion"]}, {count} observations'
                lines += [Comparison.below(
                    f'{what}, median stated error', printed,
                    row['median_error'].value, unit='mas/yr', full=full,
                    why=_WHY_MOTION, method=recipe == 'paper, as printed'),
                    Comparison(f'{what}, scatter about the truth; over the '
                               'stated error', 'not given',
                               f'{row["scatter"].value:.2f} mas/yr; '
                               f'{row["pull"]:.2f}')]
    return lines + _magnitude_lines(tables['by_magnitude'])


def _magnitude_lines(table):
    """Return lines for two and seven observations of each magnitude."""
    return [Comparison(
        f'joint solution: {row["motion"]}, {row["count"]} observations, '
        f'g = {row["mag"].value:.1f} mag: stated, scatter', 'not given',
        f'{row["stated"].value:.2f}, {row["scatter"].value:.2f} mas/yr')
        for row in table if row['count'] in (2, 5, 7)
        and row['motion'] == 'pmra']


_WHY_MOTION = ('the median is over all sources down to the detection limit, '
               'whose magnitudes the paper shows in a figure only')


def draw_bins(tables):
    """Draw Fig. 12: total and systematic errors of quasars."""
    table = tables['bins']
    canvas = canvas_of(5.2)
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
    for ax in axes.flat:
        ax.label_outer()
    axes[0, 0].legend(title='observations', ncols=2)
    return canvas


def _draw_bin(axes, part, k, count):
    style = {'color': COLOURS[k], 'label': f'{count}'}
    axes[0].plot(part['mag'], part['total'], f'{MARKS[k]}-', **style)
    axes[0].fill_between(part['mag'], part['total_low'], part['total_high'],
                         color=COLOURS[k], alpha=0.2, linewidth=0)
    axes[1].errorbar(part['mag'] + 0.08 * (k - 2.5), part['systematic'],
                     part['systematic_error'], fmt=MARKS[k], **style)


def compare_bins(tables):
    """Return every bin: total error, median motion and its error, frame."""
    return [Comparison(
        f'{row["motion"]}, {row["count"]} observations, g = '
        f'{row["mag"]:.1f} mag: total; systematic; of the frame',
        'in the figure only',
        f'{row["total"]:.2f}; {row["systematic"]:+.2f} +- '
        f'{row["systematic_error"]:.2f}; {row["frame"]:.2f} mas/yr')
        for row in tables['bins']]


def _position_figure(key, coordinate, words):
    return Figure(
        key, f'Fig. {key[3:]}: errors of positions in {words}',
        'Positions on the sky of both kinds of sources, from the pixels of '
        'the seven exposures and WCS that know the nominal pointing only: '
        'pointing, roll, scale, distortion and aberration are fitted, as '
        'cubic maps of each exposure, in the joint solution of all seven. '
        'The truth is where a source is on the sky at that time. The '
        'scatter is 1.4826 times the median of absolute errors; the paper '
        'calls its error a positional uncertainty and does not define it.',
        lambda tables: draw_positions(coordinate, tables),
        lambda tables: compare_positions(coordinate, tables))


GROUPS = (Group('sky', measure, (
    Figure('fig8', 'Fig. 8 and Table 2: the exposures',
           'Stars and quasars of ``sky_field`` at the dates of Table 2 '
           '(``paper_exposures``), moving, with parallaxes and aberration. '
           'Each exposure has a pointing, a roll, a scale and a distortion '
           'of its own; lines are their edges.', draw_epochs,
           compare_epochs),
    _position_figure('fig9', 'ra', 'right ascension'),
    _position_figure('fig10', 'dec', 'declination'),
    Figure('fig11', 'Fig. 11: errors of motions by number of observations',
           'Stars, and quasars that are not references, seen in every '
           'exposure; measured with three Gaussians from the empirical PSF, '
           'as in the paper. Identities are found on the sky, distortion is '
           'fitted, parallaxes are fitted with a prior, and the motions of '
           'the references have errors of 0.1 mas/yr. Three recipes: the '
           'joint solution with cubic maps; and Eqs. 11 to 15 of the paper, '
           'as printed and with the standard error of the mean displacement '
           'in Eq. 14, whose maps are shifts and which therefore start from '
           'the frames that the joint solution has corrected, as the paper '
           'starts from frames corrected elsewhere. A median depends on how '
           'bright the sources are: the last panel has the scatter by '
           'magnitude.', draw_medians, compare_medians),
    Figure('fig12', 'Fig. 12: errors of the motions of quasars',
           'Joint solution. Top: median stated error, which contains that of '
           'the frame, with the 1-sigma band of the bootstrap. Bottom: the '
           'median motion, whose true value is zero, and its bootstrap '
           'error.', draw_bins, compare_bins))),)
