"""``mgauss photometry --stars``: the stars of a list instead of a search."""
from photutils_mgauss.cli import tools
from photutils_mgauss.cli.catalogues import say_program

_SKY = ('ra', 'dec')


def add_options(group):
    """Add the options to those of the measurement."""
    group.add_argument('--stars', metavar='LIST',
                       help='measure the stars of this list instead of those '
                            'that are found: a table with ra, dec or with x, '
                            'y (0 is the centre of the first pixel), or a '
                            'star list of another program')
    group.add_argument('--fixed', action='store_true',
                       help='with --stars: keep the positions of the list and '
                            'fit fluxes alone')


def check(options):
    """Raise if an option has no list, or does not go with one."""
    if options.fixed and options.stars is None:
        msg = '--fixed must be given with --stars'
        raise ValueError(msg)
    if options.fixed and options.crowded:
        msg = ('--fixed must be given without --crowded, which fits the '
               'positions of a list, too')
        raise ValueError(msg)
    if options.stars is not None and options.together:
        msg = '--stars must be given without --together'
        raise ValueError(msg)
    if options.stars is not None and not options.crowded and (
            options.threshold is not None):
        msg = ('--threshold must be given without --stars, whose stars are '
               'all measured')
        raise ValueError(msg)


def read_list(path):
    """
    Return the table of a list of stars, and their places if it has x and y.

    Raises
    ------
    ValueError
        If the table has no rows, or no places of either kind.
    """
    from photutils_mgauss.files.tables import read_table
    from photutils_mgauss.utils.star_columns import read_sources
    table, _ = read_table(path)
    if not len(table):
        msg = f'{path}: must have at least 1 star, got none'
        raise ValueError(msg)
    try:
        return table, read_sources(table)
    except ValueError as error:
        if not set(_SKY) <= set(table.colnames):
            raise ValueError(tools.no_places(path, table)) from error
    return table, None


class StarList:
    """
    The list that is measured in every image.

    Parameters
    ----------
    path : str or path-like
        Its file.
    options : `~argparse.Namespace`
        Of the command.
    """

    def __init__(self, path, options):
        self.path, self.options = path, options
        self.table, self.pixels = read_list(path)
        say_program(options, path, self.table)
        self.on_sky = set(_SKY) <= set(self.table.colnames)

    def in_image(self, image):
        """
        Return the stars in an image, with x, y and the row in the list, id.

        Places on the sky go before pixels if the image has a WCS: the list
        may be that of another image.
        """
        import numpy as np
        from astropy.table import QTable
        x, y, kind = self._places(image)
        ny, nx = image.data.shape
        with np.errstate(invalid='ignore'):
            inside = (np.abs(x - (nx - 1) / 2) < nx / 2) & (
                np.abs(y - (ny - 1) / 2) < ny / 2)
        tools.say(self.options, f'{image.path}: {inside.sum()} of the '
                  f'{len(x)} stars of {self.path} are in the image, by their '
                  f'{kind}')
        if not inside.any():
            msg = (f'must show a star of {self.path}, but all {len(x)} are '
                   f'outside, by their {kind}')
            raise ValueError(msg)
        return QTable({'id': np.flatnonzero(inside) + 1, 'x': x[inside],
                       'y': y[inside]})

    def _places(self, image):
        """Return x, y and what they were made of."""
        if self.on_sky and image.wcs is not None:
            from photutils_mgauss.cli.targets import moved_directions
            from photutils_mgauss.sky.observers import julian_years
            time = image.time
            year = None if time is None else float(julian_years(time))
            with tools.about(self.path):
                sky, moved = moved_directions(self.table, year)
            kind = 'positions on the sky'
            if moved:
                kind += f' moved to {year:.2f}'
            return *_pixels_of(image.wcs, sky), kind
        if self.pixels is None:
            msg = (f'must have a WCS for the ra and dec of {self.path}, got '
                   'none; give --wcs')
            raise ValueError(msg)
        return self.pixels.x, self.pixels.y, 'x and y'


def _pixels_of(wcs, directions):
    """Return x, y of unit vectors (3, n), NaN where there is no pixel."""
    import numpy as np
    from astropy.coordinates import SkyCoord

    from photutils_mgauss.sky.wcs import invert_wcs
    x, y = np.full((2, directions.shape[1]), np.nan)
    known = np.isfinite(directions).all(axis=0)
    sky = SkyCoord(directions.T[known], representation_type='cartesian')
    sky.representation_type = 'unitspherical'
    x[known], y[known] = invert_wcs(wcs, sky)
    return x, y
