r"""
Stars found in the evidence of all images together.

Each image is filtered with its PSF, less the mean so that a smooth sky drops
out, weighted by the inverse variances of its pixels:

.. math:: n_k = \sum w_k p_k d_k, \quad m_k = \sum w_k p_k^2 .

For a star of the motion v and parallax :math:`\varpi` the signal-to-noise
ratio of all images is

.. math:: T_v(x) = \sum_k c_k n_k(x + v t_k + \varpi p_k) \Big/
    \sqrt{\sum_k c_k^2 m_k},

with the scale :math:`c_k` of each image, from the brightest stars. Maps are
put on one grid once, and shifted for each motion and parallax, with the
parallax factors :math:`p_k` of the middle of the field: time goes with pixels
times motions. The largest :math:`T_v` of all motions is compared with a
threshold for a rate of false alarms in pure noise.
"""
from dataclasses import dataclass
from functools import partial

import astropy.units as u
import numpy as np
from astropy.stats import mad_std
from astropy.table import QTable
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import convolve1d, map_coordinates, maximum_filter
from scipy.signal import oaconvolve
from scipy.spatial import cKDTree
from scipy.special import ndtri

from photutils_mgauss.photometry.many_images import views_of
from photutils_mgauss.pixel_motions.solve import fwhm
from photutils_mgauss.psf.renderer import MixtureRenderer
from photutils_mgauss.sky.tangent_plane import directions
from photutils_mgauss.sky.wcs import pixel_jacobian, pixel_to_vectors
from photutils_mgauss.utils.parallel import map_parallel

# The filter's half width, in units of the PSF's FWHM, and between which nodes
# of the grid places are interpolated [pix].
_HALF = 2.5
_NODES = 32

# Motions are so close that at the ends of the time a star is at most so far
# from the nearest [pix].
_STEP = 0.35

# Stars of at least this are found and subtracted first, and this part of the
# light of a subtracted star counts as noise.
BRIGHT = 30.0
_RESIDUAL = 0.03

# The grid may not grow beyond this many times the largest image.
_GROWTH = 4


@dataclass(frozen=True, eq=False)
class Grid:
    """
    Points of the plane, a pixel apart, that cover all images.

    ``origin`` (2,) and ``matrix`` (2, 2) make places of the plane [mas] from
    columns and rows; ``shape`` is (rows, columns).
    """

    origin: np.ndarray
    matrix: np.ndarray
    shape: tuple

    @classmethod
    def of(cls, campaign):
        """Return the grid along the axes of the first image."""
        ny, nx = campaign.shapes[0]
        middle = np.array([[(nx - 1) / 2], [(ny - 1) / 2]])
        matrix = pixel_jacobian(campaign.frames[0], campaign.plane,
                                *middle)[..., 0]
        corners = np.concatenate([_corners(campaign, k) for k in range(
            campaign.n_images)], axis=1)
        inside = np.linalg.inv(matrix) @ corners
        low, high = inside.min(axis=1) - 1, inside.max(axis=1) + 1
        shape = tuple(int(n) for n in np.ceil(high - low)[::-1] + 1)
        largest = max(np.prod(shape) for shape in campaign.shapes)
        if np.prod(shape) > _GROWTH * largest:
            msg = ('images must lie on each other to be searched together, '
                   f'got fields that need {shape[1]} x {shape[0]} pixels')
            raise ValueError(msg)
        return cls(matrix @ low, matrix, shape)

    def places(self, columns, rows):
        """Return places of the plane (2, n)."""
        return self.origin[:, None] + self.matrix @ np.stack([columns, rows])


def _corners(campaign, k):
    """Return the corners (2, 4) of image k in the plane."""
    ny, nx = campaign.shapes[k]
    x, y = np.array([0, nx - 1, 0, nx - 1]), np.array([0, 0, ny - 1, ny - 1])
    return campaign.plane.project(pixel_to_vectors(campaign.frames[k], x, y,
                                                   bounded=False))


def candidates(campaign, largest, known, executor, *, threshold=None,
               false_alarm=None):
    """
    Return the table of places where all images together show a star.

    Parameters
    ----------
    campaign : `~photutils_mgauss.pixel_motions.campaign.Campaign`
    largest : (float or None, float)
        The largest motion [mas / yr], None for 0.1 pixels an epoch, and the
        largest parallax [mas].
    known : list of (3, n) `~numpy.ndarray`
        x, y and flux of stars of each image that are subtracted first.
    executor : `~concurrent.futures.Executor` or None
    threshold, false_alarm : float, optional
        The least signal-to-noise ratio, or the rate of false alarms for each
        independent place that one is made from.
    """
    grid = Grid.of(campaign)
    trials = trial_grid(campaign, grid, *largest)
    best, which = _search(campaign, grid, trials, known, executor)
    width = max(fwhm(epoch) for epoch in campaign.epochs)
    if threshold is None:
        threshold = -ndtri(false_alarm / (len(trials) * width**2))
    rows, columns = _peaks(best, threshold, width)
    places = grid.places(columns, rows)
    ra, dec = directions(campaign.plane.deproject(places))
    moving = trials[which[rows, columns]]
    local = np.einsum('ijn,nj->in', campaign.plane.local_inverse(places),
                      moving[:, :2])
    return QTable({'ra': ra * u.deg, 'dec': dec * u.deg,
                   'pmra': local[0] * u.mas / u.yr,
                   'pmdec': local[1] * u.mas / u.yr,
                   'parallax': moving[:, 2] * u.mas,
                   'evidence': best[rows, columns].astype(float)})


def trial_grid(campaign, grid, max_motion, max_parallax):
    """Return motions [mas / yr] and parallaxes [mas] that are tried (m, 3)."""
    motions = _motions(campaign, grid, max_motion)
    n = int(np.ceil(max_parallax / _pixel(grid) / (2 * _STEP)))
    parallaxes = np.linspace(0, max_parallax, n + 1)
    return np.column_stack([np.repeat(motions, n + 1, axis=0),
                            np.tile(parallaxes, len(motions))])


def _pixel(grid):
    """Return the size of a pixel [mas]."""
    return np.sqrt(abs(np.linalg.det(grid.matrix)))


def _motions(campaign, grid, max_motion):
    """Return the motions (m, 2) that are tried [mas / yr]."""
    baseline = np.ptp(campaign.years)
    if baseline == 0:
        return np.zeros((1, 2))
    pixel = _pixel(grid)
    if max_motion is None:
        epochs = len(np.unique(np.round(campaign.years, 2)))
        max_motion = 0.1 * pixel * max(epochs - 1, 1) / baseline
    reach = max_motion * baseline / 2 / pixel
    n = int(np.ceil(reach / (2 * _STEP)))
    axis = np.linspace(-1, 1, 2 * n + 1) * max_motion if n else np.zeros(1)
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def _search(campaign, grid, trials, known, executor):
    """Return the largest T of all trials on the grid, and which it is."""
    *maps, edges = zip(*(_on_grid(campaign, grid, k, light) for k, light in
                         enumerate(known)), strict=True)
    maps = list(zip(*maps, strict=True))
    scales = _scales(maps)
    weight = sum(c**2 * m for c, (_, m) in zip(scales, maps, strict=True))
    evidence = [np.float32(c) * n for c, (n, _) in zip(scales, maps,
                                                       strict=True)]
    noise = np.sqrt(np.maximum(weight, 1e-30))
    best = np.full(grid.shape, -np.inf, np.float32)
    which = np.zeros(grid.shape, np.int32)
    shifts = _shifts(campaign, grid, trials)
    # Beside an edge a star of some motions is seen and of others is not.
    margin = 2 + max(np.abs(shift).max() for shift in shifts)
    whole = np.logical_and.reduce([edge > margin for edge in edges])
    summed = map_parallel(partial(_along, evidence, shifts),
                          range(len(trials)), executor=executor)
    for v, total in enumerate(summed):
        score = np.where((weight > 0) & whole, total / noise, 0)
        larger = score > best
        best[larger], which[larger] = score[larger], v
    covered = weight > 0
    if covered.any():
        # Errors that are too small, and confusion, count as noise.
        best /= max(1.0, float(mad_std(np.where(covered, total / noise,
                                                0)[covered])))
    return best, which


def _shifts(campaign, grid, trials):
    """Return how far trials move stars in each image, (m, 2) [pix]."""
    turn = np.linalg.inv(grid.matrix)
    middle = np.array(grid.shape[::-1], float)[:, None] / 2
    used = trials[:, :2 + campaign.parallax]
    return [(turn @ factor[:, 2:2 + used.shape[1], 0] @ used.T).T
            for factor in campaign.factors(grid.places(*middle))]


def _along(evidence, shifts, v):
    """Return the sum of maps along trial v."""
    return sum(_shifted(one, *shift[v]) for one, shift in zip(
        evidence, shifts, strict=True))


def _shifted(values, dx, dy):
    """Return the map seen at places shifted by dx and dy, by cubics."""
    for axis, d in ((1, dx), (0, dy)):
        whole = int(np.floor(d))
        if whole:
            values = _moved(values, whole, axis)
        t = d - whole
        if t > 1e-6:
            taps = [t * (-0.5 + t * (1 - 0.5 * t)),
                    1 + t * t * (-2.5 + 1.5 * t),
                    t * (0.5 + t * (2 - 1.5 * t)), t * t * (-0.5 + 0.5 * t)]
            values = convolve1d(values, np.array(taps)[::-1], axis=axis,
                                mode='constant', origin=-1)
    return values


def _moved(values, n, axis):
    """Return values n places further along an axis, 0 beyond the end."""
    out = np.zeros_like(values)
    keep, take = [slice(None)] * 2, [slice(None)] * 2
    take[axis] = slice(max(n, 0), values.shape[axis] + min(n, 0))
    keep[axis] = slice(max(-n, 0), values.shape[axis] - max(n, 0))
    out[tuple(keep)] = values[tuple(take)]
    return out


def _on_grid(campaign, grid, k, light):
    """Return n, m and the distance to the edge of image k on the grid."""
    x, y = _pixels_on(campaign, grid, k)
    depth = np.minimum(
        np.minimum(x + 0.5, campaign.shapes[k][1] - 0.5 - x),
        np.minimum(y + 0.5, campaign.shapes[k][0] - 0.5 - y))
    inside, out = depth > 0, []
    for image, order in zip(_filtered(campaign, k, light), (3, 1),
                            strict=True):
        got = map_coordinates(image, [y, x], order=order, mode='nearest',
                              output=np.float32)
        out.append(np.where(inside, got, np.float32(0)))
    return out[0], np.maximum(out[1], 0), np.abs(depth)


def _pixels_on(campaign, grid, k):
    """Return the pixels of image k at all points of the grid."""
    rows, columns = (np.arange(0, n + _NODES, _NODES, dtype=float)
                     for n in grid.shape)
    mesh = np.meshgrid(columns, rows)
    place = grid.places(mesh[0].ravel(), mesh[1].ravel())
    view = views_of([campaign.frames[k]], campaign.plane,
                    np.ascontiguousarray(place.T)[:, None],
                    [np.eye(2)[:, :, None]], [campaign.epochs[k].velocity])
    found = view.pixels[:, 0, 0].T.reshape(2, len(rows), len(columns))
    if not np.isfinite(found).all():
        msg = (f'images must have a WCS that can be inverted over all '
               f'fields, got one that cannot in image {k}')
        raise ValueError(msg)
    degree = min(3, len(rows) - 1, len(columns) - 1)
    full = [np.arange(n, dtype=float) for n in grid.shape]
    return [RectBivariateSpline(rows, columns, one, kx=degree, ky=degree)(
        *full).astype(np.float32) for one in found]


def _filtered(campaign, k, light):
    """Return the sums n and m of image k, star light subtracted."""
    image = campaign.joint.images[k].whole()
    data, variance = image.data, np.square(image.error)
    good = np.isfinite(data) & (variance > 0) & np.isfinite(variance)
    if image.mask.size:
        good &= ~image.mask
    if light.shape[1]:
        model = MixtureRenderer(campaign.epochs[k].model).image(
            light, 1e-2, data.shape)
        data -= model
        variance = variance + (_RESIDUAL * model)**2
    level = np.median(data[good]) if good.any() else 0.0
    weight = np.where(good, 1 / np.where(good, variance, 1), 0)
    stamp = _filter(campaign.epochs[k])
    flipped = stamp[::-1, ::-1]
    n = oaconvolve(weight * np.where(good, data - level, 0), flipped,
                   mode='same')
    m = oaconvolve(weight, flipped**2, mode='same')
    return n.astype(np.float32), m.astype(np.float32)


def _filter(epoch):
    """Return the PSF at the middle of an image, less its mean."""
    half = int(np.ceil(_HALF * fwhm(epoch)))
    ny, nx = epoch.pixels.shape
    stamp = np.zeros((2 * half + 1, 2 * half + 1))
    x, y = np.rint((nx - 1) / 2), np.rint((ny - 1) / 2)
    MixtureRenderer(epoch.model).add(np.array([[x], [y], [1.0]]), 1e-6,
                                     x - half, y - half, stamp)
    return stamp - stamp.mean()


def _scales(maps):
    """Return the relative throughput of each image, of its brightest stars."""
    first = maps[0][0] / np.sqrt(np.maximum(maps[0][1], 1e-30))
    peak = ((first > BRIGHT) & (first == maximum_filter(first, 5))
            & (maps[0][1] > 0))
    flux = [n[peak] / np.maximum(m[peak], 1e-30) for n, m in maps]
    if peak.sum() < 3:
        return np.ones(len(maps))
    scales = np.array([np.median(one / flux[0]) for one in flux])
    return np.where(np.isfinite(scales) & (scales > 0), scales, 1.0)


def _peaks(best, threshold, width):
    """Return rows and columns of local maxima, the brightest of close ones."""
    rows, columns = np.nonzero((best > threshold)
                               & (best == maximum_filter(best, 3)))
    order = np.argsort(-best[rows, columns])
    rows, columns = rows[order], columns[order]
    keep = np.ones(len(rows), bool)
    if len(rows) > 1:
        near = cKDTree(np.column_stack([rows, columns])).query_pairs(
            width, output_type='ndarray')
        for a, b in near[np.lexsort(near.T[::-1])]:
            if keep[a]:
                keep[b] = False
    return rows[keep], columns[keep]
