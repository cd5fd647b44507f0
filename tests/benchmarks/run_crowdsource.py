"""
Run crowdsource on an image, in an interpreter that has it.

``python run_crowdsource.py IN.npz OUT.npz``: data (its sky taken off),
error, mask, and the PSF as weights, means, covariances and grid. The PSF is
drawn by this package's compiled code, so that little of the time is spent on
it.
"""
import sys
import time

import numpy as np

from photutils_mgauss import GaussianMixture, GriddedMixturePSF, kernels
from photutils_mgauss.psf.local import LocalPSF

RADIUS = 24


class CallablePSF:
    """What crowdsource asks for: stamps at (row, column), derivatives."""

    def __init__(self, weights, means, covariances, grid):
        mixtures = [GaussianMixture(*m) for m in
                    zip(weights, means, covariances, strict=True)]
        self.psf = LocalPSF.of(GriddedMixturePSF(mixtures, grid))

    def __call__(self, x, y, stampsz=None, deriv=False):
        size = int(stampsz or 2 * RADIUS + 1)
        shape = np.broadcast(x, y).shape
        row, column = (np.atleast_1d(v).astype(float) for v in (x, y))
        half = min(size // 2, RADIUS)
        stamps = self._stamps(column, row, half)
        out = np.zeros((3, row.size, size, size), 'f4')
        part = slice(size // 2 - half, size // 2 + half + 1)
        out[:, :, part, part] = stamps[[0, 2, 1]]
        out = out.reshape(3, *shape, size, size)
        return tuple(out) if deriv else out[0]

    def _stamps(self, x, y, half):
        n, width = x.size, 2 * half + 1
        # crowdsource centres stamps on the pixel numpy.round names.
        left, bottom = (np.round(v).astype(np.int64) - half for v in (x, y))
        stamps = kernels.Stamps(left, bottom, np.full(n, width),
                                np.arange(n) * width**2,
                                np.empty((3, n * width**2)))
        kernels.star_stamps(np.arange(n), kernels.Sources(x, y, np.ones(n)),
                            stamps, self.psf.gaussians_at(x, y),
                            kernels.Tiling.empty(width))
        return stamps.derivatives.reshape(3, n, width, width)

    def render_model(self, x, y, stampsz=None):
        """Return stamps at whole pixels."""
        return self(np.round(x), np.round(y), stampsz)

    def serialize(self, stampsz=None):
        """Return nothing: the PSF is not written to a file."""


def main(source, target):
    from crowdsource import crowdsource_base
    given = np.load(source)
    psf = CallablePSF(*(given[k] for k in ('weights', 'means', 'covariances',
                                           'grid')))
    data = given['data'].astype(float)
    weight = np.where(given['mask'], 0, 1 / given['error'])
    psf(np.zeros(2), np.zeros(2), 19, deriv=True)  # compile
    start = time.process_time()
    stars = crowdsource_base.fit_im(data, psf, weight=weight, psfderiv=True,
                                    refit_psf=False, maxstars=4000000)[0]
    seconds = time.process_time() - start
    np.savez(target, x=stars['y'], y=stars['x'], flux=stars['flux'],
             flux_err=stars['dflux'], x_err=stars['dy'], y_err=stars['dx'],
             seconds=seconds)


if __name__ == '__main__':
    main(*sys.argv[1:])
