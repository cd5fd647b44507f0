"""What a fit of proper motions found: motions, frames, and their errors."""
import warnings
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from astropy.utils.exceptions import AstropyUserWarning

from photutils_mgauss.motions.bootstrap import bootstrap_frames
from photutils_mgauss.motions.corrected_epochs import correct_epochs
from photutils_mgauss.motions.curvature import curvature_table
from photutils_mgauss.motions.detectors import detector_residuals
from photutils_mgauss.motions.doubts import doubts, remarks, unsolved
from photutils_mgauss.motions.loop import (
    Fit,
    fitted_terms,
    measured_alone,
)
from photutils_mgauss.motions.membership import mean_motion
from photutils_mgauss.motions.propagation import (
    propagated,
    propagated_parts,
    star_covariance,
)
from photutils_mgauss.motions.tables import (
    FLAGS,
    alignment_table,
    difference_table,
    mean_table,
    membership_table,
    residual_table,
    star_table,
    used_references,
)
from photutils_mgauss.sky.observers import ANY_YEAR, julian_years, tdb
from photutils_mgauss.utils.flags import decode
from photutils_mgauss.utils.notebook import with_table
from photutils_mgauss.utils.validation import as_integer, shown
from photutils_mgauss.utils.waiting import waiting


def decode_motion_flags(flags):
    """
    Return the meaning of the flags of stars, in sentences.

    Parameters
    ----------
    flags : int or array_like of int
        One flag, or the column ``flags`` of `MotionSolution.stars`.

    Returns
    -------
    list
        A sentence for each bit that is set; of an array, a nested list of
        its shape with such a list for each flag.

    Raises
    ------
    TypeError, ValueError
        If ``flags`` are not integers, or negative.

    Examples
    --------
    >>> from photutils_mgauss import decode_motion_flags
    >>> decode_motion_flags(8)
    ['outlier: a detection was rejected as an outlier']
    """
    return decode(flags, lambda flag: [
        sentence for bit, sentence in FLAGS.items() if flag & bit])


def solution_of(result, ref_epoch=None):
    """
    Return the `MotionSolution` of a `Fit`.

    ``ref_epoch`` is the Julian year of the positions; the default is the
    fit's own.
    """
    year = result.setup.working_year if ref_epoch is None else ref_epoch
    corrected, residuals = correct_epochs(result)
    stars = _stars_at(result, year)
    alignment = alignment_table(result, residuals)
    doubtful = (*unsolved(result, stars), *doubts(result))
    for sentence in doubtful:
        warnings.warn(sentence, AstropyUserWarning, stacklevel=3)
    notes = (*doubtful, *remarks(result), *result.frames.undetermined,
             *result.setup.notes, *result.setup.sightings.notes)
    return MotionSolution(stars, corrected, alignment, notes, result)


@dataclass(frozen=True, eq=False)
class MotionSolution:
    """
    Proper motions and the corrected frames of the epochs.

    Parameters
    ----------
    stars : `~astropy.table.QTable`
        One row per star, with the Gaia catalogue's column names: ``ra``,
        ``dec`` [deg] (``x``, ``y`` for planes without sky), ``parallax``
        [mas], ``pmra`` (including the cosine of the declination) and
        ``pmdec`` [mas / yr], an ``_error`` for each, the ten ``_corr``,
        ``ref_epoch`` (Julian year, TDB), ``n_obs``, ``n_good_obs``,
        ``visibility_periods_used``, ``chi2``, ``dof``, ``uwe``, ``ruwe``
        (relative to the usual value at the star's flux), ``flags`` (see
        `decode_motion_flags`); with accelerations ``accra``, ``accdec``,
        their errors, and ``acc_significance``, the length of that vector
        in its errors.
    epochs : list of `Epoch`
        The epochs given, with corrected WCS.
    alignment : `~astropy.table.QTable`
        One row per epoch: the map's shift and matrix, its coefficients,
        the references used and rejected, the rms of their residuals, and
        the systematic error found. ``left_out`` marks epochs with fewer
        references, or stars in common, than a map needs, which are not
        used; their maps are NaN, and the fit warns of them.
    notes : tuple of str
        Sentences about signs of wrong references (the fit also warns of
        these) or wrong errors, quantities that the data could not
        determine, data that the fit did not use, and epochs with few stars
        in common with the others.

    Examples
    --------
    >>> from photutils_mgauss import (
    ...     Epoch, Instrument, ProperMotionFitter, paper_exposures,
    ...     simulate_catalogues, sky_field)
    >>> sources = sky_field(30, 20, size=0.3, magnitudes=(20, 23),
    ...                     parallaxes=False, separation=0.5, rng=1)
    >>> epochs = [Epoch(one.table, one.wcs, one.time)
    ...           for one in simulate_catalogues(
    ...               sources, paper_exposures()[::3], rng=2,
    ...               instrument=Instrument(shape=(400, 400)))]
    >>> quasars = list(sources['id'][sources['kind'] == 'qso'])
    >>> solution = ProperMotionFitter(references=quasars).fit(epochs)
    >>> solution
    <MotionSolution: 50 of 50 stars, 3 epochs>
    >>> stars = solution.stars[solution.stars['reference'] == '']
    >>> for name in ('pmra', 'pmra_error', 'pmra_pmdec_corr'):
    ...     stars[name].info.format = '.2f'
    >>> stars['pmra', 'pmra_error', 'pmra_pmdec_corr'][:2].pprint()
      pmra   pmra_error pmra_pmdec_corr
    mas / yr  mas / yr
    -------- ---------- ---------------
        3.19       0.88            0.02
      -19.54       0.25            0.03
    >>> solution.residuals['epoch', 'dra', 'ddec'].colnames
    ['epoch', 'dra', 'ddec']

    Positions at another time, with the errors of then:

    >>> later = solution.at(2040.0)
    >>> for table in (solution.stars, later):
    ...     print(table['ra_error'][table['reference'] == ''][0].round(2))
    1.29 mas
    11.69 mas
    """

    stars: QTable
    epochs: list
    alignment: QTable
    notes: tuple
    _fit: Fit = field(repr=False)

    def __repr__(self):
        solved = int(np.isfinite(self.stars['pmra']).sum())
        return (f'<MotionSolution: {solved} of {len(self.stars)} stars, '
                f'{len(self.epochs)} epochs>')

    def _repr_html_(self):
        return with_table(repr(self), self.stars)

    @cached_property
    def residuals(self):
        """
        One row per detection, as a `~astropy.table.QTable`.

        The aligned position, its residual towards east and north, the
        residual from a fit without this detection, and its chi-square
        (with two degrees of freedom, including leverage).
        """
        return residual_table(self._fit)

    @cached_property
    def terms(self):
        """
        The terms that cross-validation confirmed, as a table.

        One row for each function of each epoch, a `~astropy.table.QTable`:
        to correct x and y of a detection [pix] (or positions on the sky,
        in their units), add ``dx``, ``dy`` times powers (``powers``) of
        magnitude, colour and row. The former are scaled by the middle and
        half range in ``meta``, within -1.5 and 1.5, the row by ``rows``.
        No rows where there are no terms.
        """
        return fitted_terms(self._fit)

    @property
    def sky(self):
        """
        The stars as a `~astropy.coordinates.SkyCoord` with motions.

        ICRS, at the reference epoch; None for planes without sky.
        """
        if 'ra' not in self.stars.colnames:
            return None
        return SkyCoord(self.stars['ra'], self.stars['dec'],
                        pm_ra_cosdec=self.stars['pmra'],
                        pm_dec=self.stars['pmdec'], frame='icrs',
                        obstime=tdb(self.stars['ref_epoch'][0].value))

    @waiting('MotionSolution.at')
    def at(self, time):
        """
        Return the stars at another epoch, with their covariances then.

        Parameters
        ----------
        time : `~astropy.time.Time` or float
            The new reference epoch.

        Returns
        -------
        `~astropy.table.QTable`
            Like ``stars``. Positions move along straight lines on the
            tangent plane, which are great circles; their errors grow with
            the time from the observed epochs, according to the
            correlations.
        """
        return _stars_at(self._fit, float(julian_years(
            time, within=ANY_YEAR)))

    def covariance(self, ids):
        """
        Return the covariances within and between some stars.

        Parameters
        ----------
        ids : (k,) array_like
            Identifiers of at most some hundred stars.

        Returns
        -------
        (k, p, k, p) `~numpy.ndarray`
            For the p parameters ``ra``, ``dec``, ``parallax`` (if fitted),
            ``pmra`` and ``pmdec`` at the reference epoch [mas, mas / yr].
            What two stars share is the error of the frames.

        Raises
        ------
        ValueError
            If a star is unknown, or motions are relative.
        """
        self._check_absolute('for covariances between stars')
        stars = _numbers_of(np.atleast_1d(ids), self.stars['id'])
        return star_covariance(self._fit, stars, self._year)

    @waiting('MotionSolution.mean')
    def mean(self, ids=None):
        """
        Return the mean motion of some stars, such as members of a cluster.

        Parameters
        ----------
        ids : (k,) array_like, optional
            Their identifiers; by default all stars but the references.

        Returns
        -------
        `~astropy.table.QTable`
            One row: ``pmra``, ``pmdec``, their errors and correlation,
            with the error of the frames, which all stars have in common;
            ``dispersion``, the scatter of the motions beyond their errors,
            and ``n``, the number of stars with motions.

        Raises
        ------
        ValueError
            If a star is unknown or none has a motion, or motions are
            relative, because the mean of all stars is then zero by
            definition.
        """
        self._check_absolute('for the mean of motions')
        stars = (np.flatnonzero(np.asarray(self.stars['reference']) == '')
                 if ids is None
                 else _numbers_of(np.atleast_1d(ids), self.stars['id']))
        stars = stars[np.isfinite(self.stars['pmra'][stars].value)]
        if not len(stars):
            msg = 'ids must hold a star with a motion, got none'
            raise ValueError(msg)
        return mean_table(len(stars), self.stars['pmra'].unit, *mean_motion(
            self._fit, stars, propagated(self._fit, self._year)))

    @waiting('MotionSolution.membership')
    def membership(self, *, n_field=1):
        """
        Return the probability of each star to move with a cluster.

        The method fits a mixture of a cluster and the field to the
        motions, each with its own covariance. It leaves out references.

        Parameters
        ----------
        n_field : int, optional
            The number of Gaussians of the field.

        Returns
        -------
        `~astropy.table.QTable`
            ``id`` and ``membership``, NaN for stars without a motion, in
            the order of ``stars``. Its ``meta`` has the fraction of
            members, their mean motion and dispersion.

        Raises
        ------
        TypeError, ValueError
            If ``n_field`` is not a positive integer, or too few stars have
            motions.

        Warns
        -----
        `~astropy.utils.exceptions.AstropyUserWarning`
            If the Gaussians still change after 2000 steps.
        """
        n_field = as_integer(n_field, 'n_field', minimum=1)
        return membership_table(self.stars, n_field)

    @waiting('MotionSolution.accelerations')
    def accelerations(self):
        """
        Test whether stars move on straight lines.

        The method fits an acceleration to the used detections of each star
        in the frames of the solution, and then also a jerk. It leaves out
        detections that were rejected as outliers, even if they are due to
        an acceleration: see ``clip`` of the fitter.

        Returns
        -------
        `~astropy.table.QTable`
            ``id``, in the order of ``stars``; ``accra``, ``accdec``, their
            errors and ``acc_significance``, fitted without a jerk;
            ``jerkra``, ``jerkdec``, their errors and
            ``jerk_significance``. A significance is the length of the
            vector in units of its errors; without any acceleration it
            exceeds 3 for one star in 90. NaN if there are too few
            detections: an acceleration takes three at different times, a
            jerk four, and a parallax one more.

        Examples
        --------
        >>> import numpy as np
        >>> from astropy.table import Table
        >>> from photutils_mgauss import Epoch, ProperMotionFitter
        >>> rng = np.random.default_rng(1)
        >>> place = rng.uniform(0, 900, (2, 40))
        >>> epochs = []
        >>> for year in range(2018, 2025):
        ...     x, y = place + rng.normal(0, 0.01, (2, 40))
        ...     x[7] += 0.02 * (year - 2021)**2 / 2
        ...     epochs.append(Epoch(Table({
        ...         'id': np.arange(40), 'x_fit': x, 'y_fit': y,
        ...         'x_err': np.full(40, 0.01), 'y_err': np.full(40, 0.01)}),
        ...         time=year))
        >>> fitter = ProperMotionFitter(references=range(20, 40), clip=None)
        >>> table = fitter.fit(epochs).accelerations()
        >>> bent = table[np.argmax(table['acc_significance'])]
        >>> print(bent['id'], bent['accra'].round(3))
        7 0.02 pix / yr2
        >>> print(f"{bent['acc_significance']:.1f}, "
        ...       f"{bent['jerk_significance']:.1f}")
        9.1, 0.4
        """
        return curvature_table(self._fit, self.stars['id'])

    def _check_absolute(self, purpose):
        if self._fit.setup.relative:
            msg = (f'references must be given {purpose}, got relative '
                   'motions')
            raise ValueError(msg)

    def validation(self):
        """
        Compare the references held out with their catalogue.

        Returns
        -------
        `~astropy.table.QTable`
            ``id``, ``dpmra`` and ``dpmdec`` (measured minus catalogue),
            their errors, those of the catalogue included, and ``chi2`` of
            two degrees of freedom.
        """
        return difference_table(self._fit, self.stars, self._fit.setup.held)

    def reference_differences(self):
        """
        Compare the references in use with their catalogue.

        Their motions are those of `measured`, for which the catalogue is
        only used to find the frames. Because the references define the
        frames, a small number of them agrees better than their errors.

        Returns
        -------
        `~astropy.table.QTable`
            As `validation`, with a row for each reference of known motion.
        """
        if self._fit.setup.relative:
            which = np.zeros(0, dtype=int)
        else:
            which = used_references(self._fit)
        return difference_table(self._fit, self.measured(), which)

    def detector_residuals(self):
        """
        Return the residuals in the pixels of the detectors.

        Returns
        -------
        `~astropy.table.QTable`
            With the rows of ``residuals``: ``chip``, the pixel ``x_pix``
            and ``y_pix``, and the residual ``dx_pix`` and ``dy_pix``.
            Detections that were given as positions on the sky have NaN.
        """
        return detector_residuals(self.residuals, self.epochs)

    @waiting('MotionSolution.bootstrap')
    def bootstrap(self, n_resamples=10000, *, rng=None):
        """
        Resample the reference objects to find the error of the frames.

        Parameters
        ----------
        n_resamples : int, optional
            Number of resamplings.
        rng : `~numpy.random.Generator` or int, optional
            Source of the random draws.

        Returns
        -------
        draws : object
            ``draws.shift`` (n_resamples, E, 2) is the change of each map
            at the centre of the field [mas], ``draws.motion``
            (n_resamples, 2) the common change of all motions [mas / yr].

        Raises
        ------
        TypeError, ValueError
            If ``n_resamples`` is not a positive integer.
        """
        n = as_integer(n_resamples, 'n_resamples', minimum=1)
        return bootstrap_frames(self._fit, n, rng)

    def plot_residuals(self, epoch, *, ax=None):
        """
        Draw the residuals of one epoch as arrows.

        Parameters
        ----------
        epoch : int
            Number of the epoch, from 0.
        ax : `~matplotlib.axes.Axes`, optional
            Where to draw; None is pyplot's current Axes.

        Returns
        -------
        `~matplotlib.axes.Axes`
        """
        from photutils_mgauss.plotting.motions import plot_residual_vectors
        return plot_residual_vectors(self, epoch, ax=ax)

    def plot(self, *, ax=None):
        """
        Plot the proper-motion diagram.

        Parameters
        ----------
        ax : `~matplotlib.axes.Axes`, optional
            Where to draw; None is pyplot's current Axes.

        Returns
        -------
        `~matplotlib.axes.Axes`
        """
        from photutils_mgauss.plotting.motions import plot_proper_motions
        return plot_proper_motions(self.stars, ax=ax)

    @property
    def _year(self):
        return float(self.stars['ref_epoch'][0].value)

    @waiting('MotionSolution.measured')
    def measured(self):
        """
        Return the stars as measured by the detections alone.

        The same table as ``stars``, in the same frames, but without the
        catalogue values of reference objects, so that you can compare the
        two.

        Returns
        -------
        `~astropy.table.QTable`
            With the rows and columns of ``stars``.
        """
        return _stars_at(measured_alone(self._fit), self._year)


def _stars_at(result, year):
    """Return the table of a fit's stars at a Julian year."""
    return star_table(result, year, propagated_parts(result, year))


def _numbers_of(ids, names):
    """Return the rows of identifiers in a column."""
    names = np.asarray(names)
    missing = ~np.isin(ids, names)
    if missing.any():
        msg = f'ids must be those of stars, got {shown(ids[missing][0])}'
        raise ValueError(msg)
    order = np.argsort(names)
    return order[np.searchsorted(names, ids, sorter=order)]
