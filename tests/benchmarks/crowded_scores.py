"""Scenes of crowded fields, and how well a list of stars describes one."""
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from photutils_mgauss import GriddedMixturePSF, fit_mixture_field, kernels
from photutils_mgauss.psf.local import LocalPSF

EDGES = np.arange(17, 26)
MARGIN = 12
RADIUS, TOLERANCE = 0.5, 1.0


@dataclass(frozen=True)
class Scene:
    """Images, the stars truly on them, and the zero point."""

    images: dict
    truth: Table
    origin: tuple
    zero: float
    bound: np.ndarray | None = None

    @classmethod
    def load(cls, folder, crop=None):
        """Read a folder, of which a corner of crop pixels is used."""
        folder, part = Path(folder), (slice(crop), slice(crop))
        images = {name: fits.getdata(folder / f'{name}.fits')[part]
                  for name in ('sci', 'err', 'mask', 'vartrue')}
        images = {name: np.ascontiguousarray(image, bool if name == 'mask'
                                             else float)
                  for name, image in images.items()}
        meta = json.loads((folder / 'meta.json').read_text())
        truth = Table.read(folder / 'truth.ecsv')
        if (folder / 'bound.npy').exists():
            truth['bound'] = np.load(folder / 'bound.npy')
        n = len(images['sci'])
        truth = truth[(truth['x'] > -0.5) & (truth['x'] < n - 0.5)
                      & (truth['y'] > -0.5) & (truth['y'] < n - 0.5)]
        near = binary_dilation(images['mask'], iterations=2)
        truth['sat'] = near[tuple(np.rint(truth[c]).astype(int).clip(0, n - 1)
                                  for c in 'yx')]
        zero = meta['zp_e_per_s'] + 2.5 * np.log10(meta['exptime'])
        return cls(images, truth, tuple(meta['origin']), zero)

    @property
    def size(self):
        """The number of pixels of a side."""
        return len(self.images['sci'])

    def bounded(self, psf):
        """Return the scene with the bound of each star's x and y."""
        if 'bound' in self.truth.colnames:
            bound = np.asarray(self.truth['bound'])
        else:
            bound = bounds(psf, self.truth, self.images['vartrue'])
        return Scene(self.images, self.truth, self.origin, self.zero, bound)

    def magnitude(self, flux):
        """Return magnitudes, infinite for fluxes that are not positive."""
        flux = np.asarray(flux, float)
        return self.zero - 2.5 * np.log10(np.where(flux > 0, flux, 1e-30))


def make_psf(folder, origin, n_components, radius):
    """Fit the PSF to the brightest isolated stars of a sparse exposure."""
    from photutils.detection import DAOStarFinder
    scene = Scene.load(folder)
    images = scene.images
    data = images['sci'] - np.median(images['sci'])
    found = DAOStarFinder(300.0, 1.7)(data, mask=images['mask'])
    names = ('x_centroid', 'y_centroid') if (
        'x_centroid' in found.colnames) else ('xcentroid', 'ycentroid')
    x, y = (np.asarray(found[name]) for name in names)
    gap = cKDTree(np.column_stack([x, y])).query(
        np.column_stack([x, y]), k=2)[0][:, 1]
    good = ((gap > 14) & (np.asarray(found['peak']) < 7e4)
            & (np.minimum(x, y) > 20) & (np.maximum(x, y) < len(data) - 20))
    stars = Table({'x': x[good], 'y': y[good],
                   'flux': np.asarray(found['flux'])[good]})
    stars.sort('flux', reverse=True)
    field = fit_mixture_field(data, stars[:300], error=images['err'],
                              mask=images['mask'], radius=radius,
                              n_components=n_components)
    grid = field.to_grid((20, 20))
    shift = np.subtract(scene.origin, origin)
    return GriddedMixturePSF(grid.mixtures, grid.grid_xypos + shift)


def bounds(psf, truth, variance):
    """Return the Cramer-Rao bound of each star's x and y, (n, 2)."""
    x, y, flux = (np.array(truth[c], float) for c in ('x', 'y', 'flux'))
    half = 9
    n, width = x.size, 2 * half + 1
    stamps = kernels.Stamps(
        np.rint(x).astype(np.int64) - half, np.rint(y).astype(np.int64) - half,
        np.full(n, width), np.arange(n) * width**2,
        np.empty((3, n * width**2)))
    kernels.star_stamps(np.arange(n), kernels.Sources(x, y, flux), stamps,
                        LocalPSF.of(psf).gaussians_at(x, y),
                        kernels.Tiling.empty(width))
    equations = kernels.StarEquations(np.empty((n, 3, 3)), np.empty((n, 3)),
                                      np.empty((n, 3)), np.empty((0, 3, 3)))
    kernels.own_equations(flux, stamps, 1 / variance,
                          np.zeros(variance.shape), equations)
    diagonal = np.diagonal(np.linalg.inv(equations.matrix), axis1=1, axis2=2)
    return np.sqrt(diagonal[:, 1:])


def pair(scene, table, radius=RADIUS, tolerance=TOLERANCE):
    """Match one to one, closest first; return rows of truth and table."""
    magnitude = scene.magnitude(table['flux'])
    trees = [cKDTree(np.column_stack([t['x'], t['y']]))
             for t in (scene.truth, table)]
    close = trees[0].sparse_distance_matrix(trees[1], radius,
                                            output_type='coo_matrix')
    true = np.asarray(scene.truth['mag'])
    good = np.abs(true[close.row] - magnitude[close.col]) < tolerance
    i, j, d = close.row[good], close.col[good], close.data[good]
    order = np.argsort(d)
    rows, taken_i, taken_j = [], set(), set()
    for a, b in zip(i[order].tolist(), j[order].tolist(), strict=True):
        if a not in taken_i and b not in taken_j:
            taken_i.add(a)
            taken_j.add(b)
            rows.append((a, b))
    return np.array(rows, int).reshape(-1, 2).T


def centre(scene, table):
    """Take the smooth difference of centring conventions out of a list."""
    n, truth = scene.size, scene.truth

    def basis(t):
        u, v = 2 * t['x'] / n - 1, 2 * t['y'] / n - 1
        return np.column_stack([u**a * v**b for a in range(4)
                                for b in range(4 - a)])
    i, j = pair(scene, table, 1.0, 0.5)
    bright = (truth['mag'][i] < 20.5) & ~truth['sat'][i]
    i, j = i[bright], j[bright]
    out = table.copy()
    for c in 'xy':
        shift = np.asarray(table[c][j] - truth[c][i])
        good = np.ones(shift.size, bool)
        for _ in range(6):
            terms = np.linalg.lstsq(basis(table[j][good]), shift[good],
                                    rcond=None)[0]
            rest = shift - basis(table[j]) @ terms
            good = np.abs(rest) < 5 * np.median(np.abs(rest)) + 1e-9
        out[c] = table[c] - basis(table) @ terms
    return out


@dataclass(frozen=True)
class Score:
    """
    A list of stars beside the truth.

    ``true`` and ``row`` are the rows matched; ``counted`` says which true
    stars and ``listed`` which of the list take part, ``false`` which of the
    list are no stars.
    """

    scene: Scene
    table: Table
    true: np.ndarray
    row: np.ndarray
    counted: np.ndarray
    listed: np.ndarray
    false: np.ndarray

    @classmethod
    def of(cls, scene, table, *, centred=False, radius=RADIUS):
        """Centre and match a list, within a radius [pix]."""
        table = table if centred else centre(scene, table)
        true, row = pair(scene, table, radius)
        n, truth = scene.size, scene.truth

        def inside(t):
            return ((t['x'] > MARGIN) & (t['x'] < n - 1 - MARGIN)
                    & (t['y'] > MARGIN) & (t['y'] < n - 1 - MARGIN))
        listed = np.asarray(inside(table))
        false = listed.copy()
        false[row] = False
        return cls(scene, table, true, row,
                   np.asarray(inside(truth) & ~truth['sat']), listed, false)

    def errors(self):
        """Return the errors (n_true, 2) of positions, NaN without match."""
        out = np.full((len(self.scene.truth), 2), np.nan)
        for k, c in enumerate('xy'):
            out[self.true, k] = (self.table[c][self.row]
                                 - self.scene.truth[c][self.true])
        return out

    def bins(self):
        """Yield the magnitude, true stars and list's stars of each bin."""
        true = np.asarray(self.scene.truth['mag'])
        magnitude = self.scene.magnitude(self.table['flux'])
        for low in EDGES:
            yield (low, self.counted & (true >= low) & (true < low + 1),
                   self.listed & (magnitude >= low) & (magnitude < low + 1))


def median(values):
    """Return the median of the finite values, NaN if there are none."""
    values = values[np.isfinite(values)]
    return np.median(values) if values.size else np.nan


def scatter(values):
    """Return 1.4826 times the median absolute value."""
    return 1.4826 * median(np.abs(values))


def print_score(name, score):
    """Print one row for each magnitude."""
    scene, table = score.scene, score.table
    errors = score.errors()
    row = np.full(len(scene.truth), -1)
    row[score.true] = score.row
    print(f'\n{name}: {len(table)} stars\n mag     n   RMS/CRLB  median px  '
          'complete  false   flux bias  pull')
    for low, here, there in score.bins():
        found = here & (row >= 0)
        at = row[found]
        error = errors[found]
        pull = np.nan
        if 'x_err' in table.colnames:
            pull = scatter(error / np.column_stack(
                [table[f'{c}_err'][at] for c in 'xy']))
        ratio = table['flux'][at] / scene.truth['flux'][found]
        bias = -2.5 * np.log10(np.median(ratio)) if len(at) else np.nan
        print(f'{low}-{low + 1} {here.sum():5d}  '
              f'{scatter(error / scene.bound[found]):7.2f}  '
              f'{median(np.hypot(*error.T)):9.4f}  '
              f'{found.sum() / max(here.sum(), 1):8.1%}  '
              f'{(score.false & there).sum() / max(there.sum(), 1):6.1%}  '
              f'{bias:+8.4f}  {pull:6.2f}')


def print_duel(name, ours, other):
    """Print median errors on each one's list and on stars of both."""
    error, theirs = (np.hypot(*s.errors().T) for s in (ours, other))
    both = np.isfinite(error) & np.isfinite(theirs)
    print(f'\nmedian position error [pix], ours and {name}\n mag     ours'
          '   peer  ratio | stars of both    ours   peer  ratio')
    worse = []
    for low, here, _ in ours.bins():
        a, b = median(error[here]), median(theirs[here])
        at = here & both
        c, d = median(error[at]), median(theirs[at])
        print(f'{low}-{low + 1} {a:7.4f} {b:7.4f} {b / a:5.2f}  | '
              f'{at.sum():8d}       {c:7.4f} {d:7.4f} {d / c:5.2f}')
        # Where the other has no star there is nothing to be better than.
        if a >= b or c >= d:
            worse.append(int(low))
    print('better at every magnitude' if not worse
          else f'not better at {worse}')


def completeness_curve(scene, table, strength, low=24):
    """Return (cut, complete, false) of a list cut at growing strength."""
    table, strength = centre(scene, table), np.asarray(strength, float)
    magnitude = scene.magnitude(table['flux'])
    near = (magnitude >= low - 1) & (magnitude < low + 2)
    strength = np.nan_to_num(strength)
    levels = np.percentile(strength[near], np.arange(0, 100, 4))
    out = []
    for cut in np.concatenate([[-np.inf], levels]):
        score = Score.of(scene, table[strength > cut], centred=True)
        here, there = next(b[1:] for b in score.bins() if b[0] == low)
        out.append((cut, here[score.true].sum() / here.sum(),
                    (score.false & there).sum() / max(there.sum(), 1)))
    return np.array(out)


def complete_at(curve, rate):
    """Return the largest completeness with no more than a false rate."""
    fine = curve[curve[:, 2] <= rate]
    return fine[:, 1].max() if len(fine) else np.nan
