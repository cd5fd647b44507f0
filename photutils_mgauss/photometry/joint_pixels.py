r"""
Stars fitted to the pixels of many images together: arrays in, arrays out.

A star has p parameters v that say where it is, in image k at the pixel
:math:`x_k + J_k (v - v_0)`, one flux in each image (or for several images in
common), and a level of the sky in each image. Fluxes and skies enter
linearly. For given places they are solved for exactly, so that only v is
searched, and chi2 as a function of v alone has the gradient and matrix

.. math::

    g = \sum_k J_k^T \gamma_k, \quad
    S = \sum_k J_k^T W_k J_k - \sum_c C_c D_c^{-1} C_c^T ,

with the products :math:`W_k` of the star's derivatives in image k, the
:math:`D_c` of the images that share the flux c, and :math:`C_c` of both. All
come from `~photutils_mgauss.kernels.group_moments`, in which the sky has been
eliminated. Groups of m neighbours are fitted together: v is that of all.

Arrays have the g groups first: (g, m, p) parameters, (g, E, m) of E images.
"""
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from photutils_mgauss import kernels
from photutils_mgauss.photometry.engine import cut_boxes
from photutils_mgauss.utils.parallel import map_parallel

_MAX_STEPS = 60

# Groups handed to a thread at a time, times stars in each, squared.
_CHUNK = 2000

# Of the next step [pix], as for single images.
TOLERANCE = 1e-6

# Of the data, what chi2 may rise by for nothing.
_ROUNDING = 1e-14

# Where no longer step lowers chi2 either, a small one is the last.
_HOPELESS = 1e8

# The least eigenvalue of a matrix of unit diagonal that says enough.
_SINGULAR = 1e-11

# How far beyond an image a box may still be thought of [pix].
_FAR = 100


@dataclass(frozen=True, eq=False)
class Views:
    """
    Where g groups of m stars are seen in E images, and how that changes.

    Attributes
    ----------
    values : (g, m, p) `~numpy.ndarray`
        Parameters at which the following are.
    pixels : (g, E, m, 2) `~numpy.ndarray`
        Places x, y; NaN where an image cannot show the star.
    slopes : (g, E, m, 2, p) `~numpy.ndarray`
        Their derivatives by the parameters, 0 where there is no place.
    """

    values: np.ndarray
    pixels: np.ndarray
    slopes: np.ndarray

    def places(self, values, rows):
        """Return the pixels (r, E, m, 2) of some groups at other values."""
        shift = np.einsum('gemip,gmp->gemi', self.slopes[rows],
                          values - self.values[rows])
        return self.pixels[rows] + shift


@dataclass(frozen=True, eq=False)
class JointImages:
    """
    The pixels: E images, their PSFs, and what stars have in common.

    Attributes
    ----------
    images : list of `~photutils_mgauss.photometry.box_pixels.ScaledImage`
    psfs : list of tuple
        See `~photutils_mgauss.photometry.engine.psf_arrays`.
    shared : (E,) `~numpy.ndarray` of int
        The number, from 0, of the flux of each image.
    fit_sky : bool
        Whether each image of a group has a level of the sky.
    """

    images: list
    psfs: list
    shared: np.ndarray
    fit_sky: bool

    @property
    def n_fluxes(self):
        """The number of different fluxes of a star."""
        return int(self.shared.max()) + 1

    def groups(self, k, boxes, own):
        """
        Return the `~photutils_mgauss.kernels.GroupPixels` of image k.

        ``boxes`` (g, m, 4) are those of the stars, ``own`` (g, m, 3) light to
        add, or None.
        """
        return self.images[k].groups(boxes, own, self.psfs[k])


@dataclass(frozen=True, eq=False)
class Moments:
    """
    The moments of g groups in E images, the sky eliminated.

    Attributes
    ----------
    products : (g, E, 3 m, 3 m) `~numpy.ndarray`
        Of the stars' basis images: PSF and derivatives of each.
    data : (g, E, 3 m) `~numpy.ndarray`
    squares : (g, E) `~numpy.ndarray`
    n_pixels : (g, E) `~numpy.ndarray` of int
    sky : (g, E, 2 + 3 m) `~numpy.ndarray`
        The weight of the sky, its product with the data, and with the basis
        images; zeros if there is none.
    """

    products: np.ndarray
    data: np.ndarray
    squares: np.ndarray
    n_pixels: np.ndarray
    sky: np.ndarray

    @classmethod
    def of(cls, joint, pixels, rows, places, scratch):
        """
        Return those of some groups (r,) at places (r, E, m, 2).

        ``pixels`` are the `~photutils_mgauss.kernels.GroupPixels` of all
        groups in each image, ``scratch`` the memory to work in.
        """
        n, n_images, m = places.shape[:3]
        size = 3 * m
        out = cls(np.zeros((n, n_images, size, size)),
                  np.zeros((n, n_images, size)), np.zeros((n, n_images)),
                  np.zeros((n, n_images), np.int64),
                  np.zeros((n, n_images, 2 + size)))
        arrays = kernels.GroupMoments(*(getattr(out, f.name)
                                        for f in fields(cls)))
        for k, image in enumerate(pixels):
            kernels.group_moments(
                image, rows, np.ascontiguousarray(places[:, k]),
                joint.psfs[k], joint.fit_sky, k, np.zeros(size + 1), scratch,
                arrays)
        return out

    def levels(self, fluxes):
        """Return the sky (g, E) at fluxes (g, E, m)."""
        weight = np.where(self.sky[..., 0] > 0, self.sky[..., 0], np.nan)
        light = np.einsum('gem,gem->ge', self.sky[..., 2::3], fluxes)
        return (self.sky[..., 1] - light) / weight


@dataclass(frozen=True, eq=False)
class State:
    """
    Values (g, m, p), chi2 (g,), and its equations with fluxes eliminated.

    ``squares`` (g,) is the chi2 of no stars,
    ``matrix`` (g, m p, m p) and ``gradient`` (g, m p) are those of the
    parameters alone, ``fluxes`` (g, C, m) the best at these places, ``known``
    (g, C, m, m) the inverse of their own matrix and ``cross`` (g, C, m p, m)
    what joins both. ``curves`` (g, E, m, 2, m, 2) are the products of the
    derivatives in each image, for a flux of 1, ``slopes`` (g, E, m, 2) the
    gradients there, ``weights`` (g, E, m) the inverse variances of fluxes
    that the image alone has of the star alone, ``excess`` (g, E, m) the
    products of the PSF with what is left of the data.
    """

    values: np.ndarray
    chi2: np.ndarray
    squares: np.ndarray
    matrix: np.ndarray
    gradient: np.ndarray
    fluxes: np.ndarray
    known: np.ndarray
    cross: np.ndarray
    curves: np.ndarray
    slopes: np.ndarray
    weights: np.ndarray
    excess: np.ndarray
    n_pixels: np.ndarray
    sky: np.ndarray

    def take(self, rows):
        """Return the state of some groups."""
        return State(*(getattr(self, f.name)[rows] for f in fields(self)))

    def put(self, rows, other, where):
        """Take over some groups from the state of others."""
        for f in fields(self):
            getattr(self, f.name)[rows[where]] = getattr(other, f.name)[where]

    @classmethod
    def joined(cls, parts):
        """Return the state of all groups of several."""
        return cls(*(np.concatenate([getattr(one, f.name) for one in parts])
                     for f in fields(cls)))


@dataclass(frozen=True, eq=False)
class JointFit:
    """
    Groups to fit, to some `JointImages`.

    Attributes
    ----------
    joint : JointImages
    views : Views
    boxes : (g, E, m, 4) `~numpy.ndarray` of int
        The pixels of each star; see `boxes_around`.
    free : (g, m, p) `~numpy.ndarray` of bool
        Which parameters are fitted.
    own : (g, E, m, 3) `~numpy.ndarray` or None
        Light of the stars that the images are without.
    least_gain : float
        A step that promises to lower chi2 by less is the last.
    """

    joint: JointImages
    views: Views
    boxes: np.ndarray
    free: np.ndarray
    own: np.ndarray | None = None
    least_gain: float = 1e-10

    def parts(self):
        """Return the fits of a few groups each, for threads."""
        n, _, m = self.boxes.shape[:3]
        size = max(1, _CHUNK // m**2)
        return [self._part(slice(i, i + size))
                for i in range(0, max(n, 1), size)]

    def _part(self, rows):
        views = Views(*(getattr(self.views, f.name)[rows]
                        for f in fields(Views)))
        return replace(self, views=views, boxes=self.boxes[rows],
                       free=self.free[rows],
                       own=None if self.own is None else self.own[rows])

    @cached_property
    def _pixels(self):
        """The `~photutils_mgauss.kernels.GroupPixels` of each image."""
        return [self.joint.groups(
            k, np.ascontiguousarray(self.boxes[:, k]),
            None if self.own is None else np.ascontiguousarray(
                self.own[:, k])) for k in range(self.boxes.shape[1])]

    @cached_property
    def _scratch(self):
        """The `~photutils_mgauss.kernels.BoxScratch` of all images."""
        return kernels.BoxScratch.empty(self.boxes.shape[2],
                                        self.boxes.reshape(-1, 4))

    def evaluate(self, values, rows):
        """Return the `State` of some groups (r,) at values (r, m, p)."""
        return _state(self.joint, values, self.views.slopes[rows],
                      self._moments(values, rows))

    def _moments(self, values, rows):
        """Return the `Moments` of some groups (r,) at values (r, m, p)."""
        return Moments.of(self.joint, self._pixels, rows,
                          self._places(values, rows), self._scratch)

    def _places(self, values, rows):
        """Return the pixels (r, E, m, 2) at values, 0 where there are none."""
        places = self.views.places(values, rows)
        seen = self.boxes[rows][..., 2:].all(axis=-1)
        return np.where(seen[..., None], places, 0.0)

    def minimize(self):
        """Return the `State` at the least chi2, and who converged (g,)."""
        n = len(self.free)
        state = self.evaluate(self.views.values.copy(), np.arange(n))
        damping, done = np.zeros(n), np.zeros(n, bool)
        for _ in range(_MAX_STEPS):
            rows = np.flatnonzero(~done)
            if not rows.size:
                break
            now = state.take(rows)
            step, small = self._step(now, damping[rows], rows)
            done[rows[small & ((damping[rows] < 1)
                               | (damping[rows] > _HOPELESS))]] = True
            trial = self.evaluate(now.values + step.reshape(now.values.shape),
                                  rows)
            better = trial.chi2 <= now.chi2 + _ROUNDING * now.squares
            gain = _gain(now, trial, step)
            state.put(rows, trial, better)
            damping[rows] = np.where(
                better, next_dampings(damping[rows], gain),
                np.maximum(10 * damping[rows], 1e-3))
        return state, done

    def _step(self, state, damping, rows):
        """Return damped steps (r, m p), at most a pixel, and which end."""
        free = self.free[rows].reshape(len(rows), -1)
        step = solve_free(state.matrix, state.gradient, free, damping)
        promised = np.einsum('ni,ni->n', step, state.gradient)
        shift = np.einsum('gemip,gmp->gemi', self.views.slopes[rows],
                          step.reshape(state.values.shape))
        length = np.abs(shift).max(axis=(1, 2, 3))
        # No star moves farther than a pixel at a time.
        step *= np.minimum(1, 1 / np.maximum(length, 1e-300))[:, None]
        return step, (length < TOLERANCE) | (
            promised < self.least_gain)

    def scores(self, values, rows):
        """
        Return products of fluxes at places: with the data, with themselves.

        Only for single stars; (r, C) each.
        """
        places = self._places(values, rows)
        light, weight = np.zeros((2, len(rows), self.joint.n_fluxes))
        for k, c in enumerate(self.joint.shared):
            kernels.star_scores(
                self._pixels[k], rows, np.ascontiguousarray(places[:, k]),
                self.joint.psfs[k], self.joint.fit_sky, c,
                self._scratch.around, light, weight)
        return light, weight


def minimize_all(fit):
    """Return what `JointFit.minimize` does, in threads, a few at a time."""
    states, done = zip(*map_parallel(_minimized, fit.parts(), long=True),
                       strict=True)
    return State.joined(states), np.concatenate(done)


def _minimized(fit):
    return replace(fit).minimize()  # the pixels it takes out go with it


def boxes_around(pixels, fit_shape, shapes):
    """Return boxes (g, E, m, 4) in images of some shapes around places."""
    boxes = np.zeros((*pixels.shape[:3], 4), np.int64)
    for k, shape in enumerate(shapes):
        xy = pixels[:, k]
        with np.errstate(invalid='ignore'):
            near = ((xy > -_FAR) & (xy < np.array(shape[::-1]) + _FAR)).all(
                axis=-1)
        boxes[:, k][near] = cut_boxes(*xy[near].T, fit_shape, shape)
    return boxes


# The algebra.

def _state(joint, values, slopes, moments):
    """Return the `State` that moments (g, E, ...) make."""
    n, n_images, size = moments.data.shape
    m = size // 3
    fluxes, known, chi2 = _best_fluxes(joint, moments)
    flux = fluxes[:, joint.shared]
    place = np.arange(size).reshape(m, 3)[:, 1:].ravel()
    curves = moments.products[:, :, place[:, None], place].reshape(
        n, n_images, m, 2, m, 2)
    joins = moments.products[:, :, place][..., ::3].reshape(
        n, n_images, m, 2, m)
    pulls = (moments.data[:, :, place].reshape(n, n_images, m, 2)
             - np.einsum('geiam,gem->geia', joins, flux))
    pulls = pulls * flux[..., None]
    turned = slopes * flux[..., None, None]
    p = values.shape[2]
    gradient = np.einsum('geiap,geia->gip', slopes, pulls)
    half = np.einsum('geiajb,gejbq->geiajq', curves, turned)
    matrix = np.einsum('geiap,geiajq->gipjq', turned, half)
    matrix = matrix.reshape(n, m * p, m * p)
    cross = np.zeros((n, joint.n_fluxes, m * p, m))
    each = np.einsum('geiap,geiam->geipm', turned, joins).reshape(
        n, n_images, m * p, m)
    for k in range(n_images):
        cross[:, joint.shared[k]] += each[:, k]
    matrix -= np.einsum('gcpi,gcij,gcqj->gpq', cross, known, cross,
                        optimize=True)
    return State(values, chi2, moments.squares.sum(axis=1), matrix,
                 gradient.reshape(n, m * p), fluxes, known, cross, curves,
                 pulls,
                 np.einsum('geii->gei', moments.products[..., ::3, ::3]),
                 moments.data[..., ::3] - np.einsum(
                     'geij,gej->gei', moments.products[..., ::3, ::3], flux),
                 moments.n_pixels,
                 moments.levels(flux))


def _best_fluxes(joint, moments):
    """Return fluxes (g, C, m), their inverse matrices, and chi2 (g,)."""
    n, _, size = moments.data.shape
    m, count = size // 3, joint.n_fluxes
    matrix, light = np.zeros((n, count, m, m)), np.zeros((n, count, m))
    for k, c in enumerate(joint.shared):
        matrix[:, c] += moments.products[:, k, ::3, ::3]
        light[:, c] += moments.data[:, k, ::3]
    known = inverse(matrix)
    fluxes = np.einsum('gcij,gcj->gci', known, light)
    chi2 = moments.squares.sum(axis=1) - np.einsum('gci,gci->g', fluxes,
                                                   light)
    return fluxes, known, chi2


def inverse(matrices):
    """
    Return the inverses of symmetric matrices (..., m, m).

    Rows and columns of what nothing is known about are 0.
    """
    diagonal = np.einsum('...ii->...i', matrices)
    known = diagonal > 0
    scale = np.where(known, 1 / np.sqrt(np.where(known, diagonal, 1)), 0)
    if matrices.shape[-1] == 1:
        return (scale * scale)[..., None]
    scaled = matrices * scale[..., :, None] * scale[..., None, :]
    size = matrices.shape[-1]
    # A ridge far below what pixels can tell keeps twins apart.
    ridge = np.where(known, 1e-13, 1.0)
    scaled[..., np.arange(size), np.arange(size)] += ridge
    return (np.linalg.inv(scaled) * scale[..., :, None]
            * scale[..., None, :])


def solve_free(matrix, gradient, free, damping):
    """Return the Levenberg-Marquardt steps (g, s) of the free parameters."""
    size = matrix.shape[1]
    free = free & (np.einsum('nii->ni', matrix) > 0)
    diagonal = np.where(free, np.einsum('nii->ni', matrix), 1)
    scale = np.where(free, 1 / np.sqrt(diagonal), 0)
    scaled = matrix * scale[:, :, None] * scale[:, None, :]
    scaled[:, np.arange(size), np.arange(size)] += np.where(
        free, damping[:, None] + 1e-13, 1.0)
    steps = np.linalg.solve(scaled, (gradient * scale)[..., None])
    return steps[..., 0] * scale


def covariances(state, free=None):
    """
    Return the covariances of parameters, and the variances of fluxes.

    Parameters
    ----------
    state : State
    free : (g, m, p) `~numpy.ndarray` of bool, optional
        Which parameters have been fitted; the others get NaN.

    Returns
    -------
    (g, m p, m p) `~numpy.ndarray`
        NaN where the pixels do not tell.
    (g, C, m) `~numpy.ndarray`
        NaN where no pixel shows the star.
    """
    n, size = state.gradient.shape
    free = np.ones((n, size), bool) if free is None else free.reshape(n, size)
    covariance, known = fixed_inverse(state.matrix, free)
    share = np.einsum('gcpm,gcmi->gcpi', state.cross, state.known)
    flux = np.einsum('gcmm->gcm', state.known) + np.einsum(
        'gcpi,gpq,gcqi->gci', share, covariance, share, optimize=True)
    shown = np.einsum('gcmm->gcm', state.known) > 0
    unknown = ~known[:, :, None] | ~known[:, None, :]
    return (np.where(unknown, np.nan, covariance),
            np.where(shown, flux, np.nan))


def fixed_inverse(matrices, free):
    """
    Return inverses (g, s, s), 0 for what is not free, and what is known.

    What is free of a matrix that is singular is not known.
    """
    diagonal = np.einsum('nii->ni', matrices)
    informed = free & (diagonal > 0)
    scale = np.where(informed, 1 / np.sqrt(np.where(informed, diagonal, 1)),
                     0)
    scaled = matrices * scale[:, :, None] * scale[:, None, :]
    size = matrices.shape[1]
    scaled[:, np.arange(size), np.arange(size)] += ~informed
    scaled = np.where(np.isfinite(scaled), scaled, np.eye(size))
    sound = (informed | ~free).all(axis=1) & (
        np.linalg.eigvalsh(scaled)[:, 0] > _SINGULAR)
    scaled[~sound] = np.eye(size)
    inverses = (np.linalg.inv(scaled) * scale[:, :, None]
                * scale[:, None, :])
    inverses[~sound] = 0
    return inverses, free & sound[:, None]


def _gain(state, trial, step):
    """Return what steps brought over what the equations promised."""
    expected = (2 * np.einsum('ni,ni->n', step, state.gradient)
                - np.einsum('ni,nij,nj->n', step, state.matrix, step))
    # Of a smaller fall nothing is left after rounding: keep the damping.
    known = expected > 1e-9 * state.chi2
    return np.divide(state.chi2 - trial.chi2, expected, where=known,
                     out=np.full(len(step), kernels.POOR_GAIN))


def next_dampings(damping, gain):
    """Return what `kernels.next_damping` does, for many fits (n,) at once."""
    return np.select(
        [gain < kernels.POOR_GAIN, gain < kernels.FAIR_GAIN, damping > 1e-4],
        [np.maximum(4 * damping, 1e-2), damping, damping / 10], 0.0)
