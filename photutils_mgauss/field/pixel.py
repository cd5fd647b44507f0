"""
Whether a field describes the light of the optics or that in pixels.

Where a PSF is hardly wider than a pixel, no sum of few Gaussians sampled at
the middles of pixels is like it: the light of a star in its pixels, added up,
would depend on where in a pixel the star is. The PSF of the optics has to be
integrated over pixels then.
"""
import logging
import warnings
from dataclasses import replace

import numpy as np
from astropy.utils.exceptions import AstropyUserWarning

from photutils_mgauss import kernels
from photutils_mgauss.field import stages
from photutils_mgauss.psf.phase import phase_error
from photutils_mgauss.psf.rows import kernel_rows_of_logs

_LOG = logging.getLogger('photutils_mgauss')
# Narrower PSFs, their pixel included, are integrated [pix].
_WELL_SAMPLED = 1.6
# The Gaussians that the width is measured with.
_COMPONENTS = 2
# The change of flux with pixel phase that is worth a word.
_PHASE_ERROR = 0.003


def chosen_pixel(problem, pixel_integrated, strength, workers):
    """Return whether to integrate, which the width of the PSF may decide."""
    if pixel_integrated != 'auto':
        return pixel_integrated
    optics = replace(problem.subset(np.arange(len(problem.basis))),
                     pixel_integrated=True)
    coefficients, _, _ = stages.begin(optics, _COMPONENTS, strength, workers,
                                      (stages.PLAIN,))
    width = full_width(coefficients[0], problem.stamps.radius)
    integrated = width < _WELL_SAMPLED
    _LOG.info('the PSF is %.2f pixels wide at half maximum, which is %s',
              width, 'too narrow to be sampled: the optics are integrated '
              'over pixels' if integrated else 'wide enough to be sampled')
    return integrated


def full_width(shapes, radius):
    """
    Return the full width at half maximum of optics and pixel [pix].

    That of the circle whose area is that above half of the value at the
    centre of the light inside; shapes are (K, 6).
    """
    rows = kernel_rows_of_logs(shapes)
    light = np.exp(shapes[:, 0] - shapes[:, 0].max())
    x_0, y_0 = light @ shapes[:, 1:3] / light.sum()
    r = np.linspace(0, radius, 50 * int(np.ceil(radius)) + 1)
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)[:, None]
    values = _integrals(rows, x_0 + r * np.cos(angle), y_0 + r * np.sin(angle))
    below = values < values[0, 0] / 2
    ends = r[np.where(below.any(axis=1), below.argmax(axis=1), -1)]
    return float(2 * np.sqrt(np.mean(ends**2)))


def warn_of_phase(mixture):
    """Warn if fluxes of a sampled PSF depend on the place in the pixel."""
    error = phase_error(mixture)
    if error > _PHASE_ERROR:
        warnings.warn(
            f'the light of the PSF that was fitted, added up over pixels, '
            f'changes by {error:.1%} (rms) with the place of a star in its '
            'pixel, and fluxes with it: the pixels are too coarse for a PSF '
            'that is sampled; use pixel_integrated=True (mgauss psf '
            '--pixel-integrated)', AstropyUserWarning,
            stacklevel=6)


def _integrals(rows, x, y):
    out = np.empty(x.size)
    kernels.evaluate(np.ravel(x), np.ravel(y), rows, True, out)
    return out.reshape(x.shape)
