"""Integrals of mixtures over discs, and the width at half of the peak."""
import numpy as np
from scipy.optimize import minimize
from scipy.special import erf


def polar_integral(mixture, radius, n_angles):
    """
    Integrate the mixture over discs of the radii (n,), in n_angles steps.

    Along a ray u the exponent is -(a r^2 - 2 b r + c) / 2 with a = u.P.u,
    b = u.P.m, c = m.P.m, which r dr integrates to exponentials and erf.
    """
    angle = 2 * np.pi * np.arange(n_angles) / n_angles
    ray = np.stack([np.cos(angle), np.sin(angle)])
    total = np.zeros((radius.size, n_angles))
    precisions = np.linalg.inv(mixture.covariances)
    for height, m, p in zip(mixture.rows[:, 0], mixture.means, precisions,
                            strict=True):
        a = np.einsum('it,ij,jt->t', ray, p, ray)
        h = (m @ p @ ray) / a
        peak = np.exp(-0.5 * (m @ p @ m - a * h**2))
        root = np.sqrt(a / 2)
        r = radius[:, None]
        inside = ((np.exp(-0.5 * a * h**2)
                   - np.exp(-0.5 * a * (r - h) ** 2)) / a
                  + h * np.sqrt(np.pi) / (2 * root)
                  * (erf(root * (r - h)) + erf(root * h)))
        total += height * peak * inside
    return total.mean(axis=1) * 2 * np.pi


def half_maximum_width(mixture):
    """Return the diameter of the contour at half of the peak [pix]."""
    heights = mixture.evaluate(*mixture.means.T)
    peak = minimize(lambda r: -mixture.evaluate(*r) / heights.max(),
                    mixture.means[heights.argmax()],
                    jac=lambda r: -mixture.gradient(*r) / heights.max()).x
    half = mixture.evaluate(*peak) / 2
    angle = np.linspace(0, 2 * np.pi, 128, endpoint=False)
    low = np.zeros(angle.size)
    high = np.full(angle.size, 10 * mixture.stddevs.max())
    for _ in range(50):
        radius = (low + high) / 2
        inside = mixture.evaluate(peak[0] + radius * np.cos(angle),
                                  peak[1] + radius * np.sin(angle)) > half
        low = np.where(inside, radius, low)
        high = np.where(inside, high, radius)
    return float(2 * np.sqrt(np.mean(radius**2)))
