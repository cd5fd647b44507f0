"""Which stars of a crowded image its PSF can be measured from."""
from dataclasses import dataclass, replace

import numpy as np
from astropy.table import QTable
from scipy.ndimage import maximum_filter
from scipy.spatial import KDTree

from photutils_mgauss.crowded.table import positions
from photutils_mgauss.field.selection import select_psf_stars
from photutils_mgauss.utils.flags import NOT_A_STAR, SATURATED
from photutils_mgauss.utils.star_columns import words_column

# How many stars the first, round PSF is made of, of how many pixels around
# them, and how few stars are too few for any [pix].
FIRST_STARS, FIRST_RADIUS, FEWEST = 60, 5, 5
# For what width stars are first looked for [pix]. All lengths follow the width
# of the PSF if that is larger.
_FIRST_FWHM = 3.0
# Stars with less than this share of the light in their pixels are blends.
_OWN_LIGHT = 0.5
# A star of the user's list is the brightest this near to its place [pix].
_SAME = 1.5
# Of the middle of a star no pixel may be missing [pix].
_CORE = 7


@dataclass(frozen=True)
class Rules:
    """
    What a star has to be, and how many are wanted.

    ``radius`` is that of its stamp [pix], ``min_snr`` the least ratio of its
    flux to the error of it, ``given`` None or the places (n, 2) of the only
    stars that count. ``scale`` is by how much the PSF is wider than a narrow
    one; the radius follows it unless it ``is_fixed``.
    """

    radius: float = 15
    max_stars: int = 300
    min_snr: float = 50
    given: np.ndarray | None = None
    is_fixed: bool = False
    scale: float = 1.0

    def widened(self, scale):
        """Return the rules for a PSF that is wider by a factor."""
        radius = self.radius if self.is_fixed else (
            self.radius * scale / self.scale)
        return replace(self, radius=radius, scale=scale)

    @property
    def first_radius(self):
        """The radius of the stamps of the first PSF [pix]."""
        return self.scale * FIRST_RADIUS


def first_stars(data, variance, rules):
    """
    Find the stars the first PSF is made of, the least blended bright ones.

    Parameters
    ----------
    data, variance : (ny, nx) `~numpy.ndarray`
        The variance is 0 where a pixel is bad.
    rules : Rules

    Returns
    -------
    `~astropy.table.QTable`
        As of `select_psf_stars`, with the column ``merit``: how small the
        light of others and the noise are beside that of the star.
    """
    good = variance > 0
    found = select_psf_stars(
        np.where(good, data - np.percentile(data[good], 20), np.nan),
        error=np.sqrt(variance), radius=rules.first_radius, isolation=0,
        # Its aperture is a small part of a wide star.
        min_snr=rules.min_snr / rules.scale, fwhm=rules.scale * _FIRST_FWHM)
    x, y, flux = (np.asarray(found[name]) for name in ('x', 'y', 'flux'))
    usable = found['selected'] & _is_given(x, y, flux, rules)
    radius = rules.first_radius
    places = np.column_stack([x, y])
    tree = KDTree(places)
    found['merit'] = 0.0
    for i in np.flatnonzero(usable):
        near = np.array(tree.query_ball_point(places[i], 2 * radius))
        far = ((places[near] - places[i])**2).sum(axis=1)
        light = flux[near] * np.exp(-2 * far / radius**2)
        found['merit'][i] = flux[i] / (light.sum() - flux[i]
                                       + flux[i] / found['snr'][i])
    found['selected'] = usable
    return found


def judge(table, variance, psf_error, rules):
    """
    Tell which stars of a solved image are good for its PSF.

    A star is the better the less its light is uncertain, by noise and by
    what is left of its neighbours, which are known as well as the PSF.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        The stars, as of `CrowdedMixturePhotometry`, with their distance
        ``margin`` to the border of what was solved [pix].
    variance : (ny, nx) `~numpy.ndarray`
        Of the image, 0 where a pixel is bad.
    psf_error : float
        The relative error of the PSF.
    rules : Rules

    Returns
    -------
    `~astropy.table.QTable`
        The bright stars, or those of the user's list that were found: their
        ``row`` in the table, ``x``, ``y``, ``flux``, ``snr``, ``crowding``,
        whether they are ``selected``, and the ``reason`` why not.
    """
    x, y, flux = positions(table)
    own_light = np.asarray(table['crowding'], float)
    with np.errstate(all='ignore'):
        snr = flux / np.asarray(table['flux_err'], float)
        doubt = np.hypot(1 / snr, psf_error * (1 / own_light - 1))
        # Errors grow with chi2, and that with what the PSF lacks as yet.
        seen = snr * np.sqrt(np.fmax(table['reduced_chi2'], 1))
    flags = np.asarray(table['flags'])
    masked = _without_core(x, y, variance, rules.scale)
    reason = np.full(len(table), '', dtype='U9')
    for name, applies in (
            ('edge', np.asarray(table['margin']) < rules.radius),
            ('masked', masked | (flags & SATURATED > 0)),
            ('faint', ~(seen >= rules.min_snr)),
            ('extended', flags & NOT_A_STAR > 0),
            ('blended', ~(own_light > _OWN_LIGHT))):
        reason[(reason == '') & applies] = name
    good = np.flatnonzero((reason == '')
                          & _is_given(x, y, flux, rules))
    reason[good] = 'surplus'
    best = _even_choice(x[good], y[good], doubt[good], variance.shape,
                        rules.max_stars)
    reason[good[best]] = ''
    return _candidates(table, seen, reason, rules)


def _candidates(table, snr, reason, rules):
    x, y, flux = positions(table)
    wanted = (snr >= rules.min_snr if rules.given is None
              else _is_given(x, y, flux, rules))
    row = np.flatnonzero(wanted)
    return QTable({
        'row': row, 'x': x[row], 'y': y[row], 'flux': flux[row],
        'snr': snr[row], 'crowding': np.asarray(table['crowding'])[row],
        'selected': reason[row] == '',
        'reason': words_column(reason[row])})


def _is_given(x, y, flux, rules):
    """Return which stars are meant by places (n, 2); all if there are none."""
    if rules.given is None:
        return np.ones(len(x), bool)
    meant = np.zeros(len(x), bool)
    if len(x):
        for near in KDTree(np.column_stack([x, y])).query_ball_point(
                rules.given, rules.scale * _SAME):
            if near:
                meant[near[np.argmax(flux[near])]] = True
    return meant


def _without_core(x, y, variance, scale):
    """Return which stars have bad pixels in their cores."""
    row, column = (np.clip(np.rint(v), 0, n - 1).astype(int)
                   for v, n in zip((y, x), variance.shape, strict=True))
    core = 2 * round(scale * (_CORE // 2)) + 1
    return maximum_filter(variance <= 0, core)[row, column]


def _even_choice(x, y, doubt, shape, most):
    """Return the best stars (n,), those of each cell of the image in turn."""
    n = max(1, int(np.sqrt(most / 4)))
    ny, nx = shape
    cell = (np.clip(x / nx * n, 0, n - 1).astype(int)
            + n * np.clip(y / ny * n, 0, n - 1).astype(int))
    order = np.lexsort([doubt, cell])
    first = np.searchsorted(cell[order], np.arange(n * n))
    rank = np.empty(len(x), int)
    rank[order] = np.arange(len(x)) - first[cell[order]]
    return np.lexsort([doubt, rank])[:most]
