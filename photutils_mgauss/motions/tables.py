"""The tables of a solution, with the Gaia catalogue's column names."""
import astropy.units as u
import numpy as np
from astropy.table import MaskedColumn, QTable
from scipy.special import chdtri

from photutils_mgauss.motions.baseline import period
from photutils_mgauss.motions.joint import solve_all
from photutils_mgauss.motions.loop import references_in_use
from photutils_mgauss.motions.membership import fit_groups
from photutils_mgauss.motions.posing import measured
from photutils_mgauss.motions.propagation import FROM_OURS
from photutils_mgauss.motions.stacked import invert_2x2
from photutils_mgauss.sky.tangent_plane import directions
from photutils_mgauss.utils.star_columns import words_column

# The bit of a star whose motion is relative to its own field.
RELATIVE = 256

# What each bit of a star's flags means.
FLAGS = {
    1: ('no_solution: too few detections, or too short a time, for the '
        'parameters asked for; all are NaN'),
    2: ('bad_error: a detection had an error that is not positive, or a '
        'singular covariance; it has no weight'),
    4: ('bad_position: a detection had a position that is not finite, or '
        'outside the bounding box of the WCS; it is left out'),
    8: 'outlier: a detection was rejected as an outlier',
    16: ('ambiguous: another pairing of detections lay within the tolerance '
         'of the match, or an unrelated detection may lie there by chance'),
    32: ('reference_rejected: a reference object whose catalogue values the '
         'data contradict; it was treated as any other star'),
    64: 'held_out: a reference object kept back for validation',
    128: ('parallax_correlated: no parallax was fitted, and parallax and '
          'motion would correlate by more than 0.3: a parallax biases the '
          'motion'),
    RELATIVE: 'relative: motions are relative to the mean of the stars',
    512: ('inconsistent: the detections do not agree with one straight '
          'motion; the star was not used to tie the frames'),
    65536: ('not_converged: the fit to the pixels did not come to its end'),
    131072: ('position_only: the images that show the star were taken at too '
             'few times for a motion; it was held fixed'),
    262144: ('wandered: the fit to the pixels went farther from the place '
             'given than half a stamp'),
}
UCDS = {
    'id': 'meta.id;meta.main', 'ra': 'pos.eq.ra;meta.main',
    'dec': 'pos.eq.dec;meta.main', 'parallax': 'pos.parallax.trig',
    'pmra': 'pos.pm;pos.eq.ra', 'pmdec': 'pos.pm;pos.eq.dec',
    'x': 'pos.cartesian.x', 'y': 'pos.cartesian.y',
    'ref_epoch': 'meta.ref;time.epoch', 'n_obs': 'meta.number;obs',
    'n_good_obs': 'meta.number;obs', 'chi2': 'stat.fit.chi2',
    'dof': 'stat.fit.dof', 'uwe': 'stat.fit.goodness',
    'ruwe': 'stat.fit.goodness',
    'flux': 'phot.flux', 'flags': 'meta.code.qual',
    'radial_velocity': 'spect.dopplerVeloc', 'source_id': 'meta.id',
    'visibility_periods_used': 'meta.number;obs'}
GAIA = ('ra', 'dec', 'parallax', 'pmra', 'pmdec')
STRONG = 0.3
EACH = 50  # stars of like flux that tell what is usual
MOST_GROUPS = 100


def visibility_periods(sightings, used):
    """
    Return the number of groups of detections (n,), far apart in time.

    ``used`` (E, n) are those of the `Sightings` that count.
    """
    return groups_in_time(sightings.years, period(sightings.baseline), used)


def groups_in_time(years, gap, used):
    """Return the number of groups (n,), more than a gap [yr] apart."""
    order = np.argsort(np.nanmean(years, axis=1))
    last = np.full(used.shape[1], -np.inf)
    count = np.zeros(used.shape[1], dtype=int)
    for e in order:
        now = np.broadcast_to(years[e], used.shape[1])
        count += used[e] & (now - last > gap)
        last = np.where(used[e], now, last)
    return count


def used_references(fit):
    """Return the numbers of the references in use whose motion is known."""
    sightings = fit.setup.sightings
    left_out = np.union1d(fit.setup.held, fit.state.dropped)
    known = sightings.catalogue.kinds != 'position'
    numbers = sightings.references[known]
    return numbers[~np.isin(numbers, left_out)]


def difference_table(fit, stars, which):
    """
    Return the motions of references less those of their catalogue.

    ``stars`` is a table of all stars, ``which`` the numbers of references
    that say nothing in it.
    """
    sightings = fit.setup.sightings
    unit = u.Unit(sightings.unit) / u.yr
    year = float(stars['ref_epoch'][0].value)
    motion, covariance = _catalogue_motions(sightings, which, year)
    rows = stars[which]
    table = QTable({'id': rows['id']})
    away, errors = [], []
    for k, name in enumerate(('pmra', 'pmdec')):
        away.append(rows[name].to_value(unit) - motion[k])
        errors.append(np.sqrt(rows[f'{name}_error'].to_value(unit)**2
                              + covariance[k, k]))
        table[f'd{name}'] = away[k] * unit
        table[f'd{name}_error'] = errors[k] * unit
    cross = covariance[0, 1] + (rows['pmra_pmdec_corr']
                                * rows['pmra_error'].to_value(unit)
                                * rows['pmdec_error'].to_value(unit))
    a, b, c = invert_2x2(errors[0]**2, cross, errors[1]**2)
    x, y = away
    table['chi2'] = a * x * x + 2 * b * x * y + c * y * y
    return table


def _catalogue_motions(sightings, stars, year):
    """Return catalogue motions (2, k) and covariances in local axes."""
    place = {star: k for k, star in enumerate(sightings.references)}
    catalogue = sightings.catalogue.select([place[star] for star in stars])
    if sightings.unit == 'mas':
        catalogue = catalogue.at(year)
    motion = catalogue.motion()
    covariance = catalogue.covariance[2:4, 2:4] * ~catalogue.fixed
    if sightings.plane is not None:
        turn = sightings.plane.local_inverse(catalogue.values[:2])
        turn = np.where(np.isfinite(turn), turn, np.eye(2)[..., None])
        motion = np.einsum('ijn,jn->in', turn, motion)
        covariance = np.einsum('ijn,jkn,lkn->iln', turn, covariance, turn)
    return motion, covariance


def star_table(fit, ref_year, parameters):
    """
    Return the `~astropy.table.QTable` of the stars.

    ``parameters`` yields their values and covariances at ``ref_year``, see
    `~photutils_mgauss.motions.propagation.propagated_parts`.
    """
    sightings = fit.setup.sightings
    flags, solved = _flags(fit)
    table = QTable({'id': sightings.names, **_parameter_columns(
        fit, parameters, solved)}, copy=False)
    table['ref_epoch'] = np.full(len(table), ref_year) * u.yr
    _add_quality(table, fit, solved)
    if fit.leak is not None:
        flags |= _add_leak(table, fit.leak, solved)
    table['flux'] = sightings.flux
    if np.isfinite(sightings.radial_velocity).any():
        table['radial_velocity'] = sightings.radial_velocity * u.km / u.s
    table['reference'] = _reference_kinds(fit)
    _add_references(table, sightings)
    table['flags'] = flags
    _add_ucds(table)
    table.meta['TIMESYS'] = 'TDB'
    return table


def _parameter_columns(fit, parts, solved):
    """Return the columns of what is fitted, from some stars after others."""
    setup, columns = fit.setup, {}
    for some, values, covariance in parts:
        values[:, ~solved[some]] = np.nan
        covariance[..., ~solved[some]] = np.nan
        part = QTable()
        add_parameters(part, values, covariance,
                       u.Unit(setup.sightings.unit),
                       on_sky=setup.sightings.plane is not None,
                       parallax=bool(setup.options.parallax),
                       acceleration=setup.options.acceleration)
        for name, column in part.items():
            if name not in columns:
                empty = np.empty(len(solved))
                columns[name] = empty if column.unit is None else u.Quantity(
                    empty, column.unit, copy=False)
            columns[name][some] = column
    return columns


def add_parameters(table, values, covariance, unit, *, on_sky, parallax,
                   acceleration):
    """
    Add the columns of what is fitted to stars, in Gaia's order and names.

    Parameters
    ----------
    table : `~astropy.table.QTable`
    values, covariance : (p, n) and (p, p, n) `~numpy.ndarray`
        Position (in degrees on the sky), motion, parallax, acceleration;
        the last two where they were fitted.
    unit : `~astropy.units.UnitBase`
        Of errors, parallaxes and, per year, motions.
    on_sky, parallax, acceleration : bool
        Whether positions are on the sky, and what was fitted.
    """
    values, covariance, extra = _gaia_order(values, covariance, parallax,
                                            acceleration)
    sigma = [np.sqrt(covariance[k][k]) for k in range(5)]
    units = (unit, unit, unit, unit / u.yr, unit / u.yr)
    names, scale = (('ra', 'dec'), u.deg)
    if not on_sky:
        names, scale = ('x', 'y'), unit
    for name, value in zip(names, values, strict=False):
        table[name] = value * scale
    for k, name in enumerate(GAIA):
        if k > 1:
            table[name] = values[k] * units[k]
        table[f'{name}_error'] = sigma[k] * units[k]
    for i in range(5):
        for j in range(i + 1, 5):
            with np.errstate(invalid='ignore', divide='ignore'):
                rho = covariance[i][j] / (sigma[i] * sigma[j])
            table[f'{GAIA[i]}_{GAIA[j]}_corr'] = rho
    for k, name in enumerate(('accra', 'accdec')):
        if extra is not None:
            table[name] = extra[0][k] * unit / u.yr**2
            table[f'{name}_error'] = extra[1][k] * unit / u.yr**2
    if extra is not None:
        # As of the length of a vector; its square is a chi-square of two.
        table['acc_significance'] = extra[2]


def _gaia_order(values, covariance, has_parallax, acceleration):
    """Return five parameters in Gaia's order, and accelerations."""
    n = values.shape[1]
    extra = None
    if acceleration:
        last = covariance[-2, -2], covariance[-2, -1], covariance[-1, -1]
        a, b, c = invert_2x2(*last)
        x, y = values[-2:]
        extra = (values[-2:], np.sqrt(np.stack(last[::2])),
                 np.sqrt(a * x * x + 2 * b * x * y + c * y * y))
    size = 5 if has_parallax else 4
    nothing = np.full(n, np.nan)
    full = [values[k] if k < size else nothing for k in FROM_OURS]
    matrix = [[covariance[j, k] if max(j, k) < size else nothing
               for k in FROM_OURS] for j in FROM_OURS]
    return full, matrix, extra


def _flags(fit):
    """Return flags (n,) and which stars have a solution."""
    sightings, state = fit.setup.sightings, fit.state
    seen = sightings.matches.seen
    finite = np.isfinite(sightings.places).all(axis=0)
    solved = np.isfinite(fit.estimates.values).all(axis=0)
    periods = visibility_periods(sightings, state.used)
    solved &= (periods > 1) | ((fit.ranks > 1) & (periods > 0))
    stars = np.arange(len(solved))
    relative = fit.setup.relative and fit.setup.transform.kind != 'none'
    marks = {
        1: ~solved,
        2: (finite & ~sightings.usable & sightings.kept[:, None]).any(
            axis=0),
        4: (seen & ~finite).any(axis=0),
        8: (sightings.usable & ~state.used).any(axis=0),
        16: sightings.matches.ambiguous,
        32: np.isin(stars, state.dropped),
        64: np.isin(stars, fit.setup.held),
        512: state.untied,
        RELATIVE: np.full(len(solved), relative),
    }
    return sum(bit * mark.astype(int) for bit, mark in marks.items()), solved


def _add_quality(table, fit, solved):
    sightings, state = fit.setup.sightings, fit.state
    used = state.used.sum(axis=0)
    dof = fit.dof.astype(float)
    tested = solved & (dof > 0)
    table['n_obs'] = sightings.matches.seen.sum(axis=0)
    table['n_good_obs'] = used
    table['visibility_periods_used'] = visibility_periods(sightings,
                                                          state.used)
    table['chi2'] = np.where(tested, fit.chi2, np.nan)
    table['dof'] = np.where(tested, dof, np.nan)
    with np.errstate(invalid='ignore', divide='ignore'):
        table['uwe'] = np.sqrt(table['chi2'] / table['dof'])
    table['ruwe'] = _renormalised(table['chi2'], table['dof'],
                                  sightings.flux)


def _renormalised(chi2, dof, flux):
    """
    Return ``uwe`` over what is usual at the star's magnitude.

    Usual is the median of chi-squares over their expected medians, of stars
    next in flux, which binaries and blends do not move; NaN without fluxes
    or with too few stars.
    """
    known = np.flatnonzero((dof > 0) & (flux > 0) & np.isfinite(chi2))
    out = np.full(len(chi2), np.nan)
    n_groups = min(len(known) // EACH, MOST_GROUPS)
    if not n_groups:
        return out
    ratio = np.asarray(chi2)[known] / chdtri(np.asarray(dof)[known], 0.5)
    size = np.log(flux[known])
    groups = np.array_split(np.argsort(size), n_groups)
    at = [np.median(size[some]) for some in groups]
    usual = np.interp(size, at,
                      [np.median(ratio[some]) for some in groups])
    out[known] = np.sqrt(np.asarray(chi2)[known] / np.asarray(dof)[known]
                         / np.where(usual > 0, usual, np.nan))
    return out


def _add_leak(table, leak, solved):
    """Add what an ignored parallax does to the motion; return its flag."""
    correlation, bias = leak
    strongest = np.where(solved, np.abs(correlation).max(axis=0), np.nan)
    table['parallax_motion_corr'] = strongest
    for k, name in enumerate(('pmra', 'pmdec')):
        table[f'{name}_per_parallax'] = np.where(solved, bias[k],
                                                 np.nan) / u.yr
    return 128 * (np.nan_to_num(strongest) > STRONG).astype(int)


def _reference_kinds(fit):
    sightings, setup = fit.setup.sightings, fit.setup
    out = np.full(len(sightings.names), '', dtype='U8')
    out[sightings.references] = sightings.catalogue.kinds
    out[setup.held] = ''
    out[fit.state.dropped] = ''
    return words_column(out)


def _add_references(table, sightings):
    """Add where each reference object is in the table of references."""
    stars, catalogue = sightings.references, sightings.catalogue
    if (catalogue.rows < 0).any() or not len(stars):
        return
    rows = np.full(len(table), -1)
    rows[stars] = catalogue.rows
    table['reference_row'] = rows
    if catalogue.source_ids is not None:
        names = np.zeros(len(table), dtype=catalogue.source_ids.dtype)
        names[stars] = catalogue.source_ids
        table['source_id'] = MaskedColumn(names, mask=rows < 0)


def alignment_table(fit, wcs_residuals):
    """Return the `~astropy.table.QTable` of the epochs' maps."""
    setup, state = fit.setup, fit.state
    sightings, transform = setup.sightings, setup.transform
    unit = u.Unit(sightings.unit)
    centre = np.array(transform.centre)[:, None]
    shift, slope, errors = [], [], []
    maps = _known_maps(fit)
    for e, coefficients in enumerate(maps):
        shift.append(_whole_shift(transform, coefficients, centre,
                                  sightings.ties.maps[e]))
        slope.append(_whole_slope(transform, coefficients, centre,
                                  sightings.ties.maps[e]))
        errors.append(_shift_errors(fit, e))
    counts = _counts(fit)
    table = QTable()
    table['epoch'] = np.arange(len(state.maps))
    table['time'] = sightings.times
    table['shift'] = np.array(shift) * unit
    table['shift_error'] = np.array(errors) * unit
    table['matrix'] = np.array(slope)
    table['coefficients'] = maps * unit
    for name, values in counts.items():
        table[name] = values
    floor = np.broadcast_to(state.floor.T, (2, len(state.maps))).T
    floor = np.where(sightings.left_out[:, None], np.nan, floor)
    table['systematic'] = np.sqrt(floor) * unit
    if state.scales is not None:
        _add_scales(table, fit)
    table['wcs_residual'] = np.array(wcs_residuals) * u.mas
    table['left_out'] = sightings.left_out
    table.meta.update(kind=transform.kind, degree=transform.degree,
                      xcentre=transform.centre[0],
                      ycentre=transform.centre[1], scale=transform.scale)
    return table


def mean_table(n, unit, mean, covariance, dispersion):
    """Return the one row of a mean motion."""
    error = np.sqrt(np.diag(covariance))
    return QTable({
        'pmra': [mean[0]] * unit, 'pmra_error': [error[0]] * unit,
        'pmdec': [mean[1]] * unit, 'pmdec_error': [error[1]] * unit,
        'pmra_pmdec_corr': [covariance[0, 1] / error.prod()],
        'dispersion': [dispersion] * unit, 'n': [n]})


def membership_table(stars, n_field):
    """Return the probabilities of stars to belong to a cluster."""
    motion = np.stack([stars[name].value for name in ('pmra', 'pmdec')], 1)
    error = np.stack([stars[f'{name}_error'].value
                      for name in ('pmra', 'pmdec')], 1)
    covariance = error[:, :, None] * error[:, None, :]
    covariance[:, 0, 1] *= stars['pmra_pmdec_corr']
    covariance[:, 1, 0] *= stars['pmra_pmdec_corr']
    use = (np.isfinite(covariance).all(axis=(1, 2))
           & np.isfinite(motion).all(axis=1))
    free = use & (np.asarray(np.ma.filled(stars['reference'], '')) == '')
    groups = fit_groups(motion[free], covariance[free], n_field)
    terms = groups.densities(motion[use], covariance[use])
    probability = np.full(len(stars), np.nan)
    probability[use] = np.exp(terms[0] - np.logaddexp.reduce(terms, axis=0))
    table = QTable({'id': stars['id'], 'membership': probability})
    table['membership'].info.meta = {'ucd': 'stat.probability'}
    sigma = np.sqrt(np.trace(groups.covariance[0]) / 2)
    table.meta.update(
        unit=str(stars['pmra'].unit), fraction=float(groups.fraction[0]),
        pmra=float(groups.mean[0, 0]), pmdec=float(groups.mean[0, 1]),
        dispersion=float(sigma))
    return table


def _add_ucds(table):
    """Say what columns are as the Virtual Observatory does."""
    for name in table.colnames:
        stem = name.removesuffix('_error')
        if stem in UCDS:
            ucd = UCDS[stem]
        elif name.endswith('_corr'):
            ucd = 'stat.correlation'
        else:
            continue
        if stem != name:
            ucd = f'stat.error;{ucd.removesuffix(";meta.main")}'
        table[name].info.meta = {'ucd': ucd}


def _add_scales(table, fit):
    """Add what multiplies the errors of epochs, at some magnitudes."""
    ends = np.nanquantile(fit.setup.magnitudes, [0.02, 0.98])
    magnitudes = np.tile(np.linspace(*ends, 9), (len(table), 1))
    table['error_magnitude'] = magnitudes
    factor, added = fit.state.scales.at(magnitudes)
    table['error_factor'] = np.sqrt(factor)
    table['error_floor'] = np.sqrt(added) * table['systematic'].unit


def _known_maps(fit):
    """Return the maps (E, 2, b), NaN for epochs that were left out."""
    return np.where(fit.setup.sightings.left_out[:, None, None], np.nan,
                    fit.state.maps)


def _whole_shift(transform, coefficients, centre, tie):
    """Return the shift at the centre, or for a tied plane that of (0, 0)."""
    if tie is not None:
        return transform.apply(coefficients, tie[:, :1])[:, 0]
    return (transform.apply(coefficients, centre) - centre)[:, 0]


def _whole_slope(transform, coefficients, centre, tie):
    slope = transform.jacobian(coefficients, centre)[..., 0]
    return slope if tie is None else slope @ tie[:, 1:]


def _shift_errors(fit, e):
    """Return the errors of a map's shift at the centre of the field."""
    b = fit.setup.transform.n_terms
    if fit.setup.sightings.left_out[e]:
        return np.full(2, np.nan)
    covariance = fit.frames.covariance(e)
    return np.sqrt(np.diag(covariance)[[0, b]])


def _counts(fit):
    """Return the references used and rejected, and their rms, by name."""
    setup, state = fit.setup, fit.state
    sightings = setup.sightings
    used = state.used & references_in_use(setup, state)
    lost = sightings.usable & ~state.used & setup.anchors
    lost |= sightings.usable & np.isin(np.arange(used.shape[1]), state.dropped)
    return {'n_references': used.sum(axis=1), 'n_rejected': lost.sum(axis=1),
            'rms': fit.rms * u.Unit(sightings.unit)}


def residual_table(fit):
    """Return the `~astropy.table.QTable` of all detections."""
    setup, sightings = fit.setup, fit.setup.sightings
    epoch, star = np.nonzero(sightings.matches.seen)
    at = (epoch, star)
    full = solve_all(fit.problem, fit.frames.correction, fit.frames.factor,
                     setup.options.executor, residuals=True, leverage=True,
                     judge=True)
    covariance = np.stack([measured(setup, fit.state, e)
                           for e in range(len(fit.state.maps))], axis=1)
    unit = u.Unit(sightings.unit)
    finite = np.isfinite(sightings.places).all(axis=0)
    table = QTable({'epoch': epoch, 'id': sightings.names[star],
                    'row': sightings.matches.rows[at]})
    years = np.broadcast_to(sightings.years, finite.shape)[at]
    table['time'] = years * u.yr
    _add_aligned(table, fit, at, unit)
    finite &= sightings.kept[:, None]
    residual = np.where(finite, full.residuals, np.nan)
    left_out = _leave_one_out(full, covariance)
    for k, name in enumerate(('dra', 'ddec')):
        table[name] = residual[k][at] * unit
        table[f'{name}_error'] = np.sqrt(covariance[2 * k][at]) * unit
        table[f'{name}_left_out'] = left_out[k][at] * unit
    table['chi2'] = full.chi2[at]
    table['used'] = fit.state.used[at]
    return table


def _add_aligned(table, fit, at, unit):
    setup, sightings = fit.setup, fit.setup.sightings
    places = setup.undistorted(fit.state)
    aligned = np.stack([setup.transform.apply(one, places[:, e])
                        for e, one in enumerate(_known_maps(fit))], axis=1)
    if sightings.plane is not None:
        ra, dec = directions(sightings.plane.deproject(aligned))
        table['ra'], table['dec'] = ra[at] * u.deg, dec[at] * u.deg
    else:
        table['x'], table['y'] = (axis[at] * unit for axis in aligned)


def _leave_one_out(estimates, covariance):
    """Return residuals (2, E, n) from fits without the detection itself."""
    x, y = estimates.residuals
    left = invert_2x2(*(covariance - estimates.predicted))
    xx, xy, yy = covariance
    # Infinite where a detection alone fixes its star: left out below.
    with np.errstate(invalid='ignore'):
        a, b = left[0] * x + left[1] * y, left[1] * x + left[2] * y
        out = np.stack([xx * a + xy * b, xy * a + yy * b])
    return np.where(np.isfinite(estimates.chi2), out, np.nan)
