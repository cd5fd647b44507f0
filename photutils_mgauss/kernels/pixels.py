r"""
A Gaussian integrated over the pixels of a row, and what shapes change of it.

With :math:`t` along y, :math:`u = x - s t` and
:math:`F(u) = \int^u e^{-p v^2 / 2}\,dv`, the integral over a pixel is

.. math::

    V = \int e^{-q t^2 / 2}\, [F(u)]_{\rm left}^{\rm right}\, dt .

F is closed, the integral along y is Gauss-Legendre quadrature. Derivatives of
V need the same integral of t F, t^2 F and, with :math:`G = F'`, of G, t G and
u G: one error function and its exponential for each node and edge of a pixel
give them all.
"""
from math import sqrt

from photutils_mgauss.kernels.gaussian import (
    HALF_PI_ROOT,
    NODE_WEIGHTS,
    NODES,
    erfc_over_exp,
    fast_exp,
    pixel_panels,
)
from photutils_mgauss.kernels.jit import inner, loop, sums

N_NODES = NODES.size

# Where nodes are less than this they are left out: further below the peak
# than rounding of any sum it could be part of.
_NO_RIDGE = 1e-60


@sums
def _edge(x, s, root, scale, n, t, ridge):
    """
    Sum over n nodes at t, of weight ridge, on the edge of a pixel at x.

    What is summed is F, t F, t^2 F, G, t G and u G.
    """
    f, tf, ttf, g, tg, ug = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(n):
        u = x - s * t[j]
        z = root * u
        value = fast_exp(-z * z)
        beyond = value * erfc_over_exp(abs(z))
        area = ridge[j] * (1 - beyond if z > 0 else beyond - 1)
        value *= ridge[j]
        f += area
        tf += t[j] * area
        ttf += t[j] * t[j] * area
        g += value
        tg += t[j] * value
        ug += u * value
    return scale * f, scale * tf, scale * ttf, g, tg, ug


@inner
def _lay_nodes(low, height, q, nodes):
    """Put the places and weights of a panel into nodes; return the largest."""
    most = 0.0
    for j in range(N_NODES):
        t = low + (0.5 + NODES[j]) * height
        nodes[0, j] = t
        nodes[1, j] = NODE_WEIGHTS[j] * height * fast_exp(-0.5 * q * t * t)
        most = max(most, nodes[1, j])
    return most


@inner
def shape_integrals(dx, dy, p, s, q, nodes, edges, out):
    """
    Put a row of pixels and its derivatives into out (6, n).

    The Gaussian has unit peak, the first pixel is at (dx, dy) from it. The
    rows are value and derivatives by x and y of the Gaussian, by log_p, s
    and log_q, where a Gaussian of constant flux grows with sqrt(p q). nodes
    (2, 8) and edges (6, n + 1) are scratch. Returns whether there is
    anything.
    """
    low, height, panels = pixel_panels(dy, p, s, q)
    root = sqrt(0.5 * p)
    something = False
    for panel in range(panels):
        if _lay_nodes(low + panel * height, height, q, nodes) < _NO_RIDGE:
            continue
        if not something:
            something = True
            edges[:] = 0.0
        for i in range(edges.shape[1]):
            f, tf, ttf, g, tg, ug = _edge(
                dx - 0.5 + i, s, root, HALF_PI_ROOT / sqrt(p), N_NODES,
                nodes[0], nodes[1])
            edges[0, i] += f
            edges[1, i] += tf
            edges[2, i] += ttf
            edges[3, i] += g
            edges[4, i] += tg
            edges[5, i] += ug
    if something:
        _differences(s, q, edges, out)
    return something


@loop
def _differences(s, q, edges, out):
    """Turn sums at edges into derivatives over pixels, out (6, n)."""
    f, tf, ttf, g, tg, ug = edges
    value, by_x, by_y, by_p, by_s, by_q = out
    for i in range(value.size):
        inside = f[i + 1] - f[i]
        step = g[i + 1] - g[i]
        value[i] = inside
        by_x[i] = -step
        by_y[i] = q * (tf[i + 1] - tf[i]) + s * step
        by_p[i] = ug[i + 1] - ug[i]
        by_s[i] = tg[i] - tg[i + 1]
        by_q[i] = inside - q * (ttf[i + 1] - ttf[i])
