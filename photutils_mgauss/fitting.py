r"""
Least-squares fits of Gaussian mixtures to PSF images (Nie et al., Sec. 2.2).

The image is a PSF sampled at pixel centres: pixel (i, j) holds the flux
density per native pixel at :math:`((i - x_o) / s_x, (j - y_o) / s_y)` from
the star, with :math:`(x_o, y_o)` the origin and s the oversampling. So the
pixels of a PSF of unit flux sum to :math:`s_x s_y`, as in photutils.
"""
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property
from os import process_cpu_count

import numpy as np

from photutils_mgauss import _kernels
from photutils_mgauss._validation import (as_choice, as_floats, as_integer,
                                          as_real)
from photutils_mgauss.mixture import GaussianMixture

__all__ = ['FitStatus', 'MixtureFit', 'fit_mixture']

_TOLERANCE = 1e-8
_MAX_STEPS = 400
_FIRST_STEPS = 12
# A Gaussian narrower than this in stamp pixels falls between the pixel
# centres and can take any flux.
_MIN_STDDEV = 0.4
# How firmly the total flux is tied, in units of the image's power.
_TIE = 1e6
