"""Displacements by magnitude, colour and row, simulated and found."""
import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose

from photutils_mgauss import Epoch, ProperMotionFitter

YEARS = np.array([2008.0, 2010.0, 2013.0, 2016.0, 2020.0])
ROLLS = np.radians([0, 100, 190, 20, 270])
COUNT, HALF = 800, 1000.0


def seen(rng, *, cte=0.0, colour=0.0, magnitude=0.0):
    """Return epochs, known stars and the motions [pix / yr] of all."""
    mag, tint = rng.uniform(16, 22, COUNT), rng.uniform(0, 2, COUNT)
    error = 0.003 * 10**(0.2 * (mag - 16))
    place = rng.uniform(-HALF, HALF, (2, COUNT))
    motion = rng.normal(0, 0.02, (2, COUNT))
    epochs = []
    for k, (year, roll) in enumerate(zip(YEARS, ROLLS, strict=True)):
        cosine, sine = np.cos(roll), np.sin(roll)
        x, y = (np.array([[cosine, sine], [-sine, cosine]])
                @ (place + motion * (year - 2014))) + 1.5 * HALF
        faint, size = (mag - 19) / 3, 1 + 0.3 * k
        dx = colour * size * (tint - 1) + magnitude * size * faint
        dy = cte * size * faint * y / (3 * HALF)
        x = x - dx + error * rng.standard_normal(COUNT)
        y = y - dy + error * rng.standard_normal(COUNT)
        epochs.append(Epoch(Table({
            'id': np.arange(COUNT), 'x_fit': x, 'y_fit': y, 'x_err': error,
            'y_err': error, 'mag': mag, 'colour': tint}), time=year))
    known = Table({'id': np.arange(0, COUNT, 8)})
    known['ref_epoch'] = 2014.0
    for k, (x, pm) in enumerate((('x', 'pmra'), ('y', 'pmdec'))):
        known[x], known[f'{x}_error'] = place[k, ::8], 0.002
        known[pm], known[f'{pm}_error'] = motion[k, ::8], 0.0005
    return epochs, known, motion


def solved(scene, **options):
    """Return the solution, and away / error (2, n) of stars not known."""
    epochs, known, motion = scene
    solution = ProperMotionFitter(references=known, **options).fit(epochs)
    stars = solution.stars
    ids = np.asarray(stars['id'])
    free = ids % 8 > 0
    away = np.stack([stars[name].value for name in ('pmra', 'pmdec')])
    error = np.stack([stars[f'{name}_error'].value
                      for name in ('pmra', 'pmdec')])
    return solution, ((away - motion[:, ids]) / error)[:, free]


def test_cte_and_colour_are_found_within_their_errors(rng):
    scene = seen(rng, cte=0.03, colour=0.01)
    solution, pulls = solved(scene, terms=('magnitude', 'colour', 'y'))
    table = solution.terms
    assert sorted(set(table['term'])) == ['colour', 'y']
    meta, size = table.meta, 1 + 0.3 * np.asarray(table['epoch'])
    # What was put in, in the scaled functions of the table.
    linear = np.asarray(table['powers'])[:, :2].sum(axis=1) == 1
    tints, rows = table['term'] == 'colour', table['term'] == 'y'
    colour = np.where(tints & linear, 0.01 * meta['colour_half_range'], 0)
    part = np.array(meta['rows'])[table['epoch']] / (3 * HALF)
    cte = np.where(rows & linear,
                   0.03 * part * meta['magnitude_half_range'] / 3, 0)
    use = tints | (rows & linear)
    away = [(table['dx'].value - colour * size) / table['dx_error'].value,
            (table['dy'].value - cte * size) / table['dy_error'].value]
    found = np.concatenate([away[0][tints], away[1][rows]])
    assert use.any()
    assert np.abs(found).max() < 4
    assert 0.7 < np.sqrt(np.mean(found**2)) < 1.35
    assert_allclose(np.sqrt(np.mean(pulls**2)), 1, atol=0.1)


def test_motions_are_as_if_there_were_no_terms(rng):
    seed = rng.integers(2**30)
    sizes = []
    for cte, terms in ((0.0, ()), (0.03, ('y', 'colour')), (0.03, ())):
        scene = seen(np.random.default_rng(seed), cte=cte)
        solution, pulls = solved(scene, terms=terms)
        ids = np.asarray(solution.stars['id'])
        away = pulls * np.stack([solution.stars[name].value[ids % 8 > 0] for
                                 name in ('pmra_error', 'pmdec_error')])
        bright = scene[0][0].table['mag'][ids[ids % 8 > 0]] < 18
        sizes.append(np.sqrt(np.mean(away[:, bright]**2)))
    assert sizes[1] < 1.03 * sizes[0]
    assert sizes[2] > 1.05 * sizes[0]


@pytest.mark.parametrize('seed', range(3))
def test_nothing_is_lost_where_there_are_none(seed):
    scene = seen(np.random.default_rng(seed))
    _, before = solved(scene)
    solution, after = solved(scene, terms=('magnitude', 'colour', 'y'))
    assert len(solution.terms) == 0
    assert np.sqrt(np.mean(after**2)) < 1.01 * np.sqrt(np.mean(before**2))


def test_a_shift_with_magnitude_is_found(rng):
    solution, pulls = solved(seen(rng, magnitude=0.005), terms='magnitude')
    assert set(solution.terms['term']) == {'magnitude'}
    assert_allclose(np.sqrt(np.mean(pulls**2)), 1, atol=0.1)


def test_terms_that_cannot_be_are_refused_in_words(rng):
    epochs, known, _ = seen(rng)
    with pytest.raises(ValueError, match='terms must be'):
        ProperMotionFitter(terms='row')
    bare = [Epoch(one.table['id', 'x_fit', 'y_fit', 'x_err', 'y_err', 'mag'],
                  time=one.time) for one in epochs]
    with pytest.raises(ValueError, match='column colour or color or bp_rp'):
        ProperMotionFitter(terms='colour', references=known).fit(bare)
    with pytest.raises(ValueError, match='terms need maps'):
        ProperMotionFitter(terms='y', references=known,
                           transform=None).fit(epochs)
