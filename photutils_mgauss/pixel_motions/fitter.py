"""
Motions of stars from the pixels of all epochs: the public class.

Lang, Hogg, Jester and Rix (2009, AJ 137, 4400) showed that a model of one
moving star for all images reaches the bound of the whole data.
"""
import warnings
from dataclasses import replace

import numpy as np
from astropy.utils.exceptions import AstropyUserWarning

from photutils_mgauss.motions import MotionSolution
from photutils_mgauss.pixel_motions.campaign import read_campaign
from photutils_mgauss.pixel_motions.errors import (
    errors_of,
    frame_covariance,
)
from photutils_mgauss.pixel_motions.solution import PixelMotionSolution
from photutils_mgauss.pixel_motions.solve import solve
from photutils_mgauss.pixel_motions.stars import read_stars
from photutils_mgauss.pixel_motions.tables import (
    chi2_of,
    image_table,
    shift_notes,
    star_table,
)
from photutils_mgauss.utils.validation import as_choice, as_shape

FLUXES = ('image', 'band', 'common')
NOBODY = ('No image shows any of the stars: the images lie elsewhere on the '
          'sky, or the WCS is not theirs.')
NO_OVERLAP = ('No star is shown by images of two times: the images do not '
              'overlap, and no motions can be fitted.')


class PixelMotionFitter:
    """
    Positions, motions and fluxes of stars from the pixels of all epochs.

    Parameters
    ----------
    parallax : bool, optional
        Whether parallaxes are fitted.
    acceleration : bool, optional
        Whether accelerations are fitted.
    references : `MotionSolution`, optional
        The solution that the WCS of the images come from: the covariance of
        its frames is added to that of each star. Without it the WCS are
        taken as they are.
    fit_shape : int or (ny, nx) tuple of int, optional
        The pixels of each star in each image.
    fit_sky : bool, optional
        Whether a level of the sky is fitted to each star in each image.
    forced : bool, optional
        Whether places and motions are those of the stars given, and only
        fluxes are fitted.
    executor : `~concurrent.futures.Executor`, optional
        Where the work is done; the default is threads on all processors.
    progress_bar : bool, optional
        Whether to show how far the work is.
    flux : {'image', 'band', 'common'}, optional
        What has a flux of its own: each image, each band, or nothing but
        the star. Fluxes in common make faint stars a little more precise;
        they need images of one scale and stars that do not vary.

    Examples
    --------
    >>> from photutils_mgauss import (
    ...     ImageEpoch, Instrument, paper_exposures, PixelMotionFitter,
    ...     simulate_epochs, sky_field)
    >>> sources = sky_field(4, 4, size=0.12, magnitudes=(20, 22),
    ...                     parallaxes=False, separation=1.0, rng=1)
    >>> images = [ImageEpoch(one.image, one.psf, one.wcs, one.time,
    ...                      error=one.error)
    ...           for one in simulate_epochs(
    ...               sources, paper_exposures()[::3], rng=2,
    ...               instrument=Instrument(shape=(200, 200)))]
    >>> stars = PixelMotionFitter().fit(images, sources['ra', 'dec']).stars
    >>> away = (stars['pmra'] - sources['pmra']) / stars['pmra_error']
    >>> bool((abs(away) < 4).all())
    True
    """

    def __init__(self, *, parallax=False, acceleration=False, references=None,
                 fit_shape=11, fit_sky=True, forced=False, executor=None,
                 progress_bar=False, flux='image'):
        self.parallax = parallax
        self.acceleration = acceleration
        self.references = references
        self.fit_shape = fit_shape
        self.fit_sky = fit_sky
        self.forced = forced
        self.executor = executor
        self.progress_bar = progress_bar
        self.flux = flux
        self._check()

    def __repr__(self):
        return (f'PixelMotionFitter(parallax={self.parallax!r}, '
                f'acceleration={self.acceleration!r}, forced={self.forced!r})')

    def fit(self, images, stars=None):
        """
        Fit stars to all images together.

        Parameters
        ----------
        images : sequence of `ImageEpoch`
            In any order, with any PSFs; their units are converted to that of
            the first.
        stars : `~astropy.table.Table` or `~astropy.coordinates.SkyCoord`
            Where the stars are, to a pixel or so: ``ra`` and ``dec`` [deg],
            at ``ref_epoch`` or else at the mean time of the images;
            optionally ``id``, ``pmra``, ``pmdec`` and ``parallax``. By
            default what `find` finds.

        Returns
        -------
        `PixelMotionSolution`

        Raises
        ------
        TypeError, ValueError
            If an argument is not valid.

        Warns
        -----
        AstropyUserWarning
            For each of the notes of the solution.
        """
        self._check()
        if stars is None:
            stars = self.find(images)
        campaign = self._read(images, stars)
        listed = read_stars(stars, campaign)
        solution = self._solve(campaign, listed)
        for sentence in solution.notes:
            warnings.warn(sentence, AstropyUserWarning, stacklevel=2)
        return solution

    def _read(self, images, stars):
        # Parallaxes of places that are given are part of them.
        given = self.forced and 'parallax' in getattr(stars, 'colnames', ())
        return read_campaign(images, flux=self.flux, fit_sky=self.fit_sky,
                             parallax=self.parallax or given,
                             acceleration=self.acceleration)

    def _solve(self, campaign, listed):
        """Return the solution of the stars listed."""
        known = np.isfinite(listed.values).all(axis=1)
        start = campaign.views(np.nan_to_num(listed.values)[:, None]).pixels
        solved = solve(campaign, listed.values,
                       as_shape(self.fit_shape, 'fit_shape'), self.forced,
                       self.executor)
        errors = errors_of(campaign, solved)
        if campaign.estimated:
            errors = _scaled(campaign, solved, errors)
        if self.references is not None:
            errors = replace(errors, covariance=errors.covariance
                             + frame_covariance(self.references, campaign,
                                                solved, errors.plain))
        table = star_table(campaign, listed, solved, errors, start[:, :, 0],
                           forced=self.forced, relative=self._is_relative())
        table['flags'][~known] |= 4
        images = image_table(campaign, solved, errors)
        notes = campaign.notes + _coverage(campaign, solved)
        if not self.forced:
            notes += shift_notes(images)
        return PixelMotionSolution(table, images, notes, campaign, listed,
                                   solved, errors)

    def _is_relative(self):
        return (self.references is not None
                and self.references._fit.setup.relative)

    def _check(self):
        as_choice(self.flux, 'flux', FLUXES)
        as_shape(self.fit_shape, 'fit_shape')
        for name in ('parallax', 'acceleration', 'fit_sky', 'forced',
                     'progress_bar'):
            if not isinstance(getattr(self, name), bool):
                msg = (f'{name} must be True or False, got '
                       f'{getattr(self, name)!r:.80}')
                raise TypeError(msg)
        if not isinstance(self.references, MotionSolution | None):
            msg = ('references must be the MotionSolution that the WCS of the '
                   f'images come from, got {type(self.references).__name__}')
            raise TypeError(msg)
        if self.executor is not None and not hasattr(self.executor, 'map'):
            msg = ('executor must be a concurrent.futures.Executor, got '
                   f'{self.executor!r:.80}')
            raise TypeError(msg)


def _scaled(campaign, solved, errors):
    """Return errors scaled by the scatter of residuals, star by star."""
    chi2, dof = chi2_of(campaign, solved)
    with np.errstate(divide='ignore', invalid='ignore'):
        scatter = np.where(dof > 0, chi2 / dof, np.nan)
    return replace(errors, covariance=errors.covariance * scatter,
                   flux_error=errors.flux_error * np.sqrt(scatter)[:, None])


def _coverage(campaign, solved):
    """Return sentences on stars that images do not show."""
    seen = solved.weights > 0
    if len(seen) and not seen.any():
        return (NOBODY,)
    if len(seen) and np.ptp(campaign.years) > 0 and not solved.enough.any():
        return (NO_OVERLAP,)
    return ()
