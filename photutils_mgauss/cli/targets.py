"""
Single objects of known position and motion, whose parallax is wanted.

From far away an object is not near its place in a catalogue. Where it was
seen follows from its motion, a rough parallax, and where the observer was.
"""
import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord

from photutils_mgauss.sky.observers import julian_years, observer_position
from photutils_mgauss.sky.tangent_plane import MAS, unit_vectors
from photutils_mgauss.utils.star_columns import column_values

_NEEDED = ('id', 'ra', 'dec', 'pmra', 'pmdec', 'parallax', 'ref_epoch')
_MOTION = ('pmra', 'pmdec', 'ref_epoch')
# An object is looked for within this distance of its place [mas].
_RADIUS = 3000.0


def check_targets(table):
    """Raise if a table of objects lacks a column."""
    missing = [name for name in _NEEDED if name not in table.colnames]
    if missing:
        msg = (f'must have the columns {", ".join(_NEEDED)}, got no '
               f'{", ".join(missing)}')
        raise ValueError(msg)


def without_parallax(table):
    """Return the table as references whose parallax is not known."""
    known = table[[name for name in table.colnames
                   if not name.startswith('parallax')]]
    known['class'] = 'star'
    return known


def seen_directions(table, year, observer):
    """
    Return where objects are seen from, unit vectors (3, n).

    Parameters
    ----------
    table : `~astropy.table.Table`
        With the columns of Gaia, in its units.
    year : float
        Julian year (TDB).
    observer : str or `~astropy.coordinates.CartesianRepresentation` or None
    """
    moved, _ = moved_directions(table, year)
    place = observer_position(observer, np.array(year))
    parallax = column_values(table, 'parallax', u.mas)
    seen = moved - parallax / MAS * place[:, None]
    return seen / np.linalg.norm(seen, axis=0)


def moved_directions(table, year):
    """
    Return where objects are in a year, vectors (3, n) of about unit length.

    Parameters
    ----------
    table : `~astropy.table.Table`
        With ra and dec, and for motions pmra, pmdec and ref_epoch, in Gaia's
        units. An object without a motion stays where it is.
    year : float or None
        Julian year (TDB); None for the places in the table.

    Returns
    -------
    (3, n) `~numpy.ndarray`
    moved : bool
        Whether the table has motions and the year is known.
    """
    ra, dec = (column_values(table, name, u.deg) for name in ('ra', 'dec'))
    start = unit_vectors(ra, dec)
    if year is None or not set(_MOTION) <= set(table.colnames):
        return start, False
    pmra, pmdec = (np.nan_to_num(column_values(table, name, u.mas / u.yr))
                   for name in ('pmra', 'pmdec'))
    east = np.stack([-np.sin(np.radians(ra)), np.cos(np.radians(ra)),
                     np.zeros_like(ra)])
    north = np.cross(start, east, axis=0)
    passed = np.nan_to_num(year - julian_years(table['ref_epoch'],
                                               'ref_epoch'))
    return start + (pmra * east + pmdec * north) * passed / MAS, True


def only_targets(stars, targets, year, observer, radius):
    """
    Return the rows of the stars that are the objects, with their names.

    Parameters
    ----------
    stars : `~astropy.table.Table`
        With ra and dec [deg].
    targets : `~astropy.table.Table`
    year, observer
        See `seen_directions`.
    radius : float or None
        How far they may be from their places [mas].

    Returns
    -------
    `~astropy.table.Table`
    list of str
        What was found, a sentence for each object.
    """
    radius = _RADIUS if radius is None else radius
    places = SkyCoord(seen_directions(targets, year, observer).T,
                      representation_type='cartesian')
    places.representation_type = 'unitspherical'
    sky = SkyCoord(column_values(stars, 'ra'), column_values(stars, 'dec'),
                   unit=u.deg)
    row, distance, _ = places.match_to_catalog_sky(sky)
    distance = distance.to_value(u.mas)
    near = distance < radius
    names = [str(name) for name in targets['id']]
    words = [f'{name} is {away:.0f} mas from where it should be seen'
             + ('' if found else f', which is more than {radius:g}')
             for name, away, found in zip(names, distance, near, strict=True)]
    found = stars[row[near]]
    if 'id' in found.colnames:
        found.remove_column('id')
    found['id'] = np.array(names)[near]
    return found, words
