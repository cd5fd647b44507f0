"""
Stars of several solutions, each star once.

Fields that overlap are solved one by one. The estimates of a star that two of
them have are independent, and each has a covariance with that of its frames
in it; their mean is that of least squares,

    C = (sum C_i^-1)^-1,    p = C sum C_i^-1 p_i.

Those of a reference are not independent, for each has its catalogue's values
in it: the most accurate one stands for all.
"""
import astropy.units as u
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from photutils_mgauss.motions.tables import GAIA, RELATIVE
from photutils_mgauss.utils.star_columns import column_values

_MAS = np.pi / 180 / 3600e3
# Stars farther apart are never one [mas], nor those farther apart than so
# many of their errors.
_FARTHEST, _SIGMAS = 1000.0, 5.0
# The variance of what a solution does not know.
_UNKNOWN = 1e12


def merge_stars(tables, references=None):
    """
    Merge the stars that are in several solutions.

    Parameters
    ----------
    tables : sequence of `~astropy.table.QTable`
        Those of `MotionSolution.stars`, or with the same columns.
    references : `~astropy.table.Table`, optional
        Objects of known motion of the solutions, with ``ra`` and ``dec``
        [deg].

    Returns
    -------
    list of `~astropy.table.QTable`
        For each table the rows that are left of it: a star of several tables
        is in the first that has it, with the mean of all, at the reference
        epoch that it has there. Column ``n_fields`` counts the solutions of
        a star, ``merge_chi2`` is the chi-square of their differences, of 4
        or, with parallaxes, 5 (n - 1) degrees of freedom; it is 0 for a star
        of one. Counts and chi-squares are summed, ``uwe``, ``ruwe`` and
        ``visibility_periods_used`` are the largest, flags are joined.

    Notes
    -----
    Stars without a full solution, or with motions relative to the mean of
    their field, are left as they are. One is another's if each is nearest to
    the other and their places agree within five errors.
    """
    stars = _Stars(tables)
    group = stars.groups()
    leader = np.zeros(group.max(initial=-1) + 1, dtype=int)
    order = np.arange(len(group))[::-1]
    leader[group[order]] = order  # the first of each group stays
    first = leader[group]
    values, covariance, chi2, count = stars.means(
        first, stars.counting(first, references))
    out, start = [], 0
    for table in tables:
        rows = np.arange(start, start + len(table))
        start += len(table)
        keep = rows[first[rows] == rows]
        left = table[keep - rows[0]] if len(table) else table.copy()
        left['n_fields'] = count[keep]
        left['merge_chi2'] = chi2[keep]
        several = count[keep] > 1
        if several.any():
            _set(left, several, values[keep], covariance[keep])
            _join(left, several, keep[several], first, tables)
        out.append(left)
    return out


class _Stars:
    """The stars of all tables, one after the other."""

    def __init__(self, tables):
        def column(name, unit):
            return np.concatenate([_numbers(table, name, unit)
                                   for table in tables])
        self.table = np.repeat(np.arange(len(tables)),
                               [len(table) for table in tables])
        self.ra, self.dec = column('ra', u.deg), column('dec', u.deg)
        self.year = column('ref_epoch', None)
        self.parallax = column('parallax', u.mas)
        motion = u.mas / u.yr
        self.motion = np.stack([column('pmra', motion),
                                column('pmdec', motion)], 1)
        units = (u.mas, u.mas, u.mas, motion, motion)
        errors = [column(f'{name}_error', unit)
                  for name, unit in zip(GAIA, units, strict=True)]
        self.covariance = np.empty((len(self.ra), 5, 5))
        for i, a in enumerate(GAIA):
            for j, b in enumerate(GAIA):
                name = f'{GAIA[min(i, j)]}_{GAIA[max(i, j)]}_corr'
                rho = 1.0 if a == b else np.nan_to_num(column(name, None))
                self.covariance[:, i, j] = rho * errors[i] * errors[j]
        unknown = ~np.isfinite(errors[2])
        self.covariance[unknown, 2, :] = self.covariance[unknown, :, 2] = 0
        self.covariance[unknown, 2, 2] = _UNKNOWN
        self.parallax[unknown] = 0
        # The mean of a field's own stars is no frame that others have.
        relative = column('flags', None).astype(int) & RELATIVE
        self.usable = (np.isfinite(self.covariance).all(axis=(1, 2))
                       & np.isfinite(self.ra + self.dec + self.year
                                     + self.motion.sum(axis=1))
                       & (relative == 0))

    def at(self, years):
        """Return steps (n, 2) [mas] and covariances (n, 5, 5) at epochs."""
        dt = years - self.year
        change = np.tile(np.eye(5), (len(dt), 1, 1))
        change[:, 0, 3] = change[:, 1, 4] = dt
        return (self.motion * dt[:, None],
                change @ self.covariance @ np.swapaxes(change, 1, 2))

    def groups(self):
        """Return the number of the group (n,) of stars that are one."""
        n = len(self.ra)
        numbers = np.flatnonzero(self.usable)
        pairs = np.zeros((0, 2), int)
        if numbers.size:
            step, covariance = self.at(np.full(
                n, self.year[numbers].mean()))
            points = _directions(self.ra, self.dec, step)
            of_table = [numbers[self.table[numbers] == k]
                        for k in range(self.table.max() + 1)]
            pairs = np.concatenate([pairs, *(
                _same(points, covariance, one, other)
                for k, one in enumerate(of_table)
                for other in of_table[k + 1:])])
        _, group = connected_components(coo_matrix(
            (np.ones(len(pairs)), tuple(pairs.T)), shape=(n, n)),
            directed=False)
        return self._once(group)

    def _once(self, group):
        """Leave one star of each table in a group; others stay alone."""
        _, place = np.unique(np.stack([group, self.table]), axis=1,
                             return_index=True)
        again = np.setdiff1d(np.arange(len(group)), place)
        group = group.copy()
        group[again] = group.max(initial=-1) + 1 + np.arange(len(again))
        return np.unique(group, return_inverse=True)[1].ravel()

    def counting(self, first, references):
        """Return the stars (n,) that count in the mean of their group."""
        good = self.usable.copy()
        if references is None or not len(references):
            return good
        nothing = np.zeros((len(references), 2))
        known = KDTree(_directions(_numbers(references, 'ra', u.deg),
                                   _numbers(references, 'dec', u.deg),
                                   nothing))
        rows = np.flatnonzero(good)
        away, _ = known.query(_directions(
            self.ra, self.dec, np.zeros((len(self.ra), 2)))[rows])
        rows = rows[away < _FARTHEST * _MAS]
        worth = self.covariance[rows, 3, 3] + self.covariance[rows, 4, 4]
        order = np.lexsort([worth, first[rows]])
        _, best = np.unique(first[rows][order], return_index=True)
        good[rows] = False
        good[rows[order[best]]] = True
        return good

    def means(self, first, good):
        """
        Return values (n, 5), covariances, chi2 and count of each group.

        ``good`` (n,) are those that count.
        """
        step, covariance = self.at(self.year[first])
        cosine = np.cos(np.radians(self.dec[first]))
        away = (self.ra - self.ra[first] + 180) % 360 - 180
        values = np.column_stack([
            away * cosine * 3600e3 + step[:, 0],
            (self.dec - self.dec[first]) * 3600e3 + step[:, 1],
            self.parallax, self.motion])
        n = len(first)
        weight = np.linalg.inv(covariance[good])
        total, right = np.zeros((n, 5, 5)), np.zeros((n, 5))
        square, count = np.zeros(n), np.ones(n, int)
        np.add.at(total, first[good], weight)
        product = np.einsum('kij,kj->ki', weight, values[good])
        np.add.at(right, first[good], product)
        np.add.at(square, first[good],
                  np.einsum('ki,ki->k', product, values[good]))
        size = np.bincount(first, minlength=n)
        count[first] = size[first]
        several = np.flatnonzero(size > 1)
        mean, matrix = np.full((n, 5), np.nan), np.full((n, 5, 5), np.nan)
        matrix[several] = np.linalg.inv(total[several])
        mean[several] = np.einsum('kij,kj->ki', matrix[several],
                                  right[several])
        chi2 = np.zeros(n)
        chi2[several] = square[several] - np.einsum(
            'ki,ki->k', right[several], mean[several])
        return mean, matrix, np.maximum(chi2, 0), count


def _numbers(table, name, unit):
    if name not in table.colnames:
        return np.full(len(table), np.nan)
    values = column_values(table, name, unit)
    return np.array(np.ma.filled(np.ma.asarray(values, float), np.nan))


def _directions(ra, dec, step):
    """Return unit vectors (n, 3) of places that have moved [mas]."""
    with np.errstate(invalid='ignore'):
        lat = np.radians(dec) + step[:, 1] * _MAS
        lon = np.radians(ra) + step[:, 0] * _MAS / np.cos(lat)
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon),
                     np.sin(lat)], axis=1)


def _same(points, covariance, one, other):
    """Return the pairs (m, 2) of stars of two tables that are one."""
    if not (one.size and other.size):
        return np.zeros((0, 2), int)
    away, to_other = KDTree(points[other]).query(
        points[one], distance_upper_bound=_FARTHEST * _MAS)
    _, to_one = KDTree(points[one]).query(points[other])
    near = np.flatnonzero(np.isfinite(away))
    near = near[to_one[to_other[near]] == near]
    a, b = one[near], other[to_other[near]]
    sigma2 = sum(np.trace(covariance[k][:, :2, :2], axis1=1, axis2=2)
                 for k in (a, b))
    agree = (away[near] / _MAS) ** 2 <= _SIGMAS**2 * sigma2
    return np.stack([a[agree], b[agree]], axis=1)


def _set(table, rows, values, covariance):
    """Put the means of some rows into a table."""
    values, covariance = values[rows], covariance[rows]
    error = np.sqrt(np.einsum('kii->ki', covariance))
    known = error[:, 2] < np.sqrt(_UNKNOWN) / 100
    steps = dict(zip(GAIA, values.T, strict=True))
    dec = table['dec'].to_value(u.deg)[rows]
    right = table['ra'].to_value(u.deg)[rows] + steps['ra'] / 3600e3 / np.cos(
        np.radians(dec))
    new = {'ra': right % 360 * u.deg,
           'dec': (dec + steps['dec'] / 3600e3) * u.deg,
           'parallax': np.where(known, steps['parallax'], np.nan) * u.mas,
           'pmra': steps['pmra'] * u.mas / u.yr,
           'pmdec': steps['pmdec'] * u.mas / u.yr}
    for k, name in enumerate(GAIA):
        unit = u.mas / u.yr if k > 2 else u.mas
        sigma = np.where(known, error[:, k], np.nan) if k == 2 else error[:, k]
        new[f'{name}_error'] = sigma * unit
        for j in range(k + 1, 5):
            rho = covariance[:, k, j] / (error[:, k] * error[:, j])
            new[f'{name}_{GAIA[j]}_corr'] = np.where(
                known, rho, np.nan) if 2 in (k, j) else rho
    for name, some in new.items():
        if name in table.colnames:
            table[name][rows] = some


def _join(table, rows, leaders, first, tables):
    """Join what is counted, of the rows that have become one."""
    which = np.concatenate([np.full(len(one), k)
                            for k, one in enumerate(tables)])
    inside = np.concatenate([np.arange(len(one)) for one in tables])
    places = np.flatnonzero(rows)
    order = np.argsort(first, kind='stable')
    starts = np.searchsorted(first[order], leaders)
    ends = np.searchsorted(first[order], leaders, 'right')
    for name, join in (('n_obs', np.sum), ('n_good_obs', np.sum),
                       ('chi2', np.sum), ('dof', np.sum), ('uwe', np.max),
                       ('ruwe', np.max),
                       ('visibility_periods_used', np.max),
                       ('flags', np.bitwise_or.reduce)):
        if name not in table.colnames:
            continue
        for place, start, end in zip(places, starts, ends, strict=True):
            table[name][place] = join([tables[which[m]][name][inside[m]]
                                       for m in order[start:end]])
