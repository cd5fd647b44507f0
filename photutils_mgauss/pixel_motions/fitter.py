"""
Motions of stars from the pixels of all epochs: the public class.

Lang, Hogg, Jester and Rix (2009, AJ 137, 4400) showed that a model of one
moving star for all images reaches the bound of the whole data.
"""
import warnings
from copy import copy
from dataclasses import replace
from functools import partial

import astropy.units as u
import numpy as np
from astropy.table import vstack
from astropy.utils.exceptions import AstropyUserWarning
from scipy.spatial import cKDTree

from photutils_mgauss.motions import MotionSolution
from photutils_mgauss.motions.frame_errors import FrameErrors
from photutils_mgauss.pixel_motions.campaign import read_campaign
from photutils_mgauss.pixel_motions.errors import (
    errors_of,
    frame_covariance,
    with_psf_errors,
)
from photutils_mgauss.pixel_motions.find import BRIGHT, Grid, candidates
from photutils_mgauss.pixel_motions.refine import refined
from photutils_mgauss.pixel_motions.solution import PixelMotionSolution
from photutils_mgauss.pixel_motions.solve import fwhm, solve
from photutils_mgauss.pixel_motions.stars import read_stars
from photutils_mgauss.pixel_motions.tables import (
    BAD_POSITION,
    NOT_CONVERGED,
    WANDERED,
    chi2_of,
    image_table,
    misfit_notes,
    shift_notes,
    star_table,
)
from photutils_mgauss.utils.validation import as_choice, as_real, as_shape
from photutils_mgauss.utils.waiting import waiting

UNSURE = NOT_CONVERGED | WANDERED | BAD_POSITION
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
        The solution that gave the WCS of the images: the covariance of its
        frames is added to that of each star. Without it the WCS count as
        exact.
    fit_shape : int or (ny, nx) tuple of int, optional
        The pixels of each star in each image.
    fit_sky : bool, optional
        Whether to fit a level of the sky for each star in each image.
    forced : bool, optional
        Whether to keep the given positions and motions and fit only the
        fluxes.
    executor : `~concurrent.futures.Executor`, optional
        The executor for the work; by default threads on all processors.
    progress_bar : bool, optional
        Whether to show a progress bar.
    flux : {'image', 'band', 'common'}, optional
        Whether a star has a flux for each image, for each band, or one
        flux in all images. Common fluxes make faint stars slightly more
        precise; they need images with the same scale and stars that do not
        vary.
    reach : float, optional
        The largest distance of a faint star from its given position and
        motion in each image, in units of the FWHM of the PSF, unless the
        data clearly show it farther away. Bright stars are free.
    refine_frames : bool, optional
        Whether to fit the frames of the images to the pixels of the bright
        stars, together with these stars: each WCS gets an affine map,
        which ``wcs`` of the solution includes. The common position and
        motion of all stars stay those of the WCS and ``references``.

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
    >>> for name in ('pmra', 'pmra_error'):
    ...     stars[name].info.format = '.2f'
    >>> stars['true_pmra'] = sources['pmra'].round(2)
    >>> stars['pmra', 'pmra_error', 'true_pmra'][:3].pprint()
      pmra   pmra_error true_pmra
    mas / yr  mas / yr   mas / yr
    -------- ---------- ---------
      -21.25       0.20    -20.87
      -19.20       0.21    -19.28
       -8.48       0.17     -8.51
    """

    def __init__(self, *, parallax=False, acceleration=False, references=None,
                 fit_shape=11, fit_sky=True, forced=False, executor=None,
                 progress_bar=False, flux='image', reach=0.75,
                 refine_frames=False):
        self.parallax = parallax
        self.acceleration = acceleration
        self.references = references
        self.fit_shape = fit_shape
        self.fit_sky = fit_sky
        self.forced = forced
        self.executor = executor
        self.progress_bar = progress_bar
        self.flux = flux
        self.reach = reach
        self.refine_frames = refine_frames
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
            The positions of the stars, to about a pixel: ``ra`` and
            ``dec`` [deg], at ``ref_epoch`` or else at the mean time of the
            images; optionally ``id``, ``pmra``, ``pmdec`` and
            ``parallax``. By default what `find` finds.

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
        with waiting('PixelMotionFitter.fit', self.progress_bar):
            if stars is None:
                stars = self.find(images)
            campaign = self._read(images, stars)
            listed = read_stars(stars, campaign)
            frames = None
            if self.refine_frames:
                campaign, frames = refined(campaign, partial(
                    self._stars, listed, reach=None))
            solution = self._solve(campaign, listed, frames)
        for sentence in solution.notes:
            warnings.warn(sentence, AstropyUserWarning, stacklevel=2)
        return solution

    def find(self, images, stars=None, *, max_motion=None,
             max_parallax=None, false_alarm=1e-5):
        """
        Search all images together for stars.

        Parameters
        ----------
        images : sequence of `ImageEpoch`
            As for `fit`; their fields must overlap.
        stars : `~astropy.table.Table` or SkyCoord, optional
            Known stars, which are fitted and subtracted first. They are
            not in the result.
        max_motion : `~astropy.units.Quantity`, optional
            The largest motion along each axis to search for; by default
            0.1 pixels per epoch. The time grows with its square.
        max_parallax : `~astropy.units.Quantity`, optional
            The largest parallax to search for, with ``parallax=True``; by
            default zero. Parallaxes below half a pixel need no search.
        false_alarm : float, optional
            The probability at each independent place that noise counts as
            a star.

        Returns
        -------
        `~astropy.table.QTable`
            ``id``, ``ra``, ``dec``, ``pmra``, ``pmdec``, the other columns
            of a fit of the stars, and ``evidence``, the signal-to-noise
            ratio of the search. Give it to `fit` as ``stars``.

        Raises
        ------
        TypeError, ValueError
            If an argument is not valid, or the images do not overlap.
        """
        self._check()
        as_real(false_alarm, 'false_alarm', above=0, maximum=0.5)
        largest = [None if value is None else _as_plain(value, name, unit)
                   for value, name, unit in (
                       (max_motion, 'max_motion', u.mas / u.yr),
                       (max_parallax, 'max_parallax', u.mas))]
        if max_parallax is not None and not self.parallax:
            msg = 'max_parallax must be given with parallax=True only'
            raise ValueError(msg)
        with waiting('PixelMotionFitter.find', self.progress_bar):
            campaign = self._read(images, stars)
            look = partial(candidates, campaign,
                           (largest[0], largest[1] or 0.0),
                           executor=self.executor)
            known = ([] if stars is None else
                     [self._solve(campaign, read_stars(stars, campaign))])
            bright = look(_light(campaign, known), threshold=BRIGHT)
            found = [self._found(campaign, bright)]
            faint = look(_light(campaign, known + found),
                         false_alarm=false_alarm)
            every = vstack([bright, _apart(campaign, faint, bright)])
            table = self._found(campaign, every).stars
        table['evidence'] = every['evidence']
        # What does not stay where it was found is no star.
        return table[(table['flags'] & UNSURE) == 0]

    def _found(self, campaign, table):
        """Return the solution of stars found."""
        fitter = copy(self)
        fitter.references, fitter.forced = None, False
        return fitter._solve(campaign, read_stars(table, campaign))

    def _read(self, images, stars):
        # Parallaxes of places that are given are part of them.
        given = self.forced and 'parallax' in getattr(stars, 'colnames', ())
        return read_campaign(images, flux=self.flux, fit_sky=self.fit_sky,
                             parallax=self.parallax or given,
                             acceleration=self.acceleration)

    def _stars(self, listed, campaign, reach):
        """Return the `Solved` of the stars listed."""
        return solve(campaign, listed.values,
                     as_shape(self.fit_shape, 'fit_shape'), reach=reach,
                     forced=self.forced, executor=self.executor,
                     progress_bar=self.progress_bar)

    def _solve(self, campaign, listed, frames=None):
        """Return the solution of the stars listed."""
        solved = self._stars(listed, campaign, self.reach)
        errors = self._errors(campaign, solved, frames)
        table = star_table(campaign, listed, solved, errors,
                           forced=self.forced, relative=self._is_relative())
        images = image_table(campaign, solved, errors)
        notes = campaign.notes + _coverage(campaign, solved)
        if frames is not None:
            notes += frames.notes
        shifts = () if self.forced else shift_notes(images)
        # An image that lies elsewhere explains what does not fit.
        notes += shifts or misfit_notes(table, campaign.estimated)
        return PixelMotionSolution(table, images, notes, campaign, listed,
                                   solved, errors)

    def _errors(self, campaign, solved, frames):
        """Return the `Errors` of pixels, PSFs and frames."""
        errors = errors_of(campaign, solved)
        if campaign.estimated:
            errors = _scaled(campaign, solved, errors)
        errors = with_psf_errors(campaign, solved, errors, as_shape(
            self.fit_shape, 'fit_shape'), self.executor)
        covariance = errors.covariance
        if frames is not None:
            covariance = covariance + frames.covariance(campaign, solved)
        if self.references is not None:
            covariance = covariance + frame_covariance(
                self._known_frames(), campaign, solved, errors.plain, frames)
        return replace(errors, covariance=covariance)

    def _known_frames(self):
        """Return the `FrameErrors` of the references."""
        if isinstance(self.references, FrameErrors):
            return self.references
        return FrameErrors.of(self.references)

    def _is_relative(self):
        return (self.references is not None
                and self._known_frames().relative)

    def _check(self):
        as_choice(self.flux, 'flux', FLUXES)
        as_real(self.reach, 'reach', above=0)
        as_shape(self.fit_shape, 'fit_shape')
        for name in ('parallax', 'acceleration', 'fit_sky', 'forced',
                     'progress_bar', 'refine_frames'):
            if not isinstance(getattr(self, name), bool):
                msg = (f'{name} must be True or False, got '
                       f'{getattr(self, name)!r:.80}')
                raise TypeError(msg)
        if self.refine_frames and self.forced:
            msg = 'refine_frames must be False with forced=True, got True'
            raise ValueError(msg)
        if not isinstance(self.references,
                          MotionSolution | FrameErrors | None):
            msg = ('references must be the MotionSolution that the WCS of the '
                   f'images come from, got {type(self.references).__name__}')
            raise TypeError(msg)
        if self.executor is not None and not hasattr(self.executor, 'map'):
            msg = ('executor must be a concurrent.futures.Executor, got '
                   f'{self.executor!r:.80}')
            raise TypeError(msg)


def _light(campaign, solutions):
    """Return x, y and flux (3, n) of solved stars in each image."""
    out = []
    for k in range(campaign.n_images):
        parts = [np.zeros((3, 0))]
        for one in solutions:
            solved = one._solved
            seen = solved.weights[:, k] > 0
            parts.append(np.stack([*solved.pixels[seen, k].T,
                                   solved.fluxes[seen, k]]))
        out.append(np.concatenate(parts, axis=1))
    return out


def _apart(campaign, faint, bright):
    """Return the faint candidates that are not what bright ones left over."""
    if not (len(faint) and len(bright)):
        return faint
    places = [read_stars(one, campaign).values[:, :2]
              for one in (faint, bright)]
    pixel = np.sqrt(abs(np.linalg.det(Grid.of(campaign).matrix)))
    radius = min(map(fwhm, campaign.epochs)) * pixel
    away, _ = cKDTree(places[1]).query(places[0])
    return faint[away > 0.7 * radius]


def _as_plain(value, name, unit):
    """Return a Quantity as a number of a unit, or raise."""
    try:
        value = u.Quantity(value, unit)
    except (TypeError, u.UnitConversionError) as error:
        msg = (f'{name} must be a Quantity like {unit}, got '
               f'{value!r:.80}')
        raise TypeError(msg) from error
    return as_real(float(value.value), name, minimum=0)


def _scaled(campaign, solved, errors):
    """
    Return errors scaled by the scatter of residuals, star by star.

    They are NaN where nothing is left over, as in an image of one value.
    """
    chi2, dof = chi2_of(campaign, solved)
    scatter = np.divide(chi2, dof, where=(dof > 0) & (chi2 > 0),
                        out=np.full(len(chi2), np.nan))
    return replace(errors, covariance=errors.covariance * scatter,
                   flux_error=errors.flux_error * np.sqrt(scatter)[:, None])


def _coverage(campaign, solved):
    """Return sentences on stars that images do not show."""
    seen = solved.weights > 0
    if len(seen) and not seen.any():
        return (NOBODY,)
    if len(seen) and campaign.has_times_enough and not solved.enough.any():
        return (NO_OVERLAP,)
    return ()
