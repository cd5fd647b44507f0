"""A field as dense as the bulge: Figs. 13 and 14."""
from functools import partial

import astropy.units as u
import numpy as np
from astropy.nddata import block_reduce
from astropy.table import QTable, Table
from daophot import daophot
from matplotlib.patches import Rectangle
from peers import (
    INSTALL,
    AbsentError,
    crowdsource,
    sextractor,
    windowed,
)
from scenes import (
    background_free,
    cubic,
    detector,
    find_stars,
    robust_fit,
    through_files,
)
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree
from settings import DETECTOR, PIXEL, effects
from store import Comparison, Figure, Group, binned, judged, plain
from styles import COLOURS, canvas_of, plain_log

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    Exposure,
    Instrument,
    MixturePSFPhotometry,
    cramer_rao,
    crowded_field,
    simulate,
)

EDGES = np.arange(17, 26)
MARGIN = 12
OURS = 'crowded, mixture field'
PAPER = 'star by star, K = 3'
# Sides of the windows in which stars are fitted one by one [pix].
WINDOWS = (3, 5, 7, 11)
WINDOW = 7
# Sides of the part that Fig. 13 shows enlarged, and of the whole image on the
# figure, at most [pix].
PART, SHOWN = 200, 256
SEXTRACTOR = ('SExtractor IMAGE', 'SExtractor WIN', 'SExtractor PSF')
MAS = 1000 * PIXEL
# How each method looks: colour, mark and line. Ours are thick, the modes of
# SExtractor have one colour.
LOOKS = {
    'SExtractor IMAGE': ('#E69F00', 'v:'), 'SExtractor WIN': ('#E69F00', '^-'),
    'SExtractor PSF': ('#E69F00', 's--'), 'sep windowed': ('#999999', '^:'),
    'photutils, empirical PSF': ('#999999', 's-'), PAPER: ('#0072B2', 's-'),
    'crowded, K = 3': ('#0072B2', 'o--'), OURS: ('#D55E00', 'o-'),
    'crowdsource': ('#009E73', 'D-'), 'DAOPHOT': ('#CC79A7', 'P-')}


def scene_of(run):
    """Return the corner of detector 8 that is simulated, and its PSF."""
    one = detector(run, 8, run.settings.sky_shape)
    shape, seed = run.settings.crowded_shape, 1000 * run.seed
    scene = simulate(crowded_field(shape, rng=41 + seed),
                     Exposure(band='g', detector=8), psf=one.light,
                     instrument=Instrument(shape=shape), effects=effects(),
                     rng=42 + seed)
    return one, through_files(scene)


def measure(run):
    """Return the errors of every method by magnitude."""
    made = []

    def crowd():
        if not made:
            made.append(Crowd(run, *scene_of(run)))
        return made[0]
    found = {'run': run}
    for key, name, function in (
            ('counts', 'fig13_counts', lambda: _counts(crowd().scene)),
            ('image', 'fig13_image', lambda: _shown(crowd().scene)),
            ('part', 'fig13_part', lambda: _shown(crowd().scene, PART)),
            ('errors', 'fig14_errors', lambda: _errors(
                crowd(), _lists(run, crowd, METHODS))),
            ('windows', 'fig14_windows', lambda: _windows(
                crowd(), _lists(run, crowd, SEXTRACTOR)))):
        found[key] = run.table(name, function)
    for name in METHODS:
        if name not in found['errors']['method']:
            run.skipped.setdefault(
                name, 'not run where this was measured')
    run.skipped['DOLPHOT'] = f'not run here ({INSTALL["DOLPHOT"]})'
    return found


def _lists(run, crowd, names):
    """Return the lists of stars of methods, but of those not installed."""
    lists = {}
    for name in names:
        stored = name.replace(' ', '_').replace(',', '').replace('=', '')
        try:
            lists[name] = run.table(
                f'crowded_{stored}',
                lambda name=name: QTable(METHODS[name](crowd())), keep=False)
        except AbsentError as error:
            run.skipped[name] = str(error)
    return lists


class Crowd:
    """The crowded image and what all methods start from."""

    def __init__(self, run, one, scene):
        self.run, self.one, self.scene = run, one, scene
        self.data, self.noise = background_free(scene)
        self._stars = None
        self._sextractor = {}

    @property
    def detected(self):
        """Starting positions: those of SExtractor, as in the paper."""
        if self._stars is None:
            self._stars = self._detect()
        return self._stars

    def _detect(self):
        try:
            found = self.sextractor()
        except AbsentError:
            x, y = find_stars(self.data, self.noise, self.scene.mask)
        else:
            x, y = found['XWIN_IMAGE'] - 1, found['YWIN_IMAGE'] - 1
        flux = _aperture(self.data, x, y)
        good = np.isfinite(x) & np.isfinite(y)
        return Table({'x_init': np.asarray(x, float)[good],
                      'y_init': np.asarray(y, float)[good],
                      'flux_init': np.maximum(flux, 1)[good]})

    def sextractor(self, psf=None):
        """Return the list of SExtractor, made once with each PSF."""
        if psf not in self._sextractor:
            self._sextractor[psf] = sextractor(
                self.scene, psf=psf, threshold=2.0, contrast=0)
        return self._sextractor[psf]


def _aperture(data, x, y):
    """Return the light within 5 x 5 pixels of places."""
    ny, nx = data.shape
    column = np.clip(np.rint(np.nan_to_num(x)).astype(int), 2, nx - 3)
    row = np.clip(np.rint(np.nan_to_num(y)).astype(int), 2, ny - 3)
    return sum(data[row + i, column + j] for i in range(-2, 3)
               for j in range(-2, 3))


# The methods: each returns a table of x, y and flux.

def from_sextractor(x, y, flux, crowd):
    """Return the centres of one of SExtractor's three modes."""
    path = None
    if x == 'XPSF_IMAGE':
        path = crowd.one.psfex[1].resolve()
    found = crowd.sextractor(path)
    good = np.isfinite(found[x]) & (found[flux] > 0)
    found = found[good]
    return Table({'x': np.asarray(found[x], float) - 1,
                  'y': np.asarray(found[y], float) - 1,
                  'flux': np.asarray(found[flux], float)})


def with_sep(crowd):
    """Return windowed centres of the detected stars."""
    start = crowd.detected
    return windowed(crowd.data, start['x_init'], start['y_init'])


def with_photutils(crowd):
    """Return fits of photutils with the empirical PSF, star by star."""
    from photutils.psf import PSFPhotometry
    psf = crowd.one.empirical.to_gridded_psf((10, 10))
    photometry = PSFPhotometry(psf, (7, 7), xy_bounds=1.0,
                               aperture_radius=2.5)
    return _plain(photometry(crowd.data, error=crowd.scene.error,
                             mask=crowd.scene.mask,
                             init_params=crowd.detected))


def star_by_star(side, crowd, psf=None):
    """Return fits of three Gaussians, star by star, as in the paper."""
    photometry = MixturePSFPhotometry(
        psf or crowd.one.chain, (side, side), xy_bounds=1.0,
        aperture_radius=min(2.5, side / 2))
    return _plain(photometry(crowd.data, error=crowd.scene.error,
                             mask=crowd.scene.mask,
                             init_params=crowd.detected))


def together(name, crowd):
    """Return all stars found and fitted together."""
    photometry = CrowdedMixturePhotometry(crowd.one.models[name])
    return _plain(photometry(crowd.scene.image, error=crowd.scene.error,
                             mask=crowd.scene.mask))


def with_crowdsource(crowd):
    """Return crowdsource's own list, with our mixture field as its PSF."""
    return crowdsource(crowd.run.crowdsource_python, crowd.data,
                       crowd.scene.error, crowd.scene.mask,
                       crowd.one.models['field'])


def with_daophot(crowd):
    """Return DAOPHOT's own list, with a PSF of its own."""
    stars = crowd.one.psf_stars
    return daophot(crowd.scene, crowd.one.sparse, stars[stars['selected']],
                   crowd.run.settings.degree)


def _plain(table):
    out = plain(table['x_fit', 'y_fit', 'flux_fit'])
    out.rename_columns(('x_fit', 'y_fit', 'flux_fit'), ('x', 'y', 'flux'))
    return out[np.isfinite(out['x']) & np.isfinite(out['y'])
               & (out['flux'] > 0)]


METHODS = {
    'SExtractor IMAGE': partial(from_sextractor, 'X_IMAGE', 'Y_IMAGE',
                                'FLUX_AUTO'),
    'SExtractor WIN': partial(from_sextractor, 'XWIN_IMAGE', 'YWIN_IMAGE',
                              'FLUX_AUTO'),
    'SExtractor PSF': partial(from_sextractor, 'XPSF_IMAGE', 'YPSF_IMAGE',
                              'FLUX_PSF'),
    'sep windowed': with_sep,
    'photutils, empirical PSF': with_photutils,
    PAPER: partial(star_by_star, WINDOW),
    'crowded, K = 3': partial(together, 'paper'),
    OURS: partial(together, 'field'),
    'crowdsource': with_crowdsource,
    'DAOPHOT': with_daophot,
}


def _counts(scene):
    """Return how many stars of each magnitude are on the image."""
    mag = scene.truth['mag'].value[scene.truth['inside']]
    edges = np.arange(16, 26.1, 0.25)
    return QTable({'mag_low': edges[:-1] * u.mag,
                   'stars': np.histogram(mag, edges)[0]})


def _shown(scene, part=None):
    """
    Return an image, or its corner, as the figure shows it.

    Large ones are means of blocks of pixels. Numbers are a hundred times the
    inverse hyperbolic sine of a tenth of the electrons.
    """
    image = scene.image - scene.background
    if part:
        side = min(part, *(n // 2 for n in image.shape))
        image = image[:side, :side]
    block = -(-max(image.shape) // SHOWN)
    if block > 1:
        image = block_reduce(image, block, np.mean)
    return QTable({'row': np.rint(
        100 * np.arcsinh(image / 10)).astype(int)})


# Errors

def _windows(crowd, lists):
    """
    Return what decides how well stars are fitted one by one.

    A row for each window, PSF and magnitude, and for each mode of
    SExtractor: medians for the stars found, and for those that all of them
    found.
    """
    truth = _truth(crowd)
    tried = {('K = 3', side): star_by_star(side, crowd) for side in WINDOWS}
    tried |= {('mixture field, K = 5', side): star_by_star(
        side, crowd, crowd.one.models['field']) for side in WINDOWS}
    tried |= {(name, 0): plain(lists[name]) for name in SEXTRACTOR
              if name in lists}
    errors = {key: _matched(crowd, table, truth)[0]
              for key, table in tried.items()}
    common = np.all([np.isfinite(one) for one in errors.values()], axis=0)
    rows = []
    for (name, side), found in errors.items():
        for low, here in binned(truth['mag'], EDGES):
            mine = here & truth['counted'] & np.isfinite(found)
            rows.append((name, side, low + 0.5, int(mine.sum()),
                         _median(found[mine]), int((mine & common).sum()),
                         _median(found[mine & common])))
    return QTable(rows=rows, names=(
        'method', 'window', 'mag', 'number', 'median_error', 'number_common',
        'median_common'), units=(None, 'pix', 'mag', None, 'mas', None,
                                 'mas'))


def _errors(crowd, lists):
    """Return a row for each method and magnitude."""
    truth = _truth(crowd)
    found = {name: _matched(crowd, plain(table), truth)
             for name, table in lists.items()}
    bound = _bound(crowd, truth)
    rows = []
    for name, (errors, false) in found.items():
        for low, here in binned(truth['mag'], EDGES):
            counted = here & truth['counted']
            rows.append((name, low + 0.5, *_row(
                errors, found[OURS][0], bound, counted), false))
    return QTable(rows=rows, names=(
        'method', 'mag', 'number', 'completeness', 'median_error',
        'crowded_same_stars', 'bound', 'false_share'),
        units=(None, 'mag', None, None, 'mas', 'mas', 'mas', None))


def _row(errors, ours, bound, counted):
    """Return number, completeness and medians of one bin."""
    mine = counted & np.isfinite(errors)
    both = mine & np.isfinite(ours)
    return (int(counted.sum()), mine.sum() / max(counted.sum(), 1),
            _median(errors[mine]), _median(ours[both]),
            _median(bound[counted]))


def _median(values):
    return MAS * np.median(values) if len(values) >= 5 else np.nan


def _truth(crowd):
    """Return the stars on the image, and whether they count."""
    truth = plain(crowd.scene.truth['x', 'y', 'mag', 'flux'])
    ny, nx = crowd.run.settings.crowded_shape
    truth = truth[_within(truth['x'], truth['y'], nx, ny, -0.5)]
    near = binary_dilation(crowd.scene.mask, iterations=2)
    x, y = (np.clip(np.rint(truth[c]).astype(int), 0, n - 1)
            for c, n in (('x', nx), ('y', ny)))
    truth['counted'] = ~near[y, x] & _within(x, y, nx, ny, MARGIN)
    return truth


def _within(x, y, nx, ny, margin):
    """Whether places are farther from the edges of an image than that."""
    return ((np.minimum(x, y) > margin) & (x < nx - 1 - margin)
            & (y < ny - 1 - margin))


def _matched(crowd, table, truth):
    """Return each true star's error [pix] or NaN, and the false share."""
    shape = crowd.run.settings.crowded_shape
    zero = np.median(truth['mag'] + 2.5 * np.log10(truth['flux']))
    table = _centred(table, truth, zero, shape)
    i, j = _pairs(table, truth, zero, 0.5, 1.0)
    errors = np.full(len(truth), np.nan)
    errors[j] = np.hypot(table['x'][i] - truth['x'][j],
                         table['y'][i] - truth['y'][j])
    return errors, 1 - len(i) / len(table)


def _centred(table, truth, zero, shape):
    """Take the smooth difference of centring conventions out of a list."""
    i, j = _pairs(table, truth, zero, 1.0, 0.5)
    bright = truth['mag'][j] < 20.5
    i, j = i[bright], j[bright]
    shift = np.column_stack([table[c][i] - truth[c][j] for c in 'xy'])
    # A short list cannot tell a cubic.
    n_terms = 10 if len(i) > 60 else 1
    terms = cubic(table['x'], table['y'], shape)[:, :n_terms]
    found = robust_fit(terms[i], shift)
    out = table.copy()
    for k, c in enumerate('xy'):
        out[c] = table[c] - terms @ found[:, k]
    return out


def _pairs(table, truth, zero, radius, tolerance):
    """Match one to one, closest first; return rows of both."""
    magnitude = zero - 2.5 * np.log10(np.maximum(table['flux'], 1e-9))
    trees = [cKDTree(np.column_stack([t['x'], t['y']]))
             for t in (table, truth)]
    near = trees[0].sparse_distance_matrix(trees[1], radius,
                                           output_type='coo_matrix')
    alike = np.abs(magnitude[near.row] - truth['mag'][near.col]) < tolerance
    order = np.argsort(near.data[alike])
    i, j = near.row[alike][order], near.col[alike][order]
    used = np.zeros(len(table), bool), np.zeros(len(truth), bool)
    keep = np.zeros(len(i), bool)
    for k, (a, b) in enumerate(zip(i, j, strict=True)):
        keep[k] = not (used[0][a] or used[1][b])
        if keep[k]:
            used[0][a] = used[1][b] = True
    return i[keep], j[keep]


def _bound(crowd, truth):
    """Return the median error a lone star must have [pix]."""
    scene = crowd.scene
    base = (scene.background + scene.instrument.dark_level
            + scene.instrument.readout_variance)
    result = cramer_rao(crowd.one.models['field'], flux=truth['flux'],
                        sky=base, x=truth['x'], y=truth['y'], fit_shape=11)
    # The median of the length of two normal numbers of equal width.
    width = np.sqrt((result.x_err**2 + result.y_err**2) / 2)
    return np.sqrt(2 * np.log(2)) * width


# Figures

def draw_field(tables):
    """Draw Fig. 13: magnitudes, the image, a part of it."""
    counts = tables['counts']
    canvas = canvas_of(2.5)
    left, middle, right = canvas.subplots(1, 3)
    low = counts['mag_low'].value
    left.stairs(counts['stars'], [*low, low[-1] + 0.25], fill=True,
                color=COLOURS[0])
    left.set(yscale='log', xlabel='g [mag]', ylabel='stars per 0.25 mag')
    ny, nx = tables['run'].settings.crowded_shape
    part = len(tables['part'])
    for ax, name, (high, wide) in ((middle, 'image', (ny, nx)),
                                   (right, 'part', (part, part))):
        shown = ax.imshow(np.asarray(tables[name]['row']) / 100,
                          origin='lower', vmin=-0.5, vmax=7,
                          extent=(-0.5, wide - 0.5, -0.5, high - 0.5))
        ax.set(xlabel='x [pix]', ylabel='y [pix]')
    middle.add_patch(Rectangle((-0.5, -0.5), part, part, fill=False,
                               edgecolor='white', linewidth=1.2))
    canvas.colorbar(shown, ax=right, label='arcsinh(electrons / 10)')
    return canvas


def compare_field(tables):
    """Compare the density."""
    ny, nx = tables['run'].settings.crowded_shape
    count = int(np.sum(tables['counts']['stars']))
    return [Comparison('stars per pixel', f'{5.4e6 / (9216 * 9232):.4f}',
                       f'{count / nx / ny:.4f}'),
            Comparison('pixels', '9216 x 9232', f'{nx} x {ny}')]


def draw_errors(tables):
    """Draw Fig. 14: errors of positions of all methods."""
    table = tables['errors']
    canvas = canvas_of(3.9)
    left, right = canvas.subplots(1, 2)
    for name in dict.fromkeys(table['method']):
        part = table[table['method'] == name]
        colour, mark = LOOKS[name]
        own = name in (OURS, PAPER)
        style = {'color': colour, 'label': name, 'zorder': 3 if own else 2,
                 'linewidth': 2.2 if own else 0.8,
                 'markerfacecolor': colour if own else 'white'}
        left.plot(part['mag'], part['median_error'], mark, **style)
        right.plot(part['mag'], 100 * part['completeness'], mark, **style)
    left.plot(part['mag'], part['bound'], 'k:',
              label='bound of a lone star')
    left.set(xlabel='g [mag]', ylabel='median error of position [mas]')
    plain_log(left)
    right.set(xlabel='g [mag]', ylabel='stars found [%]')
    canvas.legend(*left.get_legend_handles_labels(), ncols=4,
                  loc='outside lower center')
    return canvas


def compare_errors(tables):
    """Compare with the best mode of SExtractor, and windows with another."""
    table = tables['errors']
    modes = [name for name in SEXTRACTOR if name in table['method']]
    if not modes:
        return [Comparison('error over that of the best mode of SExtractor',
                           'below 1 for stars fainter than 21 mag',
                           'SExtractor is not installed')]
    # A full run has a part of the chip, which is not the paper's size.
    full, lines = tables['run'].settings.crowded_shape == DETECTOR, []
    for middle in np.unique(table['mag'].value):
        here = table[table['mag'].value == middle]
        some = here[np.isin(here['method'], modes)
                    & np.isfinite(here['median_error'].value)]
        if len(some):
            lines += _lines(middle, here, some, full)
    return (lines + _window_lines(tables['windows'])
            + _program_lines(table))


def _program_lines(table):
    """Return what programs that find stars themselves reach, and we."""
    names = [name for name in (OURS, 'crowded, K = 3', 'DAOPHOT',
                               'crowdsource') if name in table['method']]
    lines = []
    for middle in np.unique(table['mag'].value):
        rows = [table[(table['mag'].value == middle)
                      & (table['method'] == name)][0] for name in names]
        if np.isfinite(rows[0]['median_error'].value):
            lines.append(Comparison(
                f'{middle:.1f} mag, each on the stars it finds: '
                f'{"; ".join(names)} (complete to)', 'not compared',
                '; '.join(f'{row["median_error"].value:.2f} '
                          f'({row["completeness"]:.0%})'.replace('%', ' %')
                          for row in rows) + ' mas'))
    return lines


def _lines(middle, here, some, full):
    """Compare one magnitude: star by star, and all stars together."""
    best = some[np.argmin(some['median_error'])]['median_error'].value
    alone = here[here['method'] == PAPER][0]['median_error'].value
    ours = here[here['method'] == OURS][0]['crowded_same_stars'].value
    return [_line(middle, f'{PAPER}, 7 x 7 pixels', alone, best, True, full),
            _line(middle, f'{OURS}, on the stars of SExtractor', ours, best,
                  False, full)]


def _line(middle, name, ours, best, method, full):
    return Comparison(
        f'{middle:.1f} mag: {name}; best mode of SExtractor',
        'smaller than SExtractor' if middle > 21 else 'SExtractor WIN '
        'similar', f'{ours:.2f} mas; {best:.2f} mas',
        judged(ours < best, '', method=method, full=full))


def _window_lines(table):
    """Compare windows with the modes of SExtractor, on common stars."""
    lines = []
    for middle in np.unique(table['mag'].value):
        here = table[table['mag'].value == middle]
        if not np.isfinite(here['median_common'].value).any():
            continue
        modes = here['median_common'][here['window'].value == 0].value
        mine = here[here['method'] == 'K = 3']
        values = mine['median_common'].value
        best = np.nanmin(modes) if len(modes) else np.nan
        words = ' / '.join(f'{v:.2f}' for v in values)
        sides = [str(side) for side, value in zip(WINDOWS, values,
                                                  strict=True) if value < best]
        lines.append(Comparison(
            f'{middle:.1f} mag, stars common to all: star by star, K = 3, in '
            f'{" / ".join(map(str, WINDOWS))} pixels; best mode of '
            'SExtractor', 'smaller than SExtractor' if middle > 21 else
            'SExtractor WIN similar',
            f'{words}; {best:.2f} mas ({mine["number_common"][0]} stars)',
            f'better in windows of {", ".join(sides)} pixels' if sides
            else 'worse in all windows'))
    return lines


GROUPS = (Group('crowded', measure, (
    Figure('fig13', 'Fig. 13: the crowded field',
           'The density of the paper, with the luminosity function that '
           '``crowded_field`` states in place of the Galaxy model of the '
           'paper.', draw_field, compare_field),
    Figure('fig14', 'Fig. 14: centring in the crowded field',
           'Medians of the distance from the truth, of the stars that each '
           'method found; on the right the share of stars it found. The '
           'PSFs of all methods are made from the sparse exposure of the '
           'same detector, none is the true one. The smooth difference of '
           'centring conventions is taken out of every list. In the lines '
           'below, the error of the crowded fit is that for the stars '
           "SExtractor found, too; that of the paper's own way, star by "
           'star, is for the stars it found itself. The paper does not say '
           'in which window it fits: the last lines have four windows, all '
           'from the detections of SExtractor, and medians of the stars that '
           'all windows and all modes of SExtractor found.', draw_errors,
           compare_errors)),
    ('fig13_counts', 'fig13_image', 'fig13_part', 'fig14_errors',
     'fig14_windows')),)
