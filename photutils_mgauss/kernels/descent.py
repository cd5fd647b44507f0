"""The damping and the ending of least-squares fits."""
from photutils_mgauss.kernels.jit import inner, kernel

# How far a star may move in one step, in pixels.
LONGEST = 1.0

# Fits stop when the next step is expected to be below this, in pixels and as
# a fraction of the flux.
STEP_TOLERANCE = 1e-6

# By what the damping of `adapted_damping` grows first.
FIRST_GROWTH = 2.0

# What fraction of the fall of chi2 that the normal equations promise a step
# should bring: below the first damping grows, above the second it falls.
POOR_GAIN = 0.25
FAIR_GAIN = 0.75

# The least factor by which steps are taken to get shorter.
_LEAST_RATE = 0.03

# Out of iterations, fits whose chi2 fell by a smaller fraction than this in
# the last step count as good, as they do in scipy: along a valley, such as
# that of two stars in one place, steps may remain long.
LEAST_FALL = 1e-8


@kernel
def remainder(length, last):
    """
    Return how far the minimum is expected to be after a step.

    Convergence is linear at the worst, each step shorter than the last one by
    the same factor. A first step, with a last one of 0, says nothing of it,
    and early steps make it look better than it will be.
    """
    rate = max(length / last, _LEAST_RATE) if last > 0 else 0.5
    return length * (rate / (1 - rate) if rate < 0.9 else 10.0)


@kernel
def next_damping(damping, gain):
    """
    Return the damping after a step that brought gain of what it promised.

    A faint star needs some even at its minimum, where the curvature that the
    normal matrix leaves out makes undamped steps overshoot.
    """
    if gain < POOR_GAIN:
        return max(4 * damping, 1e-2)
    if gain < FAIR_GAIN:
        return damping
    return damping / 10 if damping > 1e-4 else 0.0


def adapted_damping(damping, growth, fall, expected):
    """
    Return damping and its growth after a step, from far off the minimum.

    The damping follows how well the fall of the cost was foreseen, and grows
    ever faster while steps fail (Nielsen 1999, report IMM-REP-1999-05,
    Technical University of Denmark).
    """
    if not fall > 0:
        return damping * growth, 2 * growth
    quality = 2 * fall / max(expected, 1e-300) - 1
    return damping * max(0.2, 1 - quality ** 3), FIRST_GROWTH


compiled_adapted_damping = inner(adapted_damping)
