"""
What the shapes of a PSF depend on beside position, as the colour of a star.

Each context is a column of the table of stars. Its value, in standard
deviations from the mean of the stars, times polynomials of position are
further terms of the field: shapes depend linearly on it.
"""
from dataclasses import dataclass

import numpy as np
from astropy.stats import mad_std
from astropy.table import QTable

from photutils_mgauss.field.stages import polynomials
from photutils_mgauss.psf.contexts import NOT_CONTEXTS

# What a context does to shapes changes at most linearly over the detector.
_DEGREE = 1
# A residual is deviant beyond so many robust standard deviations.
_CLIP, _CLIP_STEPS = 5.0, 3


def context_names(contexts):
    """Return the names of contexts as a tuple, or raise."""
    names = (contexts,) if isinstance(contexts, str) else tuple(contexts)
    bad = [name for name in names if not isinstance(name, str)
           or not name.isidentifier() or name in NOT_CONTEXTS]
    if bad or len(set(names)) < len(names):
        msg = ('contexts must be different names of columns that are valid '
               f'identifiers and none of {", ".join(NOT_CONTEXTS)}, got '
               f'{names!r:.80}')
        raise ValueError(msg)
    return names


@dataclass(frozen=True)
class Contexts:
    """
    The scales of C contexts.

    Attributes
    ----------
    names : tuple of str
    mean, stddev, low, high : (C,) `~numpy.ndarray`
        Of the values of the stars that the PSF was fitted to.
    """

    names: tuple
    mean: np.ndarray
    stddev: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of_stars(cls, names, values):
        """Return the scales of the values (n, C) of stars."""
        for name, column in zip(names, values.T, strict=True):
            known = column[np.isfinite(column)]
            if known.size < 2 or np.ptp(known) == 0:
                msg = (f'contexts must differ between stars, got '
                       f'{np.unique(known).size} value(s) of {name!r} for '
                       f'{column.size} stars')
                raise ValueError(msg)
        return cls(names, *(np.atleast_1d(of(values, axis=0)) for of in (
            np.nanmean, np.nanstd, np.nanmin, np.nanmax)))

    @classmethod
    def of_table(cls, table):
        """Return what `to_table` made a table of."""
        return cls(tuple(str(name) for name in table['name']), *(
            np.asarray(table[name], float)
            for name in ('mean', 'stddev', 'low', 'high')))

    def to_table(self):
        """Return a table with a row for each context."""
        return QTable({'name': np.array(self.names, str), 'mean': self.mean,
                       'stddev': self.stddev, 'low': self.low,
                       'high': self.high})

    def scaled(self, values):
        """
        Return values (n, C) in standard deviations from the mean.

        Unknown ones (NaN) are the mean; those beyond the stars' are as the
        last of theirs.
        """
        scaled = ((np.clip(values, self.low, self.high) - self.mean)
                  / self.stddev)
        return np.nan_to_num(scaled)


def context_terms(scaled, u, v, degree):
    """
    Return the products of contexts (n, C) and polynomials, (n, X).

    Those of a context stand together; ``degree`` is that of the field.
    """
    terms = polynomials(u, v, min(degree, _DEGREE))
    return (scaled[:, :, None] * terms[:, None]).reshape(len(terms), -1)


def lateral_shifts(offsets, errors, smooth, terms):
    """
    Fit what moves stars along with their contexts.

    Parameters
    ----------
    offsets : (n, 2) `~numpy.ndarray`
        Measured positions less those that know nothing of contexts [pix].
    errors : (n,) `~numpy.ndarray`
        Of the measured ones.
    smooth : (n, T) `~numpy.ndarray`
        Polynomials for what stars of all contexts have in common.
    terms : (n, X) `~numpy.ndarray`

    Returns
    -------
    (X, 2) `~numpy.ndarray`
        The coefficients of the terms.
    """
    design = np.hstack([terms, smooth])
    scatter = np.zeros(2)
    kept = np.ones(len(design), bool)
    for _ in range(_CLIP_STEPS):
        found = np.column_stack([
            _least_squares(design[kept], offsets[kept, i],
                           errors[kept]**2 + scatter[i]**2)
            for i in range(2)])
        left = offsets - design @ found
        scatter = mad_std(left[kept], axis=0)
        kept = (np.abs(left) <= _CLIP * np.hypot(
            scatter, errors[:, None])).all(axis=1)
        # What the errors do not explain is in the other positions.
        scatter = np.sqrt(np.maximum(
            scatter**2 - np.median(errors[kept]) ** 2, 0))
    return found[:terms.shape[1]]


def _least_squares(design, target, variance):
    root = variance**-0.5
    return np.linalg.lstsq(design * root[:, None], target * root)[0]
