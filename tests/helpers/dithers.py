"""Images of the same stars, shifted a little, each with a faint neighbour."""
import numpy as np
from astropy.table import Table


def dithered(psf, size, sky, stars, neighbours, n_images, draw, rng):
    """
    Return images, tables and errors, in the order of the random numbers.

    ``stars`` are x, y and fluxes, ``neighbours`` their distances (2, n) and
    the share of the flux that each has; ``draw`` makes noise.
    """
    off, fainter = neighbours
    images, tables, errors = [], [], []
    for _ in range(n_images):
        shift = rng.uniform(-5, 5, 2)
        x, y = stars[0] + shift[0], stars[1] + shift[1]
        tables.append(Table({'x': x, 'y': y}))
        clean = np.full((size, size), sky)
        for i, flux in enumerate(stars[2]):
            for dx, dy, share in ((0, 0, 1), (*off[:, i], fainter)):
                clean += psf.render(clean.shape, x[i] + dx, y[i] + dy,
                                    flux=share * flux)
        images.append(draw(clean) - sky)
        errors.append(np.sqrt(clean))
    return images, tables, errors
