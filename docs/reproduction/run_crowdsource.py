"""Run crowdsource on arrays in a file, with nothing of ours imported."""
import sys

import numpy as np
from crowdsource import crowdsource_base

RADIUS = 14


class MixturePSF:
    """
    A grid of mixtures as crowdsource calls a PSF: x is the row of a star.

    The node nearest to a star is its PSF.
    """

    def __init__(self, places, weights, means, covariances):
        self.places = places
        self.means = means
        inverse = np.linalg.inv(covariances)
        self.inverse = inverse
        self.peaks = weights * np.sqrt(np.linalg.det(inverse)) / (2 * np.pi)

    def __call__(self, x, y, stampsz=None, deriv=False):
        """Return stamps around stars, and derivatives by their positions."""
        size = stampsz or 2 * RADIUS + 1
        shape = np.broadcast(x, y).shape
        row, column = (np.atleast_1d(a).astype(float) for a in (x, y))
        stamps = np.zeros((3, row.size, size, size), 'f4')
        half = min(size // 2, RADIUS)
        inner = slice(size // 2 - half, size // 2 + half + 1)
        for i in range(row.size):
            stamps[:, i, inner, inner] = self._stamp(row[i], column[i], half)
        stamps = stamps.reshape(3, *shape, size, size)
        return tuple(stamps) if deriv else stamps[0]

    def _stamp(self, row, column, half):
        node = np.argmin(np.hypot(self.places[:, 0] - column,
                                  self.places[:, 1] - row))
        steps = np.arange(-half, half + 1)
        u = (steps + np.rint(column) - column)[None, None, :]
        v = (steps + np.rint(row) - row)[None, :, None]
        u = u - self.means[node][:, 0, None, None]
        v = v - self.means[node][:, 1, None, None]
        inverse = self.inverse[node][:, :, :, None, None]
        along = inverse[:, 0, 0] * u + inverse[:, 0, 1] * v
        up = inverse[:, 1, 0] * u + inverse[:, 1, 1] * v
        value = self.peaks[node][:, None, None] * np.exp(
            -0.5 * (u * along + v * up))
        return np.stack([value, value * up, value * along]).sum(axis=1)

    def render_model(self, x, y, stampsz=None):
        """Return stamps of stars in the middle of their pixels."""
        return self(np.round(x), np.round(y), stampsz)

    def serialize(self, stampsz=None):
        """Return nothing: the PSF is not to be kept."""


def main():
    """Read arrays, fit, write the list."""
    with np.load(sys.argv[1]) as arrays:
        psf = MixturePSF(*(arrays[name] for name in (
            'places', 'weights', 'means', 'covariances')))
        stars = crowdsource_base.fit_im(
            arrays['data'], psf, weight=arrays['weight'], psfderiv=True,
            refit_psf=False, maxstars=400000)[0]
    np.savez(sys.argv[2], x=stars['y'], y=stars['x'], flux=stars['flux'])


if __name__ == '__main__':
    main()
