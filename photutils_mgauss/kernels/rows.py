"""Mixtures on a lattice of pixels, a pixel row at a time."""
from math import erf, exp, sqrt

import numpy as np

from photutils_mgauss.kernels.gaussian import (
    HALF_PI_ROOT,
    LOG_NOTHING,
    NODE_WEIGHTS,
    NODES,
    NOTHING,
    pixel_panels,
)
from photutils_mgauss.kernels.jit import inner, kernel

# Mixtures on a pixel lattice.

@inner
def add_row(peak, u0, p, out):
    """
    Add peak * exp(-p u^2 / 2) for u = u0, u0 + 1, ... to out (n,).

    The quotient of neighbouring pixels falls by exp(-p) each step, so a pixel
    costs two multiplications. The walk starts at the pixel nearest the peak
    and goes outward both ways: from far out, the first value would underflow.
    """
    n = out.size
    start = min(max(int(np.rint(-u0)), 0), n - 1)
    u = u0 + start
    if p * u * u > LOG_NOTHING:
        return
    first = peak * exp(-0.5 * p * u * u)
    fall = exp(-p)
    out[start] += first
    g = first
    r = exp(-p * (u + 0.5))
    for i in range(start + 1, n):
        g *= r
        if abs(g) < NOTHING:
            break
        r *= fall
        out[i] += g
    g = first
    r = exp(-p * (0.5 - u))
    for i in range(start - 1, -1, -1):
        g *= r
        if abs(g) < NOTHING:
            break
        r *= fall
        out[i] += g


@inner
def add_integrated_row(peak, dx, dy, p, s, q, out):
    """Add the pixel integrals of one row; dx is the offset of its first."""
    low, height, panels = pixel_panels(dy, p, s, q)
    for panel in range(panels):
        middle = low + (panel + 0.5) * height
        for node in range(NODES.size):
            t = middle + NODES[node] * height
            ridge = (peak * NODE_WEIGHTS[node] * height
                     * exp(-0.5 * q * t * t) * HALF_PI_ROOT / sqrt(p))
            if abs(ridge) < NOTHING:
                continue
            root = sqrt(0.5 * p)
            left = erf(root * (dx - 0.5 - s * t))
            for i in range(out.size):
                right = erf(root * (dx + i + 0.5 - s * t))
                out[i] += ridge * (right - left)
                left = right


@kernel
def render(rows, x_0, y_0, flux, integrated, out):
    """Add flux times the mixture, centred on (x_0, y_0), to out (ny, nx)."""
    for k in range(rows.shape[0]):
        a, mx, my, p, s, q = rows[k]
        dx = -x_0 - mx
        for j in range(out.shape[0]):
            dy = j - y_0 - my
            if integrated is not None and integrated:
                add_integrated_row(flux * a, dx, dy, p, s, q, out[j])
            elif q * dy * dy < LOG_NOTHING:
                ridge = flux * a * exp(-0.5 * q * dy * dy)
                add_row(ridge, dx - s * dy, p, out[j])
