"""
Stars photon by photon, where charge pushes later charge away.

GalSim's model of a silicon sensor moves the edges of pixels with the charge
they hold, which makes bright stars wider than faint ones.
"""
import numpy as np

from photutils_mgauss.psf.gridded import GriddedMixturePSF
from photutils_mgauss.utils.validation import as_real

# Half the side of the stamp that a star's photons fall on [pix].
_HALF = 24


def shoot_stars(psf, x, y, flux, shape, strength, rng):
    """
    Return the electrons (ny, nx) of stars whose charge repels.

    Each star's photons are a Poisson number, drawn from its mixture.
    """
    sensor = _sensor(psf, strength, rng)
    ny, nx = shape
    wide = np.zeros((ny + 2 * _HALF, nx + 2 * _HALF), np.float32)
    for a, b, number in zip(x, y, rng.poisson(np.maximum(flux, 0)),
                            strict=True):
        i, j = round(a), round(b)
        if not (0 <= i < nx and 0 <= j < ny):
            continue
        stamp = wide[j:j + 2 * _HALF + 1, i:i + 2 * _HALF + 1]
        middle = np.array([[a - i], [b - j]])
        places = middle + photons(psf.mixture_at(a, b), number, rng)
        stamp[:] = _accumulate(sensor, places, stamp)
    return wide[_HALF:-_HALF, _HALF:-_HALF]


def photons(mixture, number, rng):
    """Draw places (2, number) from a mixture with positive weights."""
    which = rng.choice(mixture.n_components, number, p=mixture.weights)
    lower = np.linalg.cholesky(mixture.covariances)
    steps = rng.standard_normal((number, 2))
    return (mixture.means[which]
            + np.einsum('nij,nj->ni', lower[which], steps)).T


def _sensor(psf, strength, rng):
    if not isinstance(psf, GriddedMixturePSF) or not psf.pixel_integrated:
        msg = ('psf must be a GriddedMixturePSF with pixel_integrated=True '
               f'for the brighter-fatter effect, got {psf!r:.80}')
        raise ValueError(msg)
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
    image = galsim.ImageF(stamp.copy(), xmin=-_HALF, ymin=-_HALF)
    x, y = (np.ascontiguousarray(axis) for axis in places)
    array = galsim.PhotonArray(x.size, x=x, y=y, flux=np.ones(x.size))
    sensor.accumulate(array, image)
    return image.array
