"""Stars whose middle cannot be seen, found by their wings."""
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt, find_objects, label

from photutils_mgauss import kernels

# Wings are looked at so far from what is hidden [pix], of wide PSFs further.
_WINGS = 7
# How well the PSF of bright wings is known, as a fraction of their light.
_PSF_ERROR = 0.05
# Places are tried a pixel apart, at most so many, then ever closer.
_MOST_PLACES = 400
_STEPS = (0.5, 0.25, 0.1)
# A star stands out of the noise by so many standard errors, and its middle
# would be nearly as bright as what may be hidden.
_SIGNIFICANT, _BRIGHT_ENOUGH = 30.0, 0.5


@dataclass(frozen=True)
class WingStar:
    """
    A star behind a clump of bad pixels.

    ``x``, ``y`` and ``flux`` are where a fit can start, ``significance`` how
    well its wings are seen, ``core`` [pix] how far from its middle pixels are
    hidden, ``half`` half the width of pixels that hold its wings, ``clump``
    which (y, x) slices hold all bad pixels.
    """

    x: float
    y: float
    flux: float
    significance: float
    core: int
    half: int
    clump: tuple


def reach_of_wings(psf):
    """Return how far from what is hidden a PSF's wings are looked at [pix]."""
    return round(psf.scale * _WINGS)


def stars_behind(psf, data, weight, *, level=0.0, sizes=(1, np.inf)):
    """
    Find stars behind clumps of bad pixels.

    Parameters
    ----------
    psf : `~photutils_mgauss.psf.local.LocalPSF`
    data, weight : (ny, nx) `~numpy.ndarray`
        The background subtracted; inverse variances, 0 for bad pixels.
    level : float, optional
        What is hidden is at least as bright.
    sizes : (int, int), optional
        How many pixels a clump may have.

    Returns
    -------
    list of WingStar
    """
    clumps, n = label(weight <= 0, np.ones((3, 3)))
    size = np.bincount(clumps.ravel(), minlength=n + 1)[1:]
    found = [_star(psf, data, weight, level, box, clumps[box] == k + 1)
             for k, box in enumerate(find_objects(clumps))
             if sizes[0] <= size[k] <= sizes[1]]
    return [star for star in found if star is not None]


def core_of(clump):
    """
    Return how far from their middle pixels of a clump are hidden [pix].

    And which of them, (y, x), may hide the middle of a star.
    """
    # The middle of a star is where it hides most around it, not in a trail.
    depth = distance_transform_edt(np.pad(clump, 1))[1:-1, 1:-1]
    return int(np.ceil(depth.max())), *np.nonzero(
        depth > min(0.5 * depth.max(), depth.max() - 1))


def place_behind(psf, data, weight, box, clump):
    """
    Return where the wings around a clump say that a star is.

    Parameters
    ----------
    psf, data, weight
        As of `stars_behind`.
    box : (slice, slice) tuple
        Rows and columns of the clump.
    clump : `~numpy.ndarray` of bool
        Which pixels of the box are its.

    Returns
    -------
    x, y : float
    core : int
        How far from there pixels are hidden.
    wings : Wings or None
        The pixels around it, None if none is good.
    """
    core, y, x = core_of(clump)
    half = core + reach_of_wings(psf)
    y, x = y + box[0].start, x + box[1].start
    window = tuple(
        slice(max(0, int(at.min()) - half), min(n, int(at.max()) + half + 1))
        for at, n in zip((y, x), data.shape, strict=True))
    wings = Wings(psf, data[window], weight[window],
                   (window[0].start, window[1].start), x.mean(), y.mean())
    if not wings.seen.any():
        return x.mean(), y.mean(), core, None
    stride = -(-x.size // _MOST_PLACES)
    places = list(zip(x[::stride].astype(float), y[::stride].astype(float),
                      strict=True))
    best = wings.best(places)
    for step in _STEPS:
        best = wings.best([(best[0] + i * step, best[1] + j * step)
                           for i in (-1, 0, 1) for j in (-1, 0, 1)])
    return *best, core, wings


def _star(psf, data, weight, level, box, clump):
    *best, core, wings = place_behind(psf, data, weight, box, clump)
    if wings is None:
        return None
    flux, significance, bright = wings.measure(*best)
    if not (significance > _SIGNIFICANT and flux * wings.peak
            > _BRIGHT_ENOUGH * max(level, bright)):
        return None
    return WingStar(*best, flux, significance, core,
                    core + reach_of_wings(psf), box)


class Wings:
    """The pixels around a clump, and the star that fits them."""

    def __init__(self, psf, data, weight, origin, x, y):
        rows, count = psf.rows_at(np.array([x]), np.array([y]))
        self.rows = rows[0, :count[0]]
        self.integrated = psf.integrated
        self.data, self.weight = data, weight
        self.y_0, self.x_0 = origin
        self.seen = weight > 0
        # Where bright wings are not as the PSF says all count alike.
        self.careful = weight / (1 + weight * (_PSF_ERROR * data)**2)
        self.peak = psf.profile[0]

    def _draw(self, x, y):
        out = np.zeros(self.data.shape)
        # As floats: for integers the kernel would be compiled once more.
        kernels.render(self.rows, float(x - self.x_0), float(y - self.y_0),
                       1.0, self.integrated, out)
        return out

    def best(self, places):
        """Return the place from which a star explains most."""
        return max(places, key=lambda place: self._gain(*place))

    def _gain(self, x, y):
        stamp = self._draw(x, y)
        light = (self.careful * stamp * self.data).sum()
        return np.sign(light) * light**2 / (
            self.careful * stamp * stamp).sum()

    def measure(self, x, y):
        """Return flux, its significance, and the brightest pixel seen."""
        stamp = self._draw(x, y)
        square = (self.careful * stamp * stamp).sum()
        flux = (self.careful * stamp * self.data).sum() / square
        return (flux, flux * np.sqrt((self.weight * stamp * stamp).sum()),
                self.data[self.seen].max())
