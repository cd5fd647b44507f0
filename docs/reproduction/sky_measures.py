"""Seven exposures of stars and quasars: what Figs. 8 to 12 show."""
from dataclasses import dataclass, field, replace

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable, Table
from scenes import catalogue, detector, through_files
from settings import CAMPAIGNS, PIXEL, effects
from store import binned, spread

from photutils_mgauss import (
    Epoch,
    Exposure,
    Instrument,
    ProperMotionFitter,
    bootstrap_median,
    paper_exposures,
    simulate,
    sky_field,
)

EDGES = np.arange(18, 27)
MODELS = {'paper': 'K = 3 from the empirical PSF', 'field': 'mixture field'}
COORDINATES = {'ra': r'$\alpha^*$', 'dec': r'$\delta$'}
MOTIONS = {'pmra': r'$\mu_{\alpha*}$', 'pmdec': r'$\mu_\delta$'}

# The ways from positions to motions. Those of the paper start from frames
# that the joint solution has corrected: their own maps are shifts.
RECIPES = {
    'joint': 'joint solution',
    'paper, as printed': 'Eqs. 11-15, as printed',
    'paper, corrected': 'Eqs. 11-15, Eq. 14 corrected',
}
# Errors of what a catalogue says of the reference quasars: of motions and
# parallaxes [mas/yr and mas], and of positions [mas].
REFERENCE_ERROR, PLACE_ERROR = 0.1, 0.5


def sources(run):
    """Return stars and quasars on the sky, with motions and parallaxes."""
    arcmin = min(run.settings.sky_shape) * PIXEL / 60
    return sky_field(*run.settings.sources, size=arcmin, separation=1.2,
                     rng=31 + 1000 * run.seed)


def exposures(run):
    """Return the seven of Table 2, with all that displaces stars."""
    return paper_exposures(offset=0.7, aberration=True,
                           rng=2 + 1000 * run.seed)


def measure(run):
    """Return what the seven exposures give."""
    catalogues = Catalogues(run)

    def motions():
        return run.table('motions', lambda: _motions(run, catalogues),
                         keep=False)
    return {'run': run,
            'found': run.table('fig8_found',
                               lambda: _found(run, catalogues)),
            'epochs': run.table('fig8_epochs',
                                lambda: _epochs(run, catalogues)),
            'positions': run.table('fig9_10_positions',
                                   lambda: _positions(run, catalogues)),
            'medians': run.table('fig11_medians',
                                 lambda: _medians(run, motions())),
            'by_magnitude': run.table('fig11_by_magnitude',
                                      lambda: _by_magnitude(motions())),
            'bins': run.table('fig12_bins', lambda: _bins(run, motions()))}


@dataclass(frozen=True)
class Catalogues:
    """What was measured of each exposure, by its number and the model."""

    run: object
    solved: dict = field(default_factory=dict)

    def __getitem__(self, key):
        number, wanted = key
        # With all models while the exposure is in memory.
        return {name: self.run.table(
            f'epoch_{number}_{name}',
            lambda name=name: _observe(self.run, number, name),
            keep=False) for name in MODELS}[wanted]

    def solution(self, name, which):
        """Return the joint solution of some of the exposures, made once."""
        key = name, tuple(which)
        if key not in self.solved:
            self.solved[key] = _solve(self.run, self, *key)
        return self.solved[key]


# Positions

_scenes = {}


def _scene(run, number):
    """Return one exposure of the field."""
    key = run.fingerprint, number
    if key not in _scenes:
        _scenes.clear()
        exposure, shape = exposures(run)[number], run.settings.sky_shape
        one = detector(run, exposure.detector, shape)
        _scenes[key] = through_files(simulate(
            sources(run), exposure, psf=one.light, effects=effects(),
            rng=300 + number + 1000 * run.seed,
            instrument=Instrument(shape=shape)))
    return _scenes[key]


def _observe(run, number, name):
    """Return the catalogue of one exposure, from its pixels alone."""
    one = detector(run, exposures(run)[number].detector,
                   run.settings.sky_shape)
    table = catalogue(_scene(run, number), one.models[name])
    out = QTable({column: np.asarray(table[column], float) for column in
                  ('x_fit', 'x_err', 'y_fit', 'y_err', 'flux_fit')})
    # Numbers of this exposure only: who is who is found on the sky.
    out['id'] = [f'{number}-{row}' for row in range(len(out))]
    return out


def _nominal(run, number):
    """Return the exposure as the header has it: TAN, where it should be."""
    taken = exposures(run)[number]
    return Exposure(taken.time, taken.band, detector=taken.detector)


def _epoch(run, table, number):
    """Return what the fitter is given of one exposure."""
    taken, shape = _nominal(run, number), run.settings.sky_shape
    return Epoch(Table({name: table[name] for name in table.colnames
                        if name != 'id'}),
                 taken.wcs(shape, PIXEL), taken.time)


def references(run):
    """Return the quasars that tie the epochs, with errors of everything."""
    truth, rng = sources(run), np.random.default_rng(33 + 1000 * run.seed)
    quasars = np.flatnonzero(truth['kind'] == 'qso')
    chosen = rng.choice(quasars, run.settings.references, replace=False)
    table = QTable({'id': truth['id'][chosen]})
    places = SkyCoord(truth['ra'][chosen], truth['dec'][chosen])
    moved = places.spherical_offsets_by(*(
        PLACE_ERROR * rng.standard_normal((2, len(chosen))) * u.mas))
    table['ra'], table['dec'] = moved.ra, moved.dec
    for name in ('ra_error', 'dec_error'):
        table[name] = np.full(len(chosen), PLACE_ERROR) * u.mas
    for name, unit in (('pmra', u.mas / u.yr), ('pmdec', u.mas / u.yr),
                       ('parallax', u.mas)):
        noise = REFERENCE_ERROR * rng.standard_normal(len(chosen))
        table[name] = noise * unit
        table[f'{name}_error'] = np.full(len(chosen), REFERENCE_ERROR) * unit
    table['class'] = 'star'
    table['ref_epoch'] = truth['ref_epoch'][chosen].to_value(u.yr)
    return table


def _solve(run, catalogues, name, which):
    """Return the joint solution of some of the exposures."""
    fitter = ProperMotionFitter(
        transform='poly-3', parallax='prior', match_by='pattern',
        references=references(run))
    return fitter.fit([_epoch(run, catalogues[i, name], i) for i in which])


def _true_places(run, number):
    """Return where sources are on the sky at an epoch, aberration apart."""
    ideal = replace(_nominal(run, number), aberration=False)
    shape, truth = run.settings.sky_shape, sources(run)
    x, y = ideal.pixels(truth, shape, PIXEL)
    ra, dec = ideal.wcs(shape, PIXEL)(x, y, with_bounding_box=False)
    return SkyCoord(ra, dec, unit='deg')


def _same(found, true, limit=0.25):
    """Return rows of two lists of places that are one source [arcsec]."""
    nearest, distance, _ = found.match_to_catalog_sky(true)
    back, _, _ = true.match_to_catalog_sky(found)
    good = ((distance.arcsec < limit)
            & (back[nearest] == np.arange(len(found))))
    return np.flatnonzero(good), nearest[good]


def _corrected(run, solution, table, number, at):
    """Return RA and Dec errors (2, n) [mas], stated ones, and rows."""
    wcs = solution.epochs[at].wcs
    x, y = (np.asarray(table[f'{c}_fit'], float) for c in 'xy')
    places = SkyCoord(*wcs(x, y, with_bounding_box=False), unit='deg')
    true = _true_places(run, number)
    i, j = _same(places, true)
    east, north = true[j].spherical_offsets_to(places[i])
    stated = 1000 * PIXEL * np.stack([table['x_err'][i], table['y_err'][i]])
    return (np.stack([east.to_value(u.mas), north.to_value(u.mas)]), stated,
            i, j)


def _positions(run, catalogues):
    """Return errors of positions by band, model, coordinate, magnitude."""
    taken, truth, rows = exposures(run), sources(run), []
    for name in MODELS:
        solution = catalogues.solution(name, range(7))
        parts = {band: [] for band in 'gri'}
        for number in range(7):
            away, stated, _, j = _corrected(
                run, solution, catalogues[number, name], number, number)
            band = taken[number].band.name
            parts[band].append(np.vstack([
                truth[f'mag_{band}'].value[j], away, stated]))
        for band, found in parts.items():
            both = np.concatenate(found, axis=1)
            rows += _bin_positions(band, name, both[0], both[1:])
    return QTable(rows=rows, names=(
        'band', 'model', 'coordinate', 'mag', 'number', 'scatter', 'stated'),
        units=(None, None, None, 'mag', None, 'mas', 'mas'))


def _found(run, catalogues):
    """Return how often each source was found, and where it is."""
    truth = sources(run)
    count = np.zeros(len(truth), int)
    solution = catalogues.solution('paper', range(7))
    for number in range(7):
        count[_corrected(run, solution, catalogues[number, 'paper'], number,
                         number)[3]] += 1
    return QTable({'ra': truth['ra'], 'dec': truth['dec'],
                   'kind': truth['kind'], 'mag': truth['mag_g'].value,
                   'count': count})


def _epochs(run, catalogues):
    """Return time, band and number of sources of each exposure."""
    taken = exposures(run)
    return QTable({
        'time': [one.time.utc.isot for one in taken],
        'detector': [one.detector for one in taken],
        'band': [one.band.name for one in taken],
        'found': [len(catalogues[n, 'paper']) for n in range(7)]})


def _bin_positions(band, name, mag, errors):
    rows = []
    for k, coordinate in enumerate(COORDINATES):
        for low, here in binned(mag, EDGES):
            if here.sum() >= 5:
                rows.append((band, name, coordinate, low + 0.5,
                             int(here.sum()), spread(errors[k, here]),
                             np.median(errors[2 + k, here])))
    return rows


# Motions

def _motions(run, catalogues):
    """Return motions of sources by recipe and number of observations."""
    truth, chosen = sources(run), references(run)
    places = SkyCoord(truth['ra'], truth['dec'])
    rows = []
    for count, which in CAMPAIGNS.items():
        joint = catalogues.solution('paper', which)
        common = joint.bootstrap(run.settings.resamplings,
                                 rng=35).motion.std(axis=0)
        rows += _motion_rows('joint', count, joint, truth, places, chosen,
                             common)
        for recipe, eps_t in (('paper, as printed', 'printed'),
                              ('paper, corrected', 'corrected')):
            solution = ProperMotionFitter(
                recipe='paper', eps_t=eps_t, references=chosen,
                match_by='sky').fit(joint.epochs)
            rows += _motion_rows(recipe, count, solution, truth, places,
                                 chosen, np.full(2, np.nan))
    return QTable(rows=rows, names=(
        'recipe', 'count', 'id', 'kind', 'mag', 'pmra', 'pmra_error',
        'pmra_true', 'pmdec', 'pmdec_error', 'pmdec_true', 'pmra_frame',
        'pmdec_frame'))


def _motion_rows(recipe, count, solution, truth, places, chosen, common):
    """Return a row for each source seen every time, references left out."""
    stars = solution.stars
    stars = stars[(stars['n_good_obs'] >= count)
                  & np.isfinite(stars['pmra_error'].value)
                  & np.isfinite(stars['ra'].value)]
    i, j = _same(SkyCoord(stars['ra'], stars['dec']), places)
    rows = []
    for star, true in zip(stars[i], truth[j], strict=True):
        if true['id'] not in chosen['id']:
            rows.append((recipe, count, int(true['id']), str(true['kind']),
                         true['mag_g'].value, star['pmra'].value,
                         star['pmra_error'].value, true['pmra'].value,
                         star['pmdec'].value, star['pmdec_error'].value,
                         true['pmdec'].value, *common))
    return rows


def _by_magnitude(motions):
    """Return errors of all sources by number of observations and mag."""
    part = motions[motions['recipe'] == 'joint']
    rows = []
    for count in CAMPAIGNS:
        some = part[part['count'] == count]
        for low, here in binned(some['mag'], EDGES):
            if here.sum() < 5:
                continue
            for name in MOTIONS:
                away = np.asarray(some[name] - some[f'{name}_true'])[here]
                stated = np.asarray(some[f'{name}_error'])[here]
                rows.append((count, low + 0.5, name, int(here.sum()),
                             np.median(stated), spread(away)))
    return QTable(rows=rows, names=(
        'count', 'mag', 'motion', 'number', 'stated', 'scatter'),
        units=(None, 'mag', None, None, 'mas/yr', 'mas/yr'))


def _medians(run, motions):
    """Return median errors by recipe and number of observations."""
    rows = []
    for recipe in RECIPES:
        for count in CAMPAIGNS:
            part = motions[(motions['recipe'] == recipe)
                           & (motions['count'] == count)]
            for name in MOTIONS:
                stated = np.asarray(part[f'{name}_error'])
                away = np.asarray(part[name] - part[f'{name}_true'])
                band = bootstrap_median(
                    stated, n_resamples=run.settings.resamplings, rng=36)
                rows.append((recipe, count, name, len(part),
                             np.median(stated), band.std(), spread(away),
                             spread(away / stated)))
    return QTable(rows=rows, names=(
        'recipe', 'count', 'motion', 'number', 'median_error',
        'error_of_median', 'scatter', 'pull'),
        units=(None, None, None, None, 'mas/yr', 'mas/yr', 'mas/yr', None))


def _bins(run, motions):
    """Return errors of quasars by number of observations and magnitude."""
    part = motions[(motions['recipe'] == 'joint')
                   & (motions['kind'] == 'qso')]
    rows = []
    for count in CAMPAIGNS:
        some = part[part['count'] == count]
        for low, here in binned(some['mag'], EDGES):
            if here.sum() >= 5:
                rows += [_bin(run, some[here], count, low, name)
                         for name in MOTIONS]
    return QTable(rows=rows, names=(
        'count', 'mag', 'motion', 'number', 'total', 'total_low',
        'total_high', 'scatter', 'systematic', 'systematic_error', 'frame'))


def _bin(run, quasars, count, low, name):
    """Return the row of one bin; quasars do not move."""
    n = run.settings.resamplings
    stated = np.asarray(quasars[f'{name}_error'])
    away = np.asarray(quasars[name] - quasars[f'{name}_true'])
    draws = bootstrap_median(stated, n_resamples=n, rng=37)
    offset = bootstrap_median(away, n_resamples=n, rng=38)
    return (count, low + 0.5, name, len(quasars), np.median(stated),
            *np.percentile(draws, [16, 84]), spread(away), np.median(away),
            offset.std(), float(quasars[f'{name}_frame'][0]))
