"""Simulations that several figures of the gallery begin with."""
from photutils_mgauss import (
    Epoch,
    Instrument,
    csst_psf,
    paper_exposures,
    simulate,
    simulate_catalogues,
    sky_field,
)


def star_image(stars, shape):
    """Return the true PSF, and an image (a `Scene`) of the stars."""
    psf = csst_psf(shape)
    return psf, simulate(stars, instrument=Instrument(shape=shape), psf=psf,
                         rng=2)


def moving_stars(which):
    """
    Return stars and quasars of a field, and their `Epoch` objects.

    ``which`` are numbers of the seven exposures of Nie et al.
    """
    sources = sky_field(200, 100, size=1.2, magnitudes=(19, 23.5),
                        separation=1, parallaxes=False, rng=1)
    exposures = paper_exposures()
    catalogues = simulate_catalogues(
        sources, [exposures[i] for i in which], rng=2,
        instrument=Instrument(shape=(1000, 1000)))
    return sources, [Epoch(one.table, one.wcs, one.time)
                     for one in catalogues]
