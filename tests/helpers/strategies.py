"""Random mixtures and matrices for property tests."""
import numpy as np
from hypothesis import assume
from hypothesis import strategies as st

from photutils_mgauss import GaussianMixture

# Every property test looks at the same examples on every run.
SETTINGS = {'derandomize': True, 'deadline': None, 'max_examples': 60}


def numbers(low, high):
    """Draw a float between two limits."""
    return st.floats(low, high, allow_nan=False, width=64)


@st.composite
def mixtures(draw, *, max_components=4, min_stddev=0.4, max_stddev=8,
             max_rho=0.95, signed=False):
    """Draw a mixture."""
    k = draw(st.integers(1, max_components))
    raw = np.array(draw(st.lists(numbers(0.05, 1), min_size=k, max_size=k)))
    if signed and k > 1:
        raw[0] *= -0.2
        assume(raw.sum() > 0.01)
    means = draw(st.lists(st.tuples(numbers(-2, 2), numbers(-2, 2)),
                          min_size=k, max_size=k))
    size = numbers(min_stddev, max_stddev)
    stddevs = draw(st.lists(st.tuples(size, size), min_size=k, max_size=k))
    rho = draw(st.lists(numbers(-max_rho, max_rho), min_size=k, max_size=k))
    return GaussianMixture.from_stddevs(raw / raw.sum(), means, stddevs, rho)


@st.composite
def covariances(draw, *, min_stddev=0.1, max_stddev=5):
    """Draw a covariance matrix."""
    size = numbers(min_stddev, max_stddev)
    sx, sy, rho = draw(size), draw(size), draw(numbers(-0.95, 0.95))
    return np.array([[sx**2, rho * sx * sy], [rho * sx * sy, sy**2]])
