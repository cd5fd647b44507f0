"""
What no field of the same Gaussians from the same stars can go below.

A field of all stars of an image, without their noise, is the best that these
Gaussians and polynomials can do; what it is off by is the misfit. The normal
equations of the stars that were really used, at those shapes and with no
weights but those of the noise, give the least covariance of the coefficients
(Cramer-Rao): with the prior that all stars have taught, for one who knows
how much shapes vary, and with hardly any. Fields drawn from it say how
far positions are off because of the noise in those stars.
"""
from dataclasses import replace

import numpy as np

from photutils_mgauss.field import stages
from photutils_mgauss.field.input import read_sample
from photutils_mgauss.field.normal import (
    Workers,
    to_coefficients,
    to_vector,
)

# Small steps, so that positions answer in proportion.
DRAWS, STEP = 8, 0.05
WITHOUT_PRIOR = 1e-4


class Bound:
    """
    The least errors of positions with a field of few stars.

    Parameters
    ----------
    field : MixtureField
        Says how many Gaussians, which degree, and how pixels are made.
    clean, error : (ny, nx) `~numpy.ndarray`
        The image without noise, and the noise it has.
    stars, every : `~astropy.table.Table`
        As for `fit_mixture_field`: the stars the field was made of, and all.
    offsets : callable
        ``offsets(field, image)`` returns how far stars are off (n, 2).
    """

    def __init__(self, field, clean, error, stars, every, offsets):
        self.degree, self.radius = field.degree, field.radius
        self.integrated = field.pixel_integrated
        with Workers() as workers:
            fit = stages.run(self._problem(clean, error, every),
                             field.n_components, self.degree, workers)
            problem = self._problem(clean, error, stars).with_terms(
                stages.n_terms(self.degree))
            few = stages.with_errors(
                replace(fit, problem=problem, deviant_pixels=np.zeros(
                    problem.stamps.good.shape, bool), equations=None), 0.0,
                workers)
            # The weights are now those of the model.
            stages.weigh(few, reject=False, share=None)
            stages.advance(few, workers, max_steps=0)
        best = replace(field, coefficients=fit.coefficients)
        self.misfit = offsets(best, clean)
        precision = to_vector(fit.prior.precision)
        self.noise, self.noise_without_prior = (
            self._drawn(best, few.equations.matrix + np.diag(
                share * precision), clean, offsets)
            for share in (1, WITHOUT_PRIOR))

    def _problem(self, image, error, stars):
        problem = read_sample(image, stars, error, None, self.radius,
                              None).problem(self.degree, False)
        problem.pixel_integrated = self.integrated
        return problem

    def _drawn(self, best, precision, clean, offsets):
        """Return what draws of the coefficients change, (draws, n, 2)."""
        covariance = np.linalg.inv(precision)
        root = np.linalg.cholesky((covariance + covariance.T) / 2)
        rng = np.random.default_rng(1)
        found = []
        for _ in range(DRAWS):
            change = to_coefficients(root @ rng.normal(size=len(root)),
                                     best.coefficients)
            drawn = replace(best, coefficients=best.coefficients
                            + STEP * change)
            found.append((offsets(drawn, clean) - self.misfit) / STEP)
        return np.array(found)

    def report(self, ideal, ratio):
        """
        Return the line.

        ``ideal`` (n, 2) are the errors with the true PSF, and
        ``ratio(errors)`` says how much larger others are.
        """
        def mean(noise, misfit):
            return np.mean([ratio(ideal + one + misfit) for one in noise])

        both = [mean(noise, self.misfit) for noise in (
            self.noise, self.noise_without_prior)]
        return (f'at best {both[0]:.2f} ({both[1]:.2f} without a prior): '
                f'misfit alone {ratio(ideal + self.misfit):.2f}, noise alone '
                f'{mean(self.noise, 0):.2f} '
                f'({mean(self.noise_without_prior, 0):.2f})')
