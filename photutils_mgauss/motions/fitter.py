"""
Proper motions from tables of several epochs, and frames that fit together.

Nie et al., Section 4.2 (``recipe='paper'``), and a joint solution of all
stars and all frames with exact covariances (``recipe='joint'``).
"""
import astropy.units as u
import numpy as np

from photutils_mgauss.motions.assemble import assemble
from photutils_mgauss.motions.loop import fit
from photutils_mgauss.motions.matching import HowToMatch
from photutils_mgauss.motions.paper_recipe import fit_paper
from photutils_mgauss.motions.prepare import Options, prepare
from photutils_mgauss.motions.solution import solution_of
from photutils_mgauss.motions.terms import FUNCTIONS
from photutils_mgauss.sky.observers import julian_years
from photutils_mgauss.sky.transforms import Transform
from photutils_mgauss.utils.validation import as_choice, as_real
from photutils_mgauss.utils.waiting import waiting

RECIPES = ('joint', 'two-step', 'paper')
MATCH_BY = ('auto', 'id', 'sky', 'pattern')


class ProperMotionFitter:
    """
    Proper motions of the stars in tables of several epochs.

    Parameters
    ----------
    transform : str or None, optional
        How the frames of the epochs may differ: 'shift', 'rigid',
        'similarity', 'affine', 'poly-n' (a polynomial of degree n), or
        None for frames that need no correction.
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
        ``dec`` (for planes without WCS ``x`` and ``y``, or with
        ``match_by='pattern'`` also ``ra`` and ``dec``), ``pmra``, ``pmdec``,
        ``parallax``, their ``_error`` and ``_corr``, ``ref_epoch``,
        ``radial_velocity``, and ``class``: 'qso' or 'galaxy' (motion and
        parallax zero), 'star', or 'position' (motion unknown; the default
        for rows without motion). Positions with errors count as another
        epoch. Or identifiers of quasars and galaxies; or
        the name of a boolean column of the epochs that marks them. None
        makes all motions relative to the mean of the stars.
    ref_epoch : `~astropy.time.Time` or float, optional
        Epoch of the positions; the default is the mean time of the epochs.
    systematic : {'fit', 'magnitude', None} or Quantity, optional
        The error added in quadrature to each axis of every detection of an
        epoch: determined from the scatter of the references, none, or
        given (one value, or one for each epoch). 'magnitude' also
        multiplies the errors of each epoch by a smooth function of the
        magnitude, determined from the scatter of all stars. Use it if the
        errors are too small for some stars and too large for others.
    executor : `~concurrent.futures.Executor`, optional
        The executor for the work; by default threads on all processors.
    match_by : {'auto', 'id', 'sky', 'pattern'}, optional
        How epochs are matched. 'auto' uses the column ``id`` if all epochs
        have one and equal identifiers are at equal places, else positions,
        as 'sky' does. 'pattern' first finds the pointing of each epoch
        from the pattern of its bright stars: use it for lists without WCS,
        and for a WCS whose pointing is off by up to the field of view or
        whose roll is wrong.
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
    distortion : str or None, optional
        How the chips of `Epoch.of_chips` may differ from their WCS, the
        same in all exposures: 'affine', 'poly-n', or None for no
        difference.
    distortion_prior : `~astropy.units.Quantity`, optional
        The prior size of each of its terms at the edge of a chip.
    terms : str or sequence of str, optional
        The quantities on which displacements of detections may depend:
        'magnitude' and 'colour' (columns ``colour``, ``color`` or
        ``bp_rp``), with smooth functions of these, and 'y', along the rows
        of the detector, in proportion to the row and a function of
        magnitude, as with imperfect charge transfer. Terms that
        cross-validation does not confirm are left out; see
        `MotionSolution.terms`.

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
    >>> print(solution.stars['pmra'][:3].round(4))
    [ 0.004  -0.0058  0.0093] pix / yr
    >>> print((0.01 * (motion[0] - motion[0].mean()))[:3].round(4))
    [ 0.004  -0.0058  0.0093]
    """

    def __init__(self, *, transform='affine', parallax=False,
                 recipe='joint', references=None, ref_epoch=None,
                 systematic='fit', executor=None, match_by='auto',
                 match_radius=None, max_motion=50 * u.mas / u.yr, clip=5.0,
                 hold_out=0.0, parallax_prior=(0.5, 0.5) * u.mas,
                 acceleration=False, eps_t='printed', rng=None,
                 distortion='affine', distortion_prior=2 * u.arcsec, terms=()):
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
        self.distortion = distortion
        self.distortion_prior = distortion_prior
        self.terms = terms
        self._options()
        self._how_to_match()

    def __repr__(self):
        return (f'ProperMotionFitter(transform={self.transform!r}, '
                f'parallax={self.parallax!r}, recipe={self.recipe!r})')

    def fit(self, epochs):
        """
        Fit the motions of all stars and the frames of all epochs.

        Parameters
        ----------
        epochs : sequence of `Epoch`
            At least two, in any order; or one, or many of one time, with
            references that have positions of another time.

        Returns
        -------
        `MotionSolution`

        Raises
        ------
        ValueError
            If the epochs have no time baseline, neither with each other
            nor with positions of references, or have no stars in common,
            or if too few epochs have as many references as their maps
            need. Single epochs with fewer are left out with a warning.
        """
        options = self._options()
        with waiting('ProperMotionFitter.fit'):
            sightings = assemble(epochs, self.references, self._how_to_match(),
                                 options.transform, options.wanted)
            setup, state = prepare(sightings, options)
            result = (fit(setup, state) if options.recipe != 'paper'
                      else fit_paper(setup, state))
            return solution_of(result, self._ref_year())

    def _ref_year(self):
        if self.ref_epoch is None:
            return None
        return as_real(julian_years(self.ref_epoch, 'ref_epoch'),
                       'ref_epoch')

    def _how_to_match(self):
        as_choice(self.match_by, 'match_by', MATCH_BY)
        _check_quantity(self.max_motion, 'max_motion', u.mas / u.yr)
        if self.match_radius is not None:
            _check_quantity(self.match_radius, 'match_radius', u.mas, u.pix)
        return HowToMatch(self.match_by, self.match_radius, self.max_motion)

    def _options(self):
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
                       _systematic(self.systematic), clip, self.max_motion,
                       held, self.eps_t, self.rng, self.executor,
                       _distortion(self.distortion), _check_quantity(
                           self.distortion_prior, 'distortion_prior', u.mas),
                       _terms(self.terms))


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


def _distortion(value):
    kind = Transform.parse(value, 'distortion')
    if kind.kind not in ('none', 'affine', 'polynomial'):
        msg = ("distortion must be 'affine', 'poly-n' with a degree n > 0, "
               f'or None, got {value!r}')
        raise ValueError(msg)
    return kind


def _terms(value):
    """Return the kinds of terms as a tuple, in one order."""
    kinds = [value] if isinstance(value, str) else list(value or ())
    for kind in kinds:
        as_choice(kind, 'terms', tuple(FUNCTIONS))
    return tuple(kind for kind in FUNCTIONS if kind in kinds)


def _systematic(value):
    if value is None:
        return None
    if isinstance(value, str):
        return as_choice(value, 'systematic', ('fit', 'magnitude'))
    return _check_quantity(value, 'systematic', u.mas, u.pix)
