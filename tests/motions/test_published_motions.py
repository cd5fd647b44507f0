"""Motions that others measured, from their own positions."""
import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import Angle
from astropy.table import QTable, Table
from numpy.testing import assert_allclose

from photutils_mgauss import Epoch, ProperMotionFitter


def test_the_pulsar_b0950_has_its_published_motion(realdata):
    epochs = []
    lines = (realdata('vlba_b0950') / 'example.pmpar').read_text()
    for line in lines.splitlines():
        words = line.split()
        if len(words) < 5 or ':' not in words[1]:
            continue
        dec = Angle(words[3], unit=u.deg).deg
        seconds = 15e3 * np.cos(np.radians(dec))
        epochs.append(Epoch(Table({
            'ra': [Angle(words[1], unit=u.hourangle).deg], 'dec': [dec],
            'ra_error': [float(words[2]) * seconds],
            'dec_error': [float(words[4]) * 1e3]}), time=float(words[0])))
    star = ProperMotionFitter(transform=None, parallax=True).fit(
        epochs).stars[0]
    for name, value, error in (('pmra', -1.67, 0.42), ('pmdec', 29.33, 0.28),
                               ('parallax', 3.69, 0.17)):
        assert_allclose(star[name].value, value, atol=0.006)
        assert_allclose(star[f'{name}_error'].value, error, atol=0.006)
    assert_allclose([star['chi2'], star['dof']], [2.16, 3], atol=0.006)


def keck(folder):
    """Return the epochs and the label table of keck_ob150029."""
    names = ['name', 'm', 't', 'x', 'y', 'xe', 'ye', 'snr', 'corr',
             'n_frames', 'flux']
    epochs = []
    for path in sorted(folder.glob('mag*.lis')):
        rows = [line.split() for line in path.read_text().splitlines()[1:]]
        table = Table(dict(zip(names, map(list, zip(*rows, strict=True)),
                               strict=True)))
        positions = {new: table[old].astype(float) for old, new in (
            ('x', 'x'), ('y', 'y'), ('xe', 'x_err'), ('ye', 'y_err'),
            ('m', 'mag'))}
        epochs.append(Epoch(Table({'id': table['name'], **positions}),
                            time=float(table['t'][0])))
    names = ['id', 'kp', 'x', 'y', 'xerr', 'yerr', 'pmra', 'pmdec',
             'pmra_error', 'pmdec_error', 't0']
    rows = [line.split()[:11] for line in (
        folder / 'ob150029_label.txt').read_text().splitlines()[1:]]
    label = Table(dict(zip(names, map(list, zip(*rows, strict=True)),
                           strict=True)))
    for name in names[1:]:
        label[name] = label[name].astype(float)
    return epochs, label[label['pmra_error'] > 0]


def label_catalogue(label):
    catalogue = QTable({'id': label['id'], 'ref_epoch': label['t0']})
    for name in ('x', 'y'):
        catalogue[name] = label[name] * u.arcsec
        catalogue[f'{name}_error'] = np.full(len(label), 1.0) * u.mas
    for name in ('pmra', 'pmdec', 'pmra_error', 'pmdec_error'):
        catalogue[name] = label[name] * u.mas / u.yr
    return catalogue


def differences(stars, label):
    """Return the motions of a table minus the published ones [mas/yr]."""
    row = {name: i for i, name in enumerate(stars['id'])}
    both = [(row[name], k) for k, name in enumerate(label['id'])
            if name in row]
    i, k = np.array(both).T
    away = np.stack([stars[name][i].to_value(u.mas / u.yr) - label[name][k]
                     for name in ('pmra', 'pmdec')])
    return away[:, np.isfinite(away).all(axis=0)]


@pytest.mark.parametrize(('transform', 'recipe'), [
    ('affine', 'joint'), ('affine', 'two-step'), ('poly-2', 'joint')])
def test_keck_motions_agree_with_the_published_ones(realdata, transform,
                                                    recipe):
    epochs, label = keck(realdata('keck_ob150029'))
    fit = ProperMotionFitter(references=label_catalogue(label),
                             transform=transform, recipe=recipe).fit(epochs)
    away = differences(fit.measured(), label)
    assert away.shape[1] >= 90
    middle = np.median(away, axis=1)
    assert (np.abs(middle) < 0.04).all()
    spread = np.median(np.abs(away - middle[:, None]), axis=1)
    assert (spread <= [0.19, 0.30]).all()
    sizes = np.linalg.svd(fit.alignment['matrix'])[1]
    assert ((sizes > 9.92) & (sizes < 9.94)).all()


def pulls_between(one, two):
    """Return pulls (2, n) between the motions in two tables, and names."""
    names = sorted(set(one['id']) & set(two['id']))
    one, two = (stars[[list(stars['id']).index(name) for name in names]]
                for stars in (one, two))
    return np.stack([((one[name] - two[name]) / np.hypot(
        one[f'{name}_error'], two[f'{name}_error'])).value
        for name in ('pmra', 'pmdec')]), names


def test_halves_of_the_keck_epochs_agree_within_their_errors(realdata):
    # Every other epoch is in the same half, so that no error of one is in
    # both: errors are judged without those that others state.
    epochs, label = keck(realdata('keck_ob150029'))
    epochs.sort(key=lambda epoch: epoch.years)
    fitter = ProperMotionFitter(references=label_catalogue(label),
                                systematic='magnitude')
    pulls, names = pulls_between(*(fitter.fit(half).measured()
                                   for half in (epochs[::2], epochs[1::2])))
    kp = dict(zip(label['id'], label['kp'], strict=True))
    magnitude = np.array([kp.get(name, np.nan) for name in names])
    for bright, faint in ((17, 18), (18, 19), (19, 21)):
        some = pulls[:, (magnitude >= bright) & (magnitude < faint)]
        some = some[np.isfinite(some)]
        assert len(some) > 30
        assert 0.9 <= np.sqrt(np.mean(some**2)) <= 1.1


def test_two_keck_epochs_give_motions(realdata):
    epochs, label = keck(realdata('keck_ob150029'))
    fit = ProperMotionFitter(references=label_catalogue(label)).fit(
        [epochs[0], epochs[-1]])
    stars = fit.measured()
    away = differences(stars, label)
    assert away.shape[1] >= 80
    middle = np.median(away, axis=1)
    spread = np.median(np.abs(away - middle[:, None]), axis=1)
    assert (spread < 0.6).all()
    for name in ('chi2', 'dof', 'uwe'):
        assert np.isnan(stars[name]).all()
