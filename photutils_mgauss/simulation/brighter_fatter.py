"""
Stars photon by photon, where charge pushes later charge away.

GalSim's model of a silicon sensor moves the edges of pixels with the charge
they hold, which makes bright stars wider than faint ones.
"""
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from photutils.psf import GriddedPSFModel

from photutils_mgauss.psf.gridded import GriddedMixturePSF
from photutils_mgauss.simulation.optics import PHOTON_RADIUS
from photutils_mgauss.utils.validation import as_real

# Half the side of the stamp that a star's photons fall on, and of its middle
# where charge moves [pix]. The time goes with the area of the middle.
_HALF, _CORE = PHOTON_RADIUS, 8

# Of fainter stars [electron] the effect moves less than 1e-4 of the charge;
# they are drawn as if there were none.
FAINT = 2000.0


def repelled(x, y, flux, shape):
    """Return which stars (n,) are drawn photon by photon."""
    ny, nx = shape
    return ((flux >= FAINT) & (np.rint(x) >= 0) & (np.rint(x) < nx)
            & (np.rint(y) >= 0) & (np.rint(y) < ny))


def shoot_stars(psf, x, y, flux, response, strength, rng):
    """
    Return the electrons (ny, nx) of stars whose charge repels.

    Each star's photons are a Poisson number, drawn from its PSF; a pixel
    turns the fraction response (ny, nx) of those that fall on it, relative to
    a common pixel, into charge.
    """
    source = _source(psf)
    sensor = _sensor(strength, rng)
    from galsim.utilities import single_threaded
    response = np.pad(response, _HALF, constant_values=1.0)
    wide = np.zeros(response.shape, np.float32)
    stamps = [_stamp(a, b) for a, b in zip(x, y, strict=True)]
    # So many photons that a pixel of the best response loses none of them.
    best = np.array([response[stamp].max() for stamp in stamps])
    numbers = rng.poisson(flux * best)
    # GalSim would share out the few pixels of each star among threads, which
    # takes longer than the work.
    with single_threaded():
        for a, b, stamp, number in zip(x, y, stamps, numbers, strict=True):
            middle = np.array([[a - round(a)], [b - round(b)]])
            places = middle + source(a, b, number, rng)
            places = _converted(places, response[stamp], rng)
            wide[stamp] = _accumulate(sensor, places, wide[stamp])
    return wide[_HALF:-_HALF, _HALF:-_HALF]


def _stamp(x, y):
    """Return the pixels of a star on the wide image."""
    i, j = round(x), round(y)
    return np.s_[j:j + 2 * _HALF + 1, i:i + 2 * _HALF + 1]


def _converted(places, response, rng):
    """Return those photons (2, n) that become charge."""
    best = response.max()
    if response.min() == best:
        return places
    column, row = np.clip(np.rint(places).astype(int) + _HALF, 0, 2 * _HALF)
    chance = rng.random(places.shape[1])
    return places[:, chance * best < response[row, column]]


def photons(mixture, number, rng):
    """Draw places (2, number) from a mixture with positive weights."""
    which = rng.choice(mixture.n_components, number, p=mixture.weights)
    lower = np.linalg.cholesky(mixture.covariances)
    steps = rng.standard_normal((number, 2))
    return (mixture.means[which]
            + np.einsum('nij,nj->ni', lower[which], steps)).T


@dataclass(frozen=True, eq=False)
class OpticsPhotons:
    """
    Photons of stars whose PSF a telescope's optics made.

    Between the nodes of the table they are those of its four neighbours,
    with the weights of the table's own blend.
    """

    psf: GriddedPSFModel
    totals: dict = field(default_factory=dict)

    @cached_property
    def _axes(self):
        return [np.unique(axis) for axis in
                np.transpose(self.psf.grid_xypos)]

    def __call__(self, x, y, number, rng):
        """Draw places (2, number) relative to a star at x, y [pix]."""
        nodes, weights = self._neighbours(x, y)
        shares = rng.multinomial(number, weights)
        return np.concatenate([self._at_node(node, n, rng) for node, n in
                               zip(nodes, shares, strict=True)], axis=1)

    def _neighbours(self, x, y):
        """Return the numbers of four nodes around a place, and weights."""
        cells = []
        for axis, value in zip(self._axes, (x, y), strict=True):
            low = int(np.clip(np.searchsorted(axis, value) - 1, 0,
                              axis.size - 2))
            share = np.clip((value - axis[low])
                            / (axis[low + 1] - axis[low]), 0, 1)
            cells.append(((low, 1 - share), (low + 1, share)))
        return ([a + self._axes[0].size * b for b, _ in cells[1]
                 for a, _ in cells[0]],
                [v * u for _, v in cells[1] for _, u in cells[0]])

    def _at_node(self, node, number, rng):
        """Draw places (2, number) from the light at a node."""
        light = self.psf.meta['light']
        if node not in self.totals:
            total = np.cumsum(np.maximum(light.images[node], 0), dtype=float)
            self.totals[node] = total / total[-1]
        chosen = np.searchsorted(self.totals[node], rng.random(number),
                                 side='right')
        side = light.images.shape[2]
        row, column = np.divmod(chosen, side)
        place = np.stack([column, row]) - (side - 1) / 2
        place += rng.uniform(-0.5, 0.5, place.shape)
        return place / light.oversampling


def _source(psf):
    """Return what draws photons: from x, y, number, rng to places."""
    if isinstance(psf, GriddedMixturePSF) and psf.pixel_integrated:
        return lambda x, y, number, rng: photons(psf.mixture_at(x, y),
                                                 number, rng)
    if isinstance(psf, GriddedPSFModel) and 'light' in psf.meta:
        return OpticsPhotons(psf)
    msg = ('psf must be a GriddedMixturePSF with pixel_integrated=True, or '
           'made by Optics.to_gridded_psf, for the brighter-fatter effect, '
           f'got {psf!r:.80}')
    raise ValueError(msg)


def _sensor(strength, rng):
    try:
        import galsim
    except ImportError as error:
        msg = ('brighter_fatter needs the package galsim '
               '(pip install galsim)')
        raise ImportError(msg) from error
    seed = galsim.BaseDeviate(int(rng.integers(1, 2**31)))
    return galsim.SiliconSensor(strength=as_real(strength, 'strength'),
                                rng=seed, diffusion_factor=0.0)


def _accumulate(sensor, places, stamp):
    """Return the stamp with photons, relative to its middle, added."""
    import galsim
    stamp = stamp.copy()
    inner = (np.abs(places) < _CORE + 0.5).all(axis=0)
    column, row = np.rint(places[:, ~inner]).astype(int) + _HALF
    on = (np.minimum(row, column) >= 0) & (np.maximum(row, column)
                                           <= 2 * _HALF)
    np.add.at(stamp, (row[on], column[on]), 1)
    middle = slice(_HALF - _CORE, _HALF + _CORE + 1)
    image = galsim.ImageF(stamp[middle, middle].copy(), xmin=-_CORE,
                          ymin=-_CORE)
    x, y = (np.ascontiguousarray(axis) for axis in places[:, inner])
    sensor.accumulate(galsim.PhotonArray(x.size, x=x, y=y,
                                         flux=np.ones(x.size)), image)
    stamp[middle, middle] = image.array
    return stamp
