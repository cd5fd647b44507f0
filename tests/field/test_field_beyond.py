"""One degree more than few stars bear by themselves."""
from types import SimpleNamespace

import numpy as np
from numpy.testing import assert_allclose
from scipy.stats import multivariate_normal

from photutils_mgauss.field.beyond import evidence
from photutils_mgauss.field.normal import Prior


def test_priors_are_compared_by_how_likely_they_make_the_data():
    rng = np.random.default_rng(3)
    design = rng.normal(size=(12, 6))
    data, coefficients = rng.normal(size=12), rng.normal(size=(3, 2))
    # By number, then term.
    vector = coefficients.T.ravel()
    fit = SimpleNamespace(
        coefficients=coefficients, equations=SimpleNamespace(
            matrix=design.T @ design,
            right=design.T @ (data - design @ vector)))
    found, expected = [], []
    for size in (0.2, 1.0, 5.0):
        variance = np.array([[1.0, 2], [0.5, 0.7], [size, 2 * size]])
        found.append(evidence(fit, Prior(np.zeros((3, 2)), 1 / variance)))
        expected.append(multivariate_normal(cov=np.eye(12) + (
            design * variance.T.ravel()) @ design.T).logpdf(data))
    assert_allclose(np.diff(found), np.diff(expected), rtol=1e-10)
