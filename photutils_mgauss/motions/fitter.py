"""
Proper motions from tables of several epochs, and frames that fit together.

Nie et al., Section 4.2 (``recipe='paper'``), and a joint solution of all
stars and all frames with exact covariances (``recipe='joint'``).
"""
from dataclasses import dataclass, field, replace
from functools import cached_property

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from photutils_mgauss.motions.assemble import (
    assemble,
    check_epochs,
    few_in_common,
    tie_planes,
)
from photutils_mgauss.motions.bootstrap import (
    bootstrap_frames,
    bootstrap_median,
)
from photutils_mgauss.motions.corrected_wcs import Correction, correct_epoch
from photutils_mgauss.motions.epoch import Epoch
from photutils_mgauss.motions.joint import Priors, solve_all
from photutils_mgauss.motions.loop import Fit, Options, fit, prepare
from photutils_mgauss.motions.matching import Tolerance
from photutils_mgauss.motions.paper_recipe import fit_paper
from photutils_mgauss.motions.tables import (
    FLAGS,
    alignment_table,
    residual_table,
    star_covariance,
    star_table,
    validation_table,
)
from photutils_mgauss.sky.observers import julian_years, observer_velocity, tdb
from photutils_mgauss.sky.transforms import Transform
from photutils_mgauss.utils.validation import as_choice, as_integer, as_real

__all__ = ['Epoch', 'MotionSolution', 'ProperMotionFitter',
           'bootstrap_median', 'decode_motion_flags']

RECIPES = ('joint', 'two-step', 'paper')
POINTING = 2000.0  # mas: offsets of exposures that are looked for


@dataclass(frozen=True)
class Match:
    """How epochs are matched; see `ProperMotionFitter`."""

    by: str
    radius: u.Quantity | None
    max_motion: u.Quantity

    def tolerance(self, unit):
        """Return the `Tolerance` in the units of a frame."""
        radius = None
        if self.radius is not None:
            radius = self.radius.to_value(u.Unit(unit))
        if unit == 'pix':
            return Tolerance(radius, 0.0, 20 * (radius or 0.0))
        pointing = POINTING if radius is None else max(POINTING, 2 * radius)
        return Tolerance(radius, self.max_motion.to_value(u.mas / u.yr),
                         pointing)


def decode_motion_flags(flags):
    """
    Return the sentences the flags of a star stand for.

    Parameters
    ----------
    flags : int
        A value of the column ``flags`` of `MotionSolution.stars`.

    Returns
    -------
    list of str

    Examples
    --------
    >>> from photutils_mgauss import decode_motion_flags
    >>> decode_motion_flags(8)
    ['outlier: a detection was rejected as an outlier']
    """
    return [sentence for bit, sentence in FLAGS.items()
            if int(flags) & bit]


@dataclass(frozen=True, eq=False)
class MotionSolution:
    """
    Proper motions, and the frames they were measured in.

    Parameters
    ----------
    stars : `~astropy.table.QTable`
        One row per star, with the Gaia catalogue's column names: ``ra``,
        ``dec`` [deg] (``x``, ``y`` for planes without sky), ``parallax``
        [mas], ``pmra`` (with the cosine of the declination in it) and
        ``pmdec`` [mas / yr], an ``_error`` for each, the ten ``_corr``,
        ``ref_epoch`` (Julian year, TDB), ``n_obs``, ``n_good_obs``,
        ``visibility_periods_used``, ``chi2``, ``dof``, ``uwe``, ``flags``
        (see `decode_motion_flags`).
    epochs : list of `Epoch`
        The epochs given, with corrected WCS.
    alignment : `~astropy.table.QTable`
        One row per epoch: the map's shift and matrix, its coefficients,
        the references used and rejected, the rms of their residuals, and
        the systematic error found.
    notes : tuple of str
        What the data could not determine, and which epochs have few stars
        in common with the others, in sentences.

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
    >>> solution.stars['pmra', 'pmra_error', 'pmra_pmdec_corr'].colnames
    ['pmra', 'pmra_error', 'pmra_pmdec_corr']
    >>> solution.residuals['epoch', 'dra', 'ddec'].colnames
    ['epoch', 'dra', 'ddec']

    Positions at another time, with the errors of then:

    >>> later = solution.at(2030.0)
    >>> bool((later['ra_error'] > solution.stars['ra_error']).all())
    True
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

    @cached_property
    def residuals(self):
        """
        One row per detection, as a `~astropy.table.QTable`.

        The aligned position, its residual towards east and north, what the
        residual would be had the detection not been used, and its
        chi-square (of two degrees of freedom, leverage taken into account).
        """
        return residual_table(self._fit)


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

    def at(self, time):
        """
        Return the stars at another epoch, with the covariances of then.

        Parameters
        ----------
        time : `~astropy.time.Time` or float
            The new reference epoch.

        Returns
        -------
        `~astropy.table.QTable`
            Like ``stars``. Positions move along straight lines on the
            tangent plane, which are great circles; their errors grow away
            from the epochs observed, as the correlations say.
        """
        return star_table(self._fit, float(julian_years(time)))

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
        if self._fit.scene.relative:
            msg = ('references must be given for covariances between '
                   'stars, got relative motions')
            raise ValueError(msg)
        stars = _numbers_of(np.atleast_1d(ids), self.stars['id'])
        return star_covariance(self._fit, stars, self._year)

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
        return validation_table(self._fit, self.stars)

    def bootstrap(self, n_resamples=10000, *, rng=None):
        """
        Resample the reference objects to see the error of the frames.

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
            (n_resamples, 2) that of all motions in common [mas / yr].

        Raises
        ------
        TypeError, ValueError
            If ``n_resamples`` is not a positive integer.
        """
        n = as_integer(n_resamples, 'n_resamples', minimum=1)
        return bootstrap_frames(self._fit, n, rng)

    def plot_residuals(self, ax, epoch):
        """
        Draw the residuals of one epoch as arrows.

        Parameters
        ----------
        ax : `~matplotlib.axes.Axes`
            Where to draw.
        epoch : int
            Number of the epoch, from 0.

        Returns
        -------
        `~matplotlib.axes.Axes`
            The same.
        """
        from photutils_mgauss.plotting import plot_residual_vectors
        return plot_residual_vectors(ax, self, epoch)

    def plot_motions(self, ax):
        """
        Plot the proper-motion diagram.

        Parameters
        ----------
        ax : `~matplotlib.axes.Axes`
            Where to draw.

        Returns
        -------
        `~matplotlib.axes.Axes`
            The same.
        """
        from photutils_mgauss.plotting import plot_proper_motions
        return plot_proper_motions(ax, self.stars)

    @property
    def _year(self):
        return float(self.stars['ref_epoch'][0].value)

    def measured(self):
        """
        Return the stars as the detections alone have them.

        The same table as ``stars``, in the same frames, but without what the
        catalogue says of each reference object: for comparing the two.

        Returns
        -------
        `~astropy.table.QTable`
            With the rows and columns of ``stars``.
        """
        result = self._fit
        if result.scene.relative:
            return self.stars.copy()
        alone = replace(result.problem,
                        priors=Priors.none(result.problem.n_parameters))
        estimates = solve_all(alone, result.frames.correction,
                              result.frames.factor,
                              result.scene.options.executor, residuals=True)
        return star_table(replace(result, problem=alone,
                                  estimates=estimates), self._year)


def _numbers_of(ids, names):
    """Return the rows of identifiers in a column."""
    names = np.asarray(names)
    missing = ~np.isin(ids, names)
    if missing.any():
        msg = f'ids must be those of stars, got {ids[missing][0]!r}'
        raise ValueError(msg)
    order = np.argsort(names)
    return order[np.searchsorted(names, ids, sorter=order)]


class ProperMotionFitter:
    """
    Proper motions of the stars in tables of several epochs.

    Parameters
    ----------
    transform : str or None, optional
        What may differ between the frames of the epochs: 'shift', 'rigid',
        'similarity', 'affine', 'poly-n' (a polynomial of degree n), or None
        for frames that are perfect already.
    parallax : {False, True, 'prior'}, optional
        Whether parallaxes are fitted; 'prior' adds the ``parallax_prior`` to
        stars of unknown parallax.
    recipe : {'joint', 'two-step', 'paper'}, optional
        'joint' solves for all stars and frames together; 'two-step' finds
        the frames from the references alone; 'paper' is the recipe of
        Nie et al., Eqs. 11-15, whose frames differ by shifts, whatever
        ``transform`` is, and which fits no parallaxes.
    references : `~astropy.table.Table`, sequence or str, optional
        Objects whose motions are known. A table with ``id`` or ``ra`` and
        ``dec`` (``x`` and ``y`` for planes), ``pmra``, ``pmdec``,
        ``parallax``, their ``_error`` and ``_corr``, ``ref_epoch``,
        ``radial_velocity``, and ``class``: 'qso' or 'galaxy' (motion and
        parallax zero), 'star', or 'position' (motion unknown; the default
        for rows without motion). Or identifiers of quasars and galaxies; or
        the name of a boolean column of the epochs that marks them. None
        makes all motions relative to the mean of the stars.
    ref_epoch : `~astropy.time.Time` or float, optional
        Epoch of the positions; the default is the mean time of the epochs.
    systematic : {'fit', None} or `~astropy.units.Quantity`, optional
        Error added in quadrature to each axis of every detection of an
        epoch: found from the scatter of the references, none, or given (one
        value, or one for each epoch).
    executor : `~concurrent.futures.Executor`, optional
        Where the work is done; the default is threads on all processors.
    match_by : {'auto', 'id', 'sky'}, optional
        How epochs are matched. 'auto' uses the column ``id`` if all epochs
        have one and equal identifiers are at equal places.
    match_radius : `~astropy.units.Quantity`, optional
        Largest distance of a match. The default follows from the errors
        and ``max_motion``.
    max_motion : `~astropy.units.Quantity`, optional
        Largest unknown motion considered when matching.
    clip : float or None, optional
        Detections and references are rejected beyond this many standard
        deviations; None keeps all.
    hold_out : float, optional
        Fraction of the references kept back for validation.
    parallax_prior : (2,) `~astropy.units.Quantity`, optional
        Mean and standard deviation of unknown parallaxes, for
        ``parallax='prior'``.
    acceleration : bool, optional
        Fit accelerations too.
    eps_t : {'printed', 'corrected'}, optional
        For the paper's recipe: Eq. 14 as printed, or the standard error of
        the references' mean residual.
    rng : `~numpy.random.Generator` or int, optional
        For choosing the references held out.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from photutils_mgauss import Epoch, ProperMotionFitter
    >>> rng = np.random.default_rng(1)
    >>> place, motion = rng.uniform(0, 1000, (2, 50)), rng.normal(size=(2, 50))
    >>> epochs = []
    >>> for year in (2020.0, 2022.0, 2025.0):
    ...     x, y = place + 0.01 * motion * (year - 2020)
    ...     epochs.append(Epoch(Table({
    ...         'id': np.arange(50), 'x_fit': x, 'y_fit': y,
    ...         'x_err': np.full(50, 0.001), 'y_err': np.full(50, 0.001)}),
    ...         time=year))
    >>> solution = ProperMotionFitter(transform='shift').fit(epochs)
    >>> solution
    <MotionSolution: 50 of 50 stars, 3 epochs>
    >>> pmra = solution.stars['pmra'].value
    >>> bool(np.ptp(pmra - 0.01 * motion[0]) < 1e-6)
    True
    """

    def __init__(self, *, transform='affine', parallax=False,
                 recipe='joint', references=None, ref_epoch=None,
                 systematic='fit', executor=None, match_by='auto',
                 match_radius=None, max_motion=50 * u.mas / u.yr, clip=5.0,
                 hold_out=0.0, parallax_prior=(0.5, 0.5) * u.mas,
                 acceleration=False, eps_t='printed', rng=None):
        self.transform = transform
        self.parallax = parallax
        self.recipe = recipe
        self.references = references
        self.ref_epoch = ref_epoch
        self.systematic = systematic
        self.executor = executor
        self.match_by = match_by
        self.match_radius = match_radius
        self.max_motion = max_motion
        self.clip = clip
        self.hold_out = hold_out
        self.parallax_prior = parallax_prior
        self.acceleration = acceleration
        self.eps_t = eps_t
        self.rng = rng
        self._options('mas')
        self._match()

    def __repr__(self):
        return (f'ProperMotionFitter(transform={self.transform!r}, '
                f'parallax={self.parallax!r}, recipe={self.recipe!r})')

    def fit(self, epochs):
        """
        Fit the motions of all stars and the frames of all epochs.

        Parameters
        ----------
        epochs : sequence of `Epoch`
            At least two, in any order.

        Returns
        -------
        `MotionSolution`

        Raises
        ------
        ValueError
            If the epochs have no time baseline or no stars in common, or
            an epoch has fewer references than its map needs.
        """
        epochs = check_epochs(epochs)
        sightings = assemble(epochs, self.references, self._match())
        options = self._options(sightings.unit)
        sightings = tie_planes(sightings,
                               [epoch.is_sky for epoch in epochs],
                               options.transform)
        scene, state = prepare(sightings, epochs, options)
        if options.recipe == 'paper':
            result = fit_paper(scene, state, self.eps_t)
        else:
            result = fit(scene, state)
        return self._solution(epochs, result)

    def _solution(self, epochs, result):
        year = result.scene.working_year
        if self.ref_epoch is not None:
            year = as_real(julian_years(self.ref_epoch, 'ref_epoch'),
                           'ref_epoch')
        corrected, residuals = _corrected(epochs, result)
        notes = (*result.frames.undetermined,
                 *few_in_common(result.scene.sightings))
        return MotionSolution(star_table(result, year), corrected,
                              alignment_table(result, residuals), notes,
                              result)

    def _match(self):
        as_choice(self.match_by, 'match_by', ('auto', 'id', 'sky'))
        _check_quantity(self.max_motion, 'max_motion', u.mas / u.yr)
        if self.match_radius is not None:
            _check_quantity(self.match_radius, 'match_radius', u.mas, u.pix)
        return Match(self.match_by, self.match_radius, self.max_motion)

    def _options(self, unit):
        as_choice(self.recipe, 'recipe', RECIPES)
        as_choice(self.eps_t, 'eps_t', ('printed', 'corrected'))
        if self.parallax not in (False, True, 'prior'):
            msg = (f"parallax must be False, True or 'prior', got "
                   f'{self.parallax!r}')
            raise ValueError(msg)
        clip = None if self.clip is None else as_real(self.clip, 'clip',
                                                      above=0)
        held = as_real(self.hold_out, 'hold_out', minimum=0, maximum=0.9)
        prior = _check_quantity(self.parallax_prior, 'parallax_prior',
                                u.mas).to_value(u.mas)
        if self.executor is not None and not hasattr(self.executor, 'map'):
            msg = ('executor must be a concurrent.futures.Executor, got '
                   f'{self.executor!r:.80}')
            raise TypeError(msg)
        return Options(Transform.parse(self.transform), self.recipe,
                       self.parallax, tuple(prior), bool(self.acceleration),
                       _systematic(self.systematic, unit), clip,
                       self._match().tolerance(unit).max_motion, held,
                       self.rng, self.executor)


def _corrected(epochs, result):
    """Return the epochs with corrected WCS, and the residuals of those."""
    scene = result.scene
    plane = scene.sightings.plane
    if plane is None or scene.transform.kind == 'none':
        return list(epochs), [np.nan] * len(epochs)
    pairs = [correct_epoch(
        epoch, Correction(plane, scene.transform, coefficients,
                          observer_velocity(epoch.observer)), tie)
             for epoch, coefficients, tie in zip(
                 epochs, result.state.maps, scene.sightings.ties,
                 strict=True)]
    return tuple(list(some) for some in zip(*pairs, strict=True))


def _check_quantity(value, name, *units):
    if not isinstance(value, u.Quantity) or not any(
            value.unit.is_equivalent(unit) for unit in units):
        words = ' or '.join(str(unit) for unit in units)
        msg = f'{name} must be a Quantity like {words}, got {value!r}'
        raise TypeError(msg)
    if not (np.isfinite(value).all() and (value >= 0 * value.unit).all()):
        msg = f'{name} must be finite and not negative, got {value}'
        raise ValueError(msg)
    return value


def _systematic(value, unit):
    if value is None:
        return 0.0
    if isinstance(value, str):
        return as_choice(value, 'systematic', ('fit',))
    return _check_quantity(value, 'systematic', u.mas,
                           u.pix).to_value(u.Unit(unit))
