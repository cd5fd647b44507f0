"""Which rows are one star: by identifier, and by place."""
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.spatial.distance import cdist

from photutils_mgauss.motions.matching import (
    Known,
    Tolerance,
    match_ids,
    match_positions,
)

FREE = Tolerance(None, max_motion=50.0, pointing=2000.0)


def field(rng, n=400, years=(0.0, 1.5, 3.5), missing=0.2, offset=300.0,
          sigma=5.0, side=5e5):
    """Return places, errors and true numbers of the rows of exposures."""
    place = rng.uniform(0, side, (2, n))
    motion = rng.normal(0, 6, (2, n))
    places, sigmas, numbers = [], [], []
    for year in years:
        seen = rng.permutation(n)[:round(n * (1 - missing))]
        places.append((place + motion * year)[:, seen]
                      + rng.normal(0, sigma, (2, len(seen)))
                      + rng.normal(0, offset, (2, 1)))
        sigmas.append(np.full(len(seen), sigma))
        numbers.append(seen)
    return places, sigmas, numbers


def test_stars_matched_by_place_are_the_true_ones(rng):
    places, sigmas, numbers = field(rng)
    matches = match_positions(places, sigmas, [0.0, 1.5, 3.5], FREE)
    found = matches.take(numbers, fill=-1)
    first = found.max(axis=0)
    assert ((found == first) | (found < 0)).all()
    assert matches.rows.shape[1] == len(np.unique(np.concatenate(numbers)))


def test_matches_are_one_to_one_and_lose_no_row(rng):
    places, sigmas, _ = field(rng, n=3000, side=5e4)
    matches = match_positions(places, sigmas, [0.0, 1.5, 3.5], FREE)
    for rows, place in zip(matches.rows, places, strict=True):
        assert_array_equal(np.sort(rows[rows >= 0]),
                           np.arange(place.shape[1]))


def test_close_pairs_are_marked_ambiguous(rng):
    places, sigmas, _ = field(rng, n=100, missing=0.0, offset=0.0)
    twin = places[0][:, :1] + np.array([[20.0], [0.0]])
    places[0] = np.hstack([places[0], twin])
    sigmas[0] = np.append(sigmas[0], 5.0)
    matches = match_positions(places, sigmas, [0.0, 1.5, 3.5], FREE)
    near = np.flatnonzero(matches.ambiguous)
    assert 1 <= len(near) <= 3
    assert 0 in matches.rows[0, near] or 100 in matches.rows[0, near]


def test_known_motions_are_followed(rng):
    # 2"/yr is far beyond what an unknown star may move.
    places, sigmas, numbers = field(rng, n=50, missing=0.0, offset=0.0)
    fast = np.array([2000.0, -1000.0])
    order = [np.flatnonzero(number == 7)[0] for number in numbers]
    start = places[0][:, order[0]].copy()
    for k, year in enumerate((0.0, 1.5, 3.5)):
        places[k][:, order[k]] = start + fast * year
    known = start[:, None], fast[:, None], np.array([0.0])
    matches = match_positions(places, sigmas, [0.0, 1.5, 3.5], FREE, known)
    assert_array_equal(matches.rows[:, 0], order)
    lost = match_positions(places, sigmas, [0.0, 1.5, 3.5], FREE)
    assert lost.rows.shape[1] == 52


def test_a_radius_given_is_the_radius_used(rng):
    places, sigmas, _ = field(rng, n=200, missing=0.0, offset=0.0)
    radius = Tolerance(12.0, max_motion=0.0, pointing=0.0)
    matches = match_positions(places[:2], sigmas[:2], [0.0, 1.5], radius)
    both = matches.seen.all(axis=0)
    distance = np.hypot(*(places[0][:, matches.rows[0, both]]
                          - places[1][:, matches.rows[1, both]]))
    assert distance.max() <= 12.0
    apart = cdist(places[0].T, places[1].T)
    assert both.sum() == np.sum(apart.min(axis=1) <= 12.0)


def test_rows_without_a_place_become_stars_of_their_own(rng):
    places, sigmas, _ = field(rng, n=60, missing=0.0)
    places[1][0, 5] = np.nan
    matches = match_positions(places, sigmas, [0.0, 1.5, 3.5], FREE)
    star = np.flatnonzero(matches.rows[1] == 5)[0]
    assert_array_equal(matches.rows[:, star], [-1, 5, -1])


def test_an_empty_exposure_matches_nothing(rng):
    places, sigmas, _ = field(rng, n=60, missing=0.0)
    places[1], sigmas[1] = np.empty((2, 0)), np.empty(0)
    matches = match_positions(places, sigmas, [0.0, 1.5, 3.5], FREE)
    assert matches.rows.shape == (3, 60)
    assert (matches.rows[1] < 0).all()


def test_identifiers_are_matched_in_order_of_appearance():
    matches, names = match_ids([np.array(['b', 'a']), np.array(['a', 'c'])])
    assert_array_equal(names, ['b', 'a', 'c'])
    assert_array_equal(matches.rows, [[0, 1, -1], [-1, 0, 1]])


def test_identifiers_of_two_kinds_are_refused():
    with pytest.raises(TypeError, match='must be numbers in all epochs'):
        match_ids([np.array(['1', '2']), np.array([1, 2])])


def test_take_puts_rows_where_their_stars_are():
    matches, _ = match_ids([np.array([5, 7]), np.array([7])])
    values = matches.take([np.array([1.0, 2.0]), np.array([3.0])])
    assert_array_equal(values, [[1.0, 2.0], [np.nan, 3.0]])


def fast_star(rng, n=150, baseline=60.0, motion=1000.0):
    """Return places at two times; the first star passes its neighbours."""
    first = rng.uniform(-180e3, 180e3, (2, n))
    first[:, 0] = -30e3, -30e3
    first[:, 1] = first[:, 0] + [0.4 * motion * baseline, 2e3]
    second = first + rng.normal(0, 6, (2, n)) * baseline
    second[:, 0] = first[:, 0] + [motion * baseline, 0]
    return first, second, (1951.0, 1951.0 + baseline)


@pytest.mark.parametrize('seed', range(5))
def test_a_fast_star_is_what_is_left_over(seed):
    first, second, years = fast_star(np.random.default_rng(seed))
    n = first.shape[1]
    sigma = np.full(n, 50.0)
    matches = match_positions([first, second], [sigma, sigma], years,
                              Tolerance(None, 1500.0, 2000.0))
    assert matches.rows.shape[1] == n
    assert (matches.rows[0] == matches.rows[1]).all()
    assert matches.ambiguous[0]


def test_two_that_are_left_over_are_not_guessed(rng):
    first, second, years = fast_star(rng)
    sigma = np.full(first.shape[1], 50.0)
    more = np.column_stack([first, first[:, 0] + [0, 9e3]])
    matches = match_positions([more, second],
                              [np.append(sigma, 50.0), sigma], years,
                              Tolerance(None, 1500.0, 2000.0))
    together = (matches.rows >= 0).all(axis=0)
    assert not together[matches.rows[1] == 0].any()


def test_a_known_parallax_moves_a_star(rng):
    # The star is 80 mas from where it was, and others are farther away.
    n = 100
    place = rng.uniform(0, 1e5, (2, n))
    row = place + rng.normal(0, 0.1, (2, n))
    row[0, 0] += 80
    row = np.column_stack([row, rng.uniform(0, 1e5, (2, 4000))])
    parallax = np.zeros(n)
    parallax[0] = 100.0
    known = Known(place, rng.normal(0, 1e-3, (2, n)), np.full(n, 2016.0),
                  0.1, 0.01, parallax)
    matches = match_positions([row], [np.full(row.shape[1], 0.1)], [2012.0],
                              FREE, known)
    assert_array_equal(matches.rows[0, :n], np.arange(n))


@pytest.mark.parametrize('seed', range(5))
def test_a_fast_star_in_a_dense_field_is_found_at_three_times(seed):
    # Neighbours are 4500 mas from each other, and one in ten has no row.
    rng = np.random.default_rng(seed)
    n, years = 2000, (0.0, 1.0, 2.0, 4.0)
    place, motion = rng.uniform(0, 2e5, (2, n)), rng.normal(0, 5, (2, n))
    place[:, 0], motion[:, 0] = 1e5, 3000 * np.array([0.6, -0.8])
    seen = rng.uniform(size=(4, n)) < 0.9
    seen[:, 0] = True
    numbers = [rng.permutation(np.flatnonzero(one)) for one in seen]
    places = [(place + motion * year)[:, number]
              + rng.normal(0, 3, (2, len(number)))
              for year, number in zip(years, numbers, strict=True)]
    matches = match_positions(
        places, [np.full(len(number), 3.0) for number in numbers], years,
        Tolerance(None, 3500.0, 2000.0))
    found = matches.take(numbers, fill=-1)
    whose = found.max(axis=0)
    assert ((found == whose) | (found < 0)).all(axis=0).mean() > 0.998
    assert (found == 0).all(axis=0).sum() == 1
