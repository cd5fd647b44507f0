"""How an exposure compares with the others: of its field, of its camera."""
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull, Delaunay, QhullError
from scipy.special import chdtri

from photutils_mgauss.cli import tools
from photutils_mgauss.utils.star_columns import column_values

# Figures of merit by name, and whether a large one is bad (1) or a small one
# (-1); those of the catalogue, and those of the field.
CATALOGUE = {'FWHM [pix]': 1, 'ellipticity': 1, 'stars': -1,
             'without flags': -1, 'reduced chi2': 1,
             'x_err of bright stars [pix]': 1}
FIELD = {'completeness': -1, 'pulls of references': 1,
         'references rejected': 1, 'systematic error': 1}
# What is so many times as far from the median as the others usually are, and
# so much of the median or, of shares, so much, is bad.
_FAR, _PART, _SHARE = 5.0, 0.2, 0.1
# So few exposures, and so few stars, are too few to say what is usual.
_FEW, _FEW_STARS = 4, 10
# The standard deviation of normal numbers in their median deviations.
_NORMAL = 1.4826
_SHARES = ('completeness', 'without flags', 'references rejected')


class FieldOfExposures:
    """
    What ``mgauss motions`` left of a field.

    Parameters
    ----------
    folder : path-like
        Its output folder.

    Raises
    ------
    OSError, ValueError
        If the folder has no tables of motions.
    """

    def __init__(self, folder):
        from photutils_mgauss.files.tables import read_table
        self.folder = Path(folder)
        (self.stars, self.record), (self.residuals, _), (self.alignment, _) = (
            read_table(self._file(name))
            for name in ('motions', 'residuals', 'alignment'))

    def _file(self, name):
        found = [self.folder / f'{name}{suffix}'
                 for suffix in ('.ecsv', '.fits')]
        for path in found:
            if path.is_file():
                return path
        msg = (f'{self.folder}: must have the tables of mgauss motions, got '
               f'no {found[0].name}')
        raise FileNotFoundError(msg)

    @property
    def names(self):
        """The names of the exposures."""
        return list(self.record.get('pieces', {}))

    def rows_of(self, name):
        """Return the residuals of an exposure, and whose they are."""
        epoch, chip = self.record['pieces'][name]
        own = np.asarray(self.residuals['epoch']) == epoch
        if 'chip' in self.residuals.colnames:
            chips = np.ma.filled(self.residuals['chip'], '').astype(str)
            own &= (chips == '') | (chips == str(chip))
        return own

    def references(self):
        """Return which residuals (n,) are those of references, or of all."""
        stars = self.stars
        if 'reference' not in stars.colnames:
            return np.ones(len(self.residuals), bool)
        known = np.ma.filled(stars['reference'], '').astype(str) != ''
        ids = np.asarray(stars['id'])[known]
        found = np.isin(np.asarray(self.residuals['id']), ids)
        return found if found.any() else np.ones_like(found)

    def figures(self):
        """Return the figures of merit of each exposure, by its name."""
        if not self.names:
            return {}
        references, inside = self.references(), _Expected(self.residuals)
        return {name: self._figures(name, references, inside)
                for name in self.names}

    def _figures(self, name, references, inside):
        own, epoch = self.rows_of(name), self.record['pieces'][name][0]
        row = {'completeness': inside.completeness(own)}
        rows = self.residuals[own & references]
        chi2 = column_values(rows, 'chi2')
        chi2 = chi2[np.isfinite(chi2)]
        if chi2.size >= _FEW_STARS:
            # Some references may be others than they seem.
            row['pulls of references'] = float(np.sqrt(
                np.median(chi2) / chdtri(2, 0.5)))
        if len(rows):
            row['references rejected'] = float(np.mean(
                ~np.asarray(rows['used'], bool)))
        systematic = self.alignment['systematic'][epoch]
        row['systematic error'] = float(np.sqrt(np.mean(np.square(
            getattr(systematic, 'value', systematic)))))
        return {key: value for key, value in row.items()
                if np.isfinite(value)}


class _Expected:
    """Which stars of a field an exposure should show."""

    def __init__(self, residuals):
        ids, self._star = np.unique(np.asarray(residuals['id']),
                                    return_inverse=True)
        self._count = np.bincount(self._star, minlength=len(ids))
        self._epochs = len(np.unique(np.asarray(residuals['epoch'])))
        self._places = self._mean(_on_a_plane(residuals))

    def _mean(self, places):
        return np.stack([np.bincount(self._star, weights=axis)
                         for axis in places], axis=1) / self._count[:, None]

    def completeness(self, own):
        """
        Return the share that an exposure shows of what others show.

        It is that of the stars that two other exposures show, or the only
        other one, between those that this one shows.

        Parameters
        ----------
        own : (n,) bool `~numpy.ndarray`
            The rows of the exposure.
        """
        here = np.bincount(self._star[own], minlength=len(self._count))
        placed = np.isfinite(self._places).all(axis=1)
        wanted = placed & (self._count - here >= min(2, self._epochs - 1))
        found = placed & (here > 0)
        if self._epochs < 2 or found.sum() < _FEW_STARS:
            return np.nan
        try:
            edge = ConvexHull(self._places[found])
        except QhullError:
            return np.nan
        # The outermost stars are there by definition, so that they say
        # nothing.
        edge = self._places[found][edge.vertices]
        wanted[wanted] = Delaunay(edge).find_simplex(
            self._places[wanted]) >= 0
        wanted &= ~np.isin(self._places, edge).all(axis=1)
        return float(found[wanted].mean()) if wanted.any() else np.nan


def _on_a_plane(table):
    """Return places (2, n) near each other on a plane, of any scale."""
    if 'ra' not in table.colnames:
        return np.array([column_values(table, name) for name in 'xy'])
    from photutils_mgauss.sky.tangent_plane import (
        TangentPlane,
        directions,
        unit_vectors,
    )
    vectors = unit_vectors(*(column_values(table, name)
                             for name in ('ra', 'dec')))
    middle = directions(np.nanmean(vectors, axis=1))
    return TangentPlane(*map(float, middle)).project(vectors)


def judge(rows, groups):
    """
    Return what is bad about each exposure, in words, and how bad.

    Parameters
    ----------
    rows : list of dict
        The figures of merit of each, by name.
    groups : list
        What each should be like: those with an equal one, such as a camera.

    Returns
    -------
    list of (str, float)
        A sentence, or empty, and the largest deviation in usual ones.
    """
    found = [[] for _ in rows]
    for group in dict.fromkeys(groups):
        members = [k for k, one in enumerate(groups) if one == group]
        for name, sign in (CATALOGUE | FIELD).items():
            values = np.array([rows[k].get(name, np.nan) for k in members],
                              float)
            for k, far, usual in zip(members, *_deviations(values, name),
                                     strict=True):
                if sign * far > _FAR:
                    words = (f'{name} is {rows[k][name]:.3g}, usually '
                             f'{usual:.3g}')
                    found[k].append((sign * far, words))
    return [('; '.join(words for _, words in sorted(one, reverse=True)),
             max((far for far, _ in one), default=0.0)) for one in found]


def _deviations(values, name):
    """Return how far values are from usual, and what is usual, each (n,)."""
    good = np.isfinite(values)
    if good.sum() < _FEW:
        return np.zeros(len(values)), values
    middle = np.median(values[good])
    spread = _NORMAL * np.median(np.abs(values[good] - middle))
    least = _SHARE if name in _SHARES else _PART * abs(middle)
    scale = max(spread, least / _FAR, 1e-12)
    return (np.nan_to_num((values - middle) / scale),
            np.full(len(values), middle))


def name_of(path):
    """Return the name by which a field knows the exposure of a catalogue."""
    return tools.stem(path)
