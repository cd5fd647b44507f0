"""The stars of an image that its PSF is fitted to."""
import warnings

from photutils_mgauss.cli import tools

_RADIUS = 10.0
# No PSF changes its width by so much over a detector.
_WILD = 1.5


def check_image(image):
    """Raise if an image cannot be measured, and before any is."""
    with tools.about(image.path):
        image.check()


def check_start(options):
    """Raise for options that a PSF to start from leaves no room for."""
    if options.start is not None and options.n_components is not None:
        msg = ('--n-components must be left out with --start, whose Gaussians '
               f'are kept; got {options.n_components}')
        raise ValueError(msg)


def check_stars(options):
    """Raise if the stars to choose from are no list of stars."""
    if options.stars is not None:
        from photutils_mgauss.cli.given_stars import read_list
        read_list(options.stars)


def fit_options(options):
    """Return the options of `fit_mixture_field` that are given."""
    from photutils_mgauss.cli.psf_files import read_psf
    given = {name: getattr(options, name)
             for name in ('n_components', 'degree', 'radius',
                          'pixel_integrated')}
    if options.start is not None:
        with tools.about(options.start):
            given['start'] = read_psf(options.start)
    return {'radius': _RADIUS} | {name: value for name, value
                                  in given.items() if value is not None}


def choose(image, radius, options):
    """Return the stars of an image, with those selected for its PSF."""
    from photutils_mgauss.field.selection import select_psf_stars
    sources = None
    if options.stars is not None:
        from photutils_mgauss.cli.given_stars import StarList
        given = StarList(options.stars, options)
        sources = (given.in_image(image) if given.pixels is None
                   else given.table)
    return select_psf_stars(
        image.without_sky, sources, error=image.noise.total, mask=image.mask,
        radius=radius, saturation=image.saturation_without_sky,
        min_snr=options.min_snr, max_stars=options.max_stars)


def no_stars(image, stars):
    """Return why no star was good enough."""
    reasons = [str(reason) for reason in stars['reason']]
    counts = ', '.join(f'{reasons.count(reason)} {reason}'
                       for reason in sorted(set(reasons)))
    return (f'{image.path}: must have at least 1 star good for the PSF, got '
            f'none of {len(stars)}: {counts}; try --min-snr or --radius')


def check_nodes(path, grid, stars):
    """
    Warn if the width of a PSF far from all stars is not to be believed.

    Parameters
    ----------
    path : str or path-like
        Of the image.
    grid : GriddedMixturePSF
    stars : `~astropy.table.Table`
        Those used, with ``x`` and ``y`` [pix].
    """
    import numpy as np
    from scipy.spatial import cKDTree

    from photutils_mgauss.psf.shapes import adaptive_moments
    fwhm = np.atleast_1d(adaptive_moments(grid.mixtures).fwhm)
    _, near = cKDTree(grid.grid_xypos).query(np.stack(
        [np.asarray(stars[name], float) for name in 'xy'], axis=1))
    ratio = fwhm / np.nanmedian(fwhm[near])
    wild = (ratio > _WILD) | (ratio < 1 / _WILD)
    if wild.any():
        warnings.warn(
            f'{path}: in {wild.sum()} of {wild.size} nodes the PSF is '
            f'{np.nanmin(ratio):.2g} to {np.nanmax(ratio):.2g} times as wide '
            'as at the typical star: there are no stars near them; give a '
            'lower --degree, such as 1', UserWarning, stacklevel=2)
