r"""
Stars and quasars to put on images: sparse fields, crowded ones, and the sky.

Magnitudes are AB. The luminosity function of the crowded field is stated in
`crowded_field`.
"""
import astropy.units as u
import numpy as np
from astropy.table import QTable

from photutils_mgauss.simulation.exposures import NGP
from photutils_mgauss.utils.validation import (
    as_integer,
    as_range,
    as_real,
    as_rng,
    as_shape,
)
from photutils_mgauss.utils.waiting import waiting

# Stars of 16 to 26 mag per pixel: 5.4 million on a chip (Sec. 5).
PAPER_DENSITY = 5.4e6 / (9216 * 9232)

# The speed [km / s] of 1 mas / yr at 1 kpc.
_KM_S = 4.740470463

# Colours of sources, g - r and g - i: (mean, scatter) for stars and quasars;
# both colours of a source scatter together.
_COLOURS = {'star': (0.6, 0.9, 0.3), 'qso': (0.15, 0.25, 0.15)}


def sparse_field(shape, *, spacing=46, psf_fraction=0.28,
                 psf_magnitudes=(18.0, 20.5), magnitudes=(18.0, 26.0),
                 rng=0):
    """
    Make a field of isolated stars, as towards the north galactic pole.

    Stars are on a lattice, each displaced at random within its cell, so that
    none has a neighbour. Some are bright, to make the PSF from.

    Parameters
    ----------
    shape : int or (ny, nx) tuple of int
        The pixels of the image.
    spacing : int, optional
        The side of a cell [pix].
    psf_fraction : float, optional
        The fraction of stars meant for the PSF.
    psf_magnitudes, magnitudes : (2,) tuple of float, optional
        The ranges in which those and the other stars are uniform.
    rng : int or `~numpy.random.Generator`, optional
        The seed.

    Returns
    -------
    `~astropy.table.QTable`
        ``id``, ``x``, ``y`` [pix], ``mag`` and ``psf_star``.

    Raises
    ------
    ValueError
        If the image is smaller than a cell or a value is out of range.

    Examples
    --------
    >>> from photutils_mgauss.simulation import sparse_field
    >>> stars = sparse_field((512, 512), rng=1)
    >>> len(stars), stars.colnames
    (121, ['id', 'x', 'y', 'mag', 'psf_star'])
    """
    shape = as_shape(shape, 'shape')
    spacing = as_integer(spacing, 'spacing', minimum=4, maximum=min(shape))
    fraction = as_real(psf_fraction, 'psf_fraction', minimum=0, maximum=1)
    ranges = [as_range(magnitudes, 'magnitudes'),
              as_range(psf_magnitudes, 'psf_magnitudes')]
    rng = as_rng(rng)
    y, x = (grid.ravel() for grid in
            np.meshgrid(*(_cells(n, spacing) for n in shape), indexing='ij'))
    shifts = rng.uniform(-spacing / 4, spacing / 4, (2, x.size))
    bright = rng.random(x.size) < fraction
    mag = np.where(bright, rng.uniform(*ranges[1], x.size),
                   rng.uniform(*ranges[0], x.size))
    return QTable({'id': np.arange(1, x.size + 1),
                   'x': (x + shifts[0]) * u.pix, 'y': (y + shifts[1]) * u.pix,
                   'mag': mag * u.mag, 'psf_star': bright})


def _cells(n, spacing):
    """Return the middles of the cells that fit into n pixels."""
    count = n // spacing
    return (np.arange(count) - (count - 1) / 2) * spacing + (n - 1) / 2


@waiting('crowded_field')
def crowded_field(shape, *, density=PAPER_DENSITY, magnitudes=(16.0, 26.0),
                  margin=24, rng=0):
    r"""
    Make a field as dense as the galactic bulge of Nie et al.

    Stars are anywhere, in numbers per magnitude

    .. math::

        \frac{dN}{dm} \propto
        \begin{cases}10^{0.30 (m - 21)} & m < 21 \\
        10^{0.20 (m - 21)} & m \ge 21\end{cases}
        \; + \; 0.4 \cdot 10^{0.30 (17.6 - 21)}
        \exp\left[-\frac{(m - 17.6)^2}{2 \cdot 0.35^2}\right],

    a broken power law with a bump of clump giants. It stands for the model
    of the Galaxy used in the paper.

    Parameters
    ----------
    shape : int or (ny, nx) tuple of int
        The pixels of the image.
    density : float, optional
        Stars per pixel; by default those of the paper, one per 16 pixels.
    magnitudes : (2,) tuple of float, optional
        The faintest and brightest stars.
    margin : float, optional
        How far beyond the image there are stars [pix].
    rng : int or `~numpy.random.Generator`, optional
        The seed.

    Returns
    -------
    `~astropy.table.QTable`
        ``id``, ``x``, ``y`` [pix] and ``mag``.

    Raises
    ------
    ValueError
        If a value is out of range.

    Examples
    --------
    >>> from photutils_mgauss.simulation import crowded_field
    >>> stars = crowded_field((64, 64), margin=0, rng=1)
    >>> len(stars)
    260
    """
    ny, nx = as_shape(shape, 'shape')
    margin = as_real(margin, 'margin', minimum=0)
    density = as_real(density, 'density', minimum=0)
    limits = as_range(magnitudes, 'magnitudes')
    rng = as_rng(rng)
    expected = density * (ny + 2 * margin) * (nx + 2 * margin)
    n = rng.poisson(as_real(expected, 'density times the area', maximum=1e9))
    low, high = -margin - 0.5, margin - 0.5
    x = rng.uniform(low, nx + high, n)
    y = rng.uniform(low, ny + high, n)
    mag = _draw(_bulge_counts, limits, rng.random(n))
    return QTable({'id': np.arange(1, n + 1), 'x': x * u.pix,
                   'y': y * u.pix, 'mag': mag * u.mag})


def _bulge_counts(m):
    """Return the relative number of bulge stars per magnitude."""
    power = 10 ** np.where(m < 21, 0.30 * (m - 21), 0.20 * (m - 21))
    clump = 0.4 * 10 ** (0.30 * (17.6 - 21))
    return power + clump * np.exp(-0.5 * ((m - 17.6) / 0.35)**2)


def _draw(density, limits, uniform):
    """Draw from a density on an interval, by its inverse distribution."""
    grid = np.linspace(*limits, 4001)
    middle = density((grid[1:] + grid[:-1]) / 2)
    cumulative = np.concatenate([[0], np.cumsum(middle)])
    return np.interp(uniform * cumulative[-1], cumulative, grid)


@waiting('sky_field')
def sky_field(n_stars=614, n_qsos=590, *, ra=NGP[0], dec=NGP[1], size=11.3,
              parallaxes=True, separation=0.0, magnitudes=None, rng=0):
    """
    Make the stars and quasars of a field in the sky, with their motions.

    Stars have log-normal distances about 2 kpc and transverse velocities
    with a dispersion of 60 km/s that lag behind the Sun by 60 km/s in
    declination and 40 km/s in right ascension. Quasars do not move. Stars are
    18 to 26 mag, quasars 20 to 25.5 mag in g.

    Parameters
    ----------
    n_stars, n_qsos : int, optional
        Their numbers; by default those of the paper (Sec. 4.1).
    ra, dec : float, optional
        The centre of the field [deg]; by default that of the paper.
    size : float, optional
        The side of the square field [arcmin].
    parallaxes : bool, optional
        Whether stars have parallaxes.
    separation : float, optional
        No two sources are closer than this [arcsec].
    magnitudes : (2,) tuple of float, optional
        The range of g for all sources, in place of the above.
    rng : int or `~numpy.random.Generator`, optional
        The seed.

    Returns
    -------
    `~astropy.table.QTable`
        ``id``, ``kind`` ('star' or 'qso'), ``ra``, ``dec`` [deg], ``pmra``
        (with the cosine of the declination), ``pmdec`` [mas / yr],
        ``parallax`` [mas], ``ref_epoch`` [yr], and a magnitude for each
        band, ``mag_g``, ``mag_r`` and ``mag_i``.

    Raises
    ------
    ValueError
        If a value is out of range, or the field too full for the separation.

    Examples
    --------
    >>> from photutils_mgauss.simulation import sky_field
    >>> sources = sky_field(100, 50, size=1.0, rng=1)
    >>> len(sources), sources['pmra'].unit
    (150, Unit("mas / yr"))
    """
    n_stars = as_integer(n_stars, 'n_stars', minimum=0)
    n_qsos = as_integer(n_qsos, 'n_qsos', minimum=0)
    size = as_real(size, 'size', above=0) * 60
    rng = as_rng(rng)
    n = n_stars + n_qsos
    is_qso = np.arange(n) >= n_stars
    plane = _apart(n, size, as_real(separation, 'separation', minimum=0), rng)
    sky_ra, sky_dec = _on_sky(plane, ra, dec)
    parallax, pmra, pmdec = np.where(is_qso, 0, _kinematics(n, rng))
    table = QTable({
        'id': np.arange(1, n + 1),
        'kind': np.where(is_qso, 'qso', 'star'),
        'ra': sky_ra * u.deg, 'dec': sky_dec * u.deg,
        'pmra': pmra * u.mas / u.yr, 'pmdec': pmdec * u.mas / u.yr,
        'parallax': parallax * bool(parallaxes) * u.mas,
        'ref_epoch': np.full(n, 2026.0) * u.yr})
    for name, mag in _magnitudes(is_qso, magnitudes, rng).items():
        table[f'mag_{name}'] = mag * u.mag
    return table


def _apart(n, size, separation, rng):
    """Draw n places (2, n) in a square, none closer than a separation."""
    places = rng.uniform(-size / 2, size / 2, (2, n))
    if separation == 0:
        return places
    for i in range(1, n):
        for _ in range(1000):
            gaps = np.hypot(*(places[:, :i] - places[:, i:i + 1]))
            if gaps.min() >= separation:
                break
            places[:, i] = rng.uniform(-size / 2, size / 2, 2)
        else:
            msg = (f'separation must leave room for {n} sources in a field '
                   f'of {size:g} arcsec, got {separation:g}')
            raise ValueError(msg)
    return places


def _on_sky(plane, ra, dec):
    """Return ra, dec [deg] of plane coordinates (2, n) [arcsec]."""
    ra, dec = as_real(ra, 'ra'), as_real(dec, 'dec', minimum=-90, maximum=90)
    xi, eta = np.radians(plane / 3600)
    d = np.radians(dec)
    # The gnomonic projection, solved for the sky; the pole is no exception.
    depth = np.cos(d) - eta * np.sin(d)
    longitude = np.degrees(np.arctan2(xi, depth))
    latitude = np.degrees(np.arctan2(np.sin(d) + eta * np.cos(d),
                                     np.hypot(xi, depth)))
    return (ra + longitude) % 360, latitude


def _kinematics(n, rng):
    """Return parallax [mas] and proper motions [mas / yr], (3, n)."""
    parallax = 0.5 * np.exp(-0.6 * rng.standard_normal(n))
    velocity = rng.normal([[-40.0], [-60.0]], 60.0, (2, n))
    return np.stack([parallax, *velocity * parallax / _KM_S])


def _magnitudes(is_qso, limits, rng):
    """Return a dictionary of magnitudes (n,) by band."""
    n = is_qso.size
    g = np.where(is_qso, 20 + 5.5 * rng.beta(2.2, 1.6, n),
                 18 + 8 * rng.beta(2.0, 1.4, n))
    if limits is not None:
        g = rng.uniform(*as_range(limits, 'magnitudes'), n)
    colours = np.array([_COLOURS['qso' if q else 'star'] for q in is_qso])
    colours = colours.reshape(-1, 3).T
    scatter = rng.standard_normal(n) * colours[2]
    return {'g': g, 'r': g - colours[0] - scatter * 2 / 3,
            'i': g - colours[1] - scatter}
