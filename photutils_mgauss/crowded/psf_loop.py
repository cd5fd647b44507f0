r"""
The PSF of a crowded image and its stars, in turns.

A round PSF of the least blended stars finds the bright stars; these, all
others subtracted, tell a better one, which finds fainter stars, and so on.
The search goes deeper and the polynomials higher from pass to pass. Light
that a PSF misses is taken for faint stars and sky around the bright ones;
what is searched for is therefore well above that, and a pass does not go as
deep as photometry does afterwards.
"""
import warnings
from dataclasses import dataclass, field, replace

import numpy as np
from astropy.table import QTable, vstack
from astropy.utils.exceptions import AstropyUserWarning

from photutils_mgauss.crowded import psf_stars
from photutils_mgauss.crowded.far_light import far_light
from photutils_mgauss.field.base import lattice
from photutils_mgauss.field.choice import warn_of_few
from photutils_mgauss.field.fit import field_of_stars, with_light_beyond
from photutils_mgauss.field.options import FieldOptions
from photutils_mgauss.field.stages import n_terms
from photutils_mgauss.psf.local import LocalPSF
from photutils_mgauss.psf.renderer import MixtureRenderer
from photutils_mgauss.utils.image import with_unit
from photutils_mgauss.utils.waiting import progress

# The significance of the faintest stars of each pass; the last goes on. It is
# near that of photometry: where stars are dense, those not found would be
# taken for wings of the PSF.
_THRESHOLDS = (40.0, 25.0, 15.0, 10.0, 6.0)
# The radius of the stamps of the first passes [pix], while there are still
# many faint stars in the wings.
_RADII = (8.0, 12.0)
# In these, too, the sky is a little too bright everywhere, by the light of
# wings that are not yet in the PSF. Later it is known better from all stars
# together than from one stamp, which cannot tell it from a wing.
_OWN_SKY = 2
# Residuals below this many times the PSF's relative error are not taken for
# stars; the PSF is known no better than the least and no worse than the most.
_CAUTION, _LEAST_ERROR, _MOST_ERROR = 2.0, 0.01, 0.3
# 'auto' goes up to this degree, with so many stars for each term.
_TOP_DEGREE, _STARS_PER_TERM = 4, 40
# The PSF has come to rest when it changes by less than this from one pass to
# the next, as a fraction: even if it went on so slowly as to keep four fifths
# of each step, it would come no further than photometry says it may be off.
_REST = 2e-3
# Of larger images, so many windows of this size along an axis are solved:
# enough stars for a PSF [pix], of a wide one both are larger.
_LARGEST, _WINDOW, _WINDOWS = 1536, 320, 5
# Where the PSF of two passes is compared, and in so many steps from its
# centre. A step is a pixel, or larger in proportion for PSFs wider than this
# FWHM [pix].
_PLACES, _REACH, _USUAL_FWHM = (3, 3), 8, 3.0
# The first PSF is fitted again with longer lengths while it is wider than they
# are meant for by more than this factor.
_WIDER, _MOST_WIDER = 1.1, 8
# Stars are drawn out to where this fraction of the noise is left of them.
_FAINTEST = 1e-3


@dataclass(frozen=True)
class LoopOptions:
    """What `fit_crowded_psf` is told."""

    rules: psf_stars.Rules = field(default_factory=psf_stars.Rules)
    n_components: int = 6
    degree: object = 'auto'
    max_passes: int = 20
    progress_bar: bool = False

    def radius(self, number):
        """Return the radius of the stamps of a pass."""
        wide = self.rules.scale * np.array([*_RADII, np.inf])
        return min(wide[min(number, len(_RADII))], self.rules.radius)

    def widened(self, field):
        """Return the options for a PSF as wide as that of a field."""
        return replace(self, rules=self.rules.widened(scale_of(field)))

    def degree_of(self, number, n_stars):
        """Return the degree of a pass with so many stars."""
        top = _TOP_DEGREE if self.degree == 'auto' else self.degree
        degree = min(number, top)
        if self.degree == 'auto':
            while degree and n_stars < _STARS_PER_TERM * n_terms(degree):
                degree -= 1
        return degree

    def has_few(self, field):
        """Return whether a field is of too few stars for any slope."""
        return self.degree == 'auto' and self.degree_of(1, len(
            field.stars)) == 0

    def is_last_kind(self, number, degree, n_stars):
        """Tell whether later passes are no deeper, wider or higher."""
        return (number >= max(len(_THRESHOLDS) - 1, len(_RADII))
                and degree == self.degree_of(number + 1, n_stars))


@dataclass(frozen=True)
class CrowdedImage:
    """
    Data and variance (ny, nx), both 0 at bad pixels, and what is solved.

    ``windows`` are the parts (slice, slice) of the image that are looked at,
    ``gain`` the electrons per unit, infinite if the error has no photons of
    the stars in it; ``scale`` is by how much the PSF is wider than a narrow
    one.
    """

    pixels: object
    gain: float
    scale: float = 1.0

    @classmethod
    def of(cls, pixels, effective_gain):
        """Return the image with its gain, found out if it is not given."""
        gain = pixels.gain() if effective_gain is None else effective_gain
        return cls(pixels, np.inf if gain is None else float(gain))

    @property
    def shape(self):
        """The shape of the image."""
        return self.pixels.shape

    @property
    def windows(self):
        """The parts of the image that are solved, (slice, slice) each."""
        rows, columns = (_spread(n, self.scale) for n in self.shape)
        return [(row, column) for row in rows for column in columns]


def _spread(n, scale):
    """Return slices along an axis, all of a short one."""
    if n <= scale * _LARGEST:
        return [slice(0, n)]
    size = round(scale * _WINDOW)
    first = np.linspace(0, n - size, _WINDOWS).round().astype(int)
    return [slice(low, low + size) for low in first]


@dataclass(frozen=True)
class Solved:
    """
    An image solved with a PSF: its stars, and what is left of it.

    ``residual`` and ``variance`` (ny, nx) are of the data less all stars and
    the sky; the variance, 0 where nothing was solved, has the photon noise
    of the model. The sky has a node every ``spacing`` pixels of each of the
    ``windows`` (slice, slice), none if that is None.
    """

    table: QTable
    residual: np.ndarray
    variance: np.ndarray
    noise: float
    windows: list
    spacing: float | None

    @classmethod
    def with_psf(cls, image, psf, solve, **options):
        """Solve the windows of an image."""
        residual, variance = np.zeros(image.shape), np.zeros(image.shape)
        tables, noise = [], []
        for window in image.windows:
            data, before = image.pixels.part(window)
            if not (before > 0).any():
                continue
            photometry = solve(_moved(psf, window), effective_gain=image.gain,
                               **options)
            table, model = _solve_window(data, before, photometry)
            residual[window] = np.where(before > 0, data - model, 0)
            variance[window] = _of_model(before, residual[window], image.gain)
            tables.append(_in_image(table, window))
            noise.append(np.median(before[before > 0]))
        return cls(vstack(tables), residual, variance,
                   float(np.sqrt(np.median(noise))), image.windows,
                   photometry.background_size)

    def with_stars(self, psf, stars):
        """Return the data less the sky and all stars but these."""
        image = self.residual.copy()
        MixtureRenderer(psf).add(
            np.array([stars['x'], stars['y'], stars['flux']]),
            _FAINTEST * self.noise, 0, 0, image)
        image[self.variance == 0] = 0
        return image


def _solve_window(data, variance, photometry):
    """Return the stars of a window and the image of its model."""
    with warnings.catch_warnings():
        # That the PSF is not good yet is no news.
        warnings.simplefilter('ignore', AstropyUserWarning)
        table = photometry(data, error=np.sqrt(variance))
    return table, photometry.make_model_image(data.shape,
                                              include_local_bkg=True)


def _in_image(table, window):
    """Return stars in image pixels, with their distance to the border."""
    out = {name: np.asarray(table[name])
           for name in ('flux_fit', 'flux_err', 'reduced_chi2', 'crowding',
                        'flags')}
    margin = np.full(len(table), np.inf)
    for name, part in zip('xy', window[::-1], strict=True):
        place = np.asarray(table[f'{name}_fit'])
        out[f'{name}_fit'] = place + part.start
        margin = np.minimum.reduce([
            margin, place, part.stop - part.start - 1 - place])
    return QTable(out | {'margin': margin})


def _of_model(variance, residual, gain):
    """Return the variance with the photons of the model, not of the data."""
    good = variance > 0
    least = variance[good].min()
    return np.where(good, np.maximum(variance - residual / gain, least), 0)


def _moved(psf, window):
    """Return a grid in the coordinates of a window."""
    row, column = window
    return type(psf)(psf.mixtures, np.asarray(psf.grid_xypos)
                     - [column.start, row.start])


def fit_field(pixels, options, solve, effective_gain=None):
    """
    Fit a field to a crowded image.

    Parameters
    ----------
    pixels : PixelData
        With its error.
    options : LoopOptions
    solve : callable
        Given a `GriddedMixturePSF` and the keywords ``threshold``, ``depth``,
        ``psf_error`` and ``effective_gain``, it returns a
        `CrowdedMixturePhotometry`.
    effective_gain : float, optional

    Returns
    -------
    MixtureField
    """
    image = CrowdedImage.of(pixels, effective_gain)
    first, said = _unsaid(first_field, image, options.rules)
    passes, steady = [first], 0
    options = options.widened(passes[0])
    image = replace(image, scale=options.rules.scale)
    with progress(total=options.max_passes, desc='PSF',
                  shown=options.progress_bar) as bar:
        for number in range(options.max_passes):
            (field, solved), said = _unsaid(
                next_field, image, passes[-1], number, options, solve)
            change = difference(field, passes[-1])
            passes = [*passes[-2:], field]
            _advance(bar, field, change)
            # A pass that goes deeper than the one before does not tell how
            # they go on.
            steady += options.is_last_kind(number, field.degree,
                                           len(field.stars))
            if steady and (change < _REST
                           or (steady > 2 and turns_back(*passes))):
                _tell_of_few(field, passes[-2], solved, number, options)
                if options.has_few(field):
                    field, said = _unsaid(_of_few, solved, passes[-2],
                                          field.radius, options)
                break
        else:
            warnings.warn(
                f'the PSF still changes by {change:.2%} from pass to pass '
                f'after max_passes={options.max_passes}', AstropyUserWarning,
                stacklevel=4)
    for one in said:
        warnings.warn(one.message, stacklevel=4)
    return _with_unit(_with_far_light(field, passes[-2], solved), pixels.unit)


def _unsaid(fit, *args):
    """
    Return what a fit returns, and its warnings, which it does not give.

    Those of all passes but the last are of fields that nobody gets.
    """
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter('always', AstropyUserWarning)
        return fit(*args), said


def _with_far_light(field, before, solved):
    """Return the field with the light beyond its stamps, if it is seen."""
    wings = far_light(solved, grid_of(before), field.radius)
    return with_light_beyond(field, wings) if wings.is_seen else field


def _with_unit(field, unit):
    """Return the field with the unit of the image in its tables."""
    stars, dropped = field.stars.copy(), field.dropped.copy()
    for table, names in ((stars, ('flux_fit', 'local_bkg')),
                         (dropped, ('flux',))):
        for name in names:
            table[name] = with_unit(table[name], unit)
    return replace(field, stars=stars, dropped=dropped)


def scale_of(field):
    """Return by how much a field's PSF is wider than a narrow one."""
    return LocalPSF.of(grid_of(field)).scale


def first_field(image, rules):
    """Fit two Gaussians to stars, on stamps as large as they are wide."""
    for _ in range(_MOST_WIDER):
        field = _fit_first(image, rules)
        scale = scale_of(field)
        if scale <= _WIDER * rules.scale:
            break
        rules = rules.widened(scale)
    return field


def _fit_first(image, rules):
    """Fit two Gaussians, the same everywhere, to the least blended stars."""
    data, variance = np.zeros(image.shape), np.zeros(image.shape)
    parts = []
    for window in image.windows:
        data[window], variance[window] = image.pixels.part(window)
        good = variance[window] > 0
        if not good.any():
            continue
        data[window] -= np.where(good, np.percentile(data[window][good], 20),
                                 0)
        parts.append(_found_in(window, data[window], variance[window], rules))
    if not parts:
        msg = 'data must have pixels that are not bad, got none'
        raise ValueError(msg)
    stars = vstack(parts)
    _check_number(stars, rules)
    weak = np.argsort(-stars['merit'])[psf_stars.FIRST_STARS:]
    stars['selected'][weak] = False
    return field_of_stars(
        data, stars, np.sqrt(variance), None, FieldOptions(
            2, 0, rules.first_radius, local_bkg=True, normalise='stamps'))


def _found_in(window, data, variance, rules):
    """Return the stars of a window, at their places in the image."""
    start = np.array([window[1].start, window[0].start])
    if rules.given is not None:
        rules = replace(rules, given=rules.given - start)
    found = psf_stars.first_stars(data, variance, rules)
    for name, first in zip('xy', start, strict=True):
        found[name] += first
    return found


def next_field(image, field, number, options, solve):
    """
    Solve the image with a field, and fit the next one to its stars.

    Returns
    -------
    MixtureField
    Solved
    """
    rules = options.rules
    psf = grid_of(field)
    threshold = _THRESHOLDS[min(number, len(_THRESHOLDS) - 1)]
    psf_error = float(np.clip(_CAUTION * field.accuracy, _LEAST_ERROR,
                              _MOST_ERROR))
    solved = Solved.with_psf(image, psf, solve, threshold=threshold,
                             depth=threshold, psf_error=psf_error)
    stars = _judged(solved, field, rules)
    used = stars[stars['selected']]
    new = _fit(solved, psf, used, number, options)
    return _with_reasons(new, stars), solved


def _judged(solved, field, rules):
    """Return the bright stars of an image solved with a field."""
    stars = psf_stars.judge(solved.table, solved.variance,
                            max(field.accuracy, _LEAST_ERROR), rules)
    _check_number(stars, rules)
    return stars


def _fit(solved, psf, used, number, options):
    """Fit a field to some stars, all others taken off."""
    return field_of_stars(
        solved.with_stars(psf, used), used, np.sqrt(solved.variance), None,
        FieldOptions(
            options.n_components, options.degree_of(number, len(used)),
            options.radius(number), local_bkg=number < _OWN_SKY,
            effective_gain=np.inf, normalise='stamps'))


def _of_few(solved, before, radius, options):
    """
    Return the field of few stars as that of an image without neighbours.

    It has what few stars tell of slopes, and in its errors what they do not.
    """
    stars = _judged(solved, before, options.rules)
    used, n = stars[stars['selected']], options.n_components
    return _with_reasons(field_of_stars(
        solved.with_stars(grid_of(before), used), used,
        np.sqrt(solved.variance), None, FieldOptions(
            None if n == LoopOptions.n_components else n, None, radius,
            effective_gain=np.inf, normalise='stamps')), stars)


def _used(field):
    """Return the stars of a field that were used, as a list to fit."""
    used = field.stars['x_fit', 'y_fit', 'flux_fit'][field.stars['used']]
    used.rename_columns(used.colnames, ['x', 'y', 'flux'])
    return used


def _tell_of_few(field, before, solved, number, options):
    """Warn if fewer Gaussians than usual miss light that more would have."""
    def refit(n):
        return _fit(solved, grid_of(before), _used(field), number, replace(
            options, n_components=n, degree=field.degree))
    warn_of_few(field, refit, stacklevel=6)


def _with_reasons(field, stars):
    """Return the field with the bright stars that were not used, and why."""
    chosen = np.flatnonzero(stars['selected'])
    table, dropped = field.stars.copy(), stars.copy()
    table['id'] = chosen[np.asarray(table['id']) - 1] + 1
    dropped['id'] = np.arange(len(stars)) + 1
    late = np.asarray(field.dropped['id']) - 1
    dropped['reason'][chosen[late]] = field.dropped['reason']
    dropped = dropped[dropped['reason'] != '']
    return replace(field, stars=table, dropped=dropped[
        'id', 'x', 'y', 'flux', 'snr', 'crowding', 'reason'])


def _check_number(stars, rules):
    """Raise if there are too few stars for any PSF."""
    n = np.count_nonzero(stars['selected'])
    if n >= psf_stars.FEWEST:
        return
    reasons = [str(reason) for reason in stars['reason'] if reason]
    counts = ', '.join(f'{reasons.count(reason)} {reason}'
                       for reason in sorted(set(reasons)))
    msg = (f'data must show at least {psf_stars.FEWEST} stars good for the '
           f'PSF, got {n} of {len(stars)}'
           + (f': {counts}' if counts else '')
           + f'; lower min_snr={rules.min_snr:g} or radius={rules.radius:g}, '
             'or give a PSF from another exposure')
    raise ValueError(msg)


def grid_of(field):
    """Return the field on as many nodes as its degree asks for."""
    return field.to_grid(1 + 4 * field.degree)


def difference(field, other):
    """Return by what fraction the PSFs of two fields differ."""
    steps = np.arange(-_REACH, _REACH + 1.0)
    squares = []
    for place in zip(*lattice(_PLACES, field.shape), strict=True):
        mixtures = [one.mixture_at(*place) for one in (field, other)]
        step = max(mixtures[0].fwhm / _USUAL_FWHM, 1.0)
        x, y = np.meshgrid(step * steps, step * steps)
        new, old = (mixture.evaluate(x, y) for mixture in mixtures)
        squares.append(((new - old)**2).sum() / (new**2).sum())
    return float(np.sqrt(np.mean(squares)))


def turns_back(first, second, third):
    """
    Tell whether fields, the last of a row, no longer go one way.

    Around its end the row wanders as the chosen stars and the noise do. As
    long as it goes on in one direction it has not come there, however small
    its steps: wings, sky and faint stars of dense fields take many.
    """
    return difference(third, first)**2 < (difference(second, first)**2
                                          + difference(third, second)**2)


def _advance(bar, field, change):
    used = int(np.count_nonzero(field.stars['used']))
    bar.set_postfix(stars=used, degree=field.degree, change=f'{change:.2%}')
    bar.update()
