"""Seven exposures of stars and quasars: Figs. 8 to 12."""
from dataclasses import replace

import numpy as np
from settings import CAMPAIGNS, DETECTOR, PIXEL
from sky_measures import (
    COORDINATES,
    MODELS,
    MOTIONS,
    RECIPES,
    exposures,
    measure,
)
from store import Comparison, Figure, Group
from styles import (
    COLOURS,
    MARKS,
    canvas_colours,
    canvas_of,
    plain_log,
)

from photutils_mgauss import paper_exposures

# The smallest of many scatters is that of the bin with the fewest members,
# unless a bin must have so many.
MEASURED = 20


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
    ny, nx = run.settings.sky_shape
    corners = np.array([[0, nx, nx, 0, 0], [0, 0, ny, ny, 0]]) - 0.5
    for k, taken in enumerate(exposures(run)):
        wcs = taken.wcs((ny, nx), PIXEL)
        left.plot(*wcs(*corners, with_bounding_box=False), color=COLOURS[k],
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
    side = min(tables['run'].settings.sky_shape) * PIXEL / 60
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
            ax.errorbar(part['mag'].value + 0.06 * (k - 1),
                        part['scatter'].value, _scatter_error(part),
                        fmt=f'{MARKS[k]}-', color=COLOURS[k],
                        label=f'{band}, scatter about the truth')
            ax.plot(part['mag'].value, part['stated'].value, ':',
                    color=COLOURS[k], label=f'{band}, median stated error')
        ax.axhline(0.86, color='0.4', linewidth=0.8, linestyle='--',
                   label="the paper's smallest, 0.86 mas")
        ax.set(xlabel='magnitude [mag]', title=MODELS[model],
               ylabel=f'error in {COORDINATES[coordinate]} [mas]')
        plain_log(ax)
        ax.label_outer()
    ax.legend()
    return canvas


def _scatter_error(part):
    """Return the error of 1.4826 times a median of absolute values."""
    return 1.17 * part['scatter'].value / np.sqrt(part['number'])


def compare_positions(coordinate, tables):
    """Compare the smallest error of the bins that are not tiny."""
    table = tables['positions']
    full = tables['run'].settings.sky_shape == DETECTOR
    lines = []
    for model, words in MODELS.items():
        part = table[(table['model'] == model)
                     & (table['coordinate'] == coordinate)]
        well = part['scatter'].value[part['number'] >= MEASURED]
        lines.append(Comparison.below(
            f'smallest error of all bins with {MEASURED} measurements or '
            f'more, {words}', 0.86, np.min(well) if len(well) else np.nan,
            unit='mas', method=model == 'paper', full=full,
            why='the PSF and the frame limit bright stars'))
        lines += [Comparison(
            f'{words}, {row["band"]} = {row["mag"].value:.1f} mag: scatter '
            'and its error, median stated error', 'in the figure only',
            f'{row["scatter"].value:.2f} +- {_scatter_error(row):.2f}, '
            f'{row["stated"].value:.2f} mas')
            for row in part if model == 'paper' and row['band'] == 'g']
    return lines


def draw_medians(tables):
    """Draw Fig. 11: errors of motions by number of observations."""
    canvas = canvas_of(5.6)
    axes = canvas.subplots(2, 2).ravel()
    for ax, recipe in zip(axes, RECIPES, strict=False):
        ax.sharey(axes[0])
        _draw_recipe(ax, tables['medians'], recipe)
    table, ax = tables['by_magnitude'], axes[3]
    for k, mag in enumerate(np.unique(table['mag'].value)):
        part = table[(table['mag'].value == mag)
                     & (table['motion'] == 'pmra')]
        ax.errorbar(part['count'] + 0.06 * (k - 3), part['scatter'].value,
                    _scatter_error(part), fmt=f'{MARKS[k]}-',
                    color=COLOURS[k], label=f'{mag:.1f} mag')
    ax.set(xlabel='number of observations',
           ylabel='scatter about the truth [mas / yr]',
           title=f'joint solution, {MOTIONS["pmra"]}, by g')
    plain_log(ax)
    ax.legend(ncols=3)
    low, high = ax.get_ylim()
    ax.set_ylim(low / 1.6, high)
    canvas.legend(*axes[0].get_legend_handles_labels(), ncols=3,
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
    ax.set(xlabel='number of observations', title=RECIPES[recipe],
           ylabel='error of a motion [mas / yr]')
    plain_log(ax)


def dates_alone(which):
    """Return the error of a motion [mas/yr] for 1 mas in each exposure."""
    years = np.array([paper_exposures()[k].time.jyear for k in which])
    return 1 / np.sqrt(np.sum((years - years.mean())**2))


def compare_medians(tables):
    """Compare the medians for two, five and seven observations."""
    table = tables['medians']
    full = tables['run'].settings.sky_shape == DETECTOR
    words = ', '.join(f'{dates_alone(CAMPAIGNS[n]):.3f}' for n in (2, 5, 7))
    lines = [Comparison(
        '2, 5 and 7 observations that are good to 1 mas, from the dates of '
        'Table 2 alone', 'not given', f'{words} mas/yr')]
    for recipe, words in RECIPES.items():
        for count, printed in ((5, 1.0), (7, 0.8)):
            part = table[(table['recipe'] == recipe)
                         & (table['count'] == count)]
            for row in part:
                what = f'{words}: {row["motion"]}, {count} observations'
                stated = Comparison.below(
                    f'{what}, median stated error', printed,
                    row['median_error'].value, unit='mas/yr', full=full,
                    why=_WHY_MOTION, method=recipe == 'paper, as printed')
                lines += [replace(stated, verdict=(
                    f'{stated.verdict}; errors scatter by {row["pull"]:.2f} '
                    'times what is stated')), Comparison(
                        f'{what}, scatter about the truth; over the stated '
                        'error', 'not given',
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
        axes[0, column].set(title=label, ylabel='total error [mas / yr]')
        if len(table):
            plain_log(axes[0, column])
        axes[1, column].axhline(0, color='0.5', linewidth=0.8)
        axes[1, column].set(xlabel='g [mag]',
                            ylabel='systematic error [mas / yr]')
    for ax in axes.flat:
        ax.label_outer()
    axes[0, 0].legend(title='observations', ncols=2)
    return canvas


def _draw_bin(axes, part, k, count):
    style = {'color': COLOURS[k], 'label': f'{count}'}
    place = part['mag'] + 0.08 * (k - 2.5)
    # Bands of six campaigns would hide each other.
    axes[0].errorbar(place, part['total'],
                     [part['total'] - part['total_low'],
                      part['total_high'] - part['total']],
                     fmt=f'{MARKS[k]}-', **style)
    axes[1].errorbar(place, part['systematic'], part['systematic_error'],
                     fmt=MARKS[k], **style)


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
           'the frame, with the 1-sigma range of the bootstrap. Bottom: the '
           'median motion, whose true value is zero, and its bootstrap '
           'error.', draw_bins, compare_bins)),
    ('fig8_found', 'fig8_epochs', 'fig9_10_positions', 'fig11_medians',
     'fig11_by_magnitude', 'fig12_bins')),)
