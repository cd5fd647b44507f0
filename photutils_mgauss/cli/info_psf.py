"""What ``mgauss info`` says of PSF files."""


def of_mixtures(path):
    """Return what a PSF of this package is, in lines."""
    import numpy as np

    from photutils_mgauss.cli.psf_files import read_psf
    from photutils_mgauss.psf.shapes import adaptive_moments
    psf = read_psf(path)
    ny, nx = psf.grid_shape
    fwhm = np.atleast_1d(adaptive_moments(psf.mixtures).fwhm)
    kind = ('integrated over pixels' if psf.pixel_integrated
            else 'sampled at the middles of pixels')
    nodes = (f'  {nx} x {ny} nodes of {psf.n_components} Gaussians, '
             f'{_range(psf.grid_xypos)}')
    width = (f'  FWHM {np.nanmin(fwhm):.2f} to {np.nanmax(fwhm):.2f} pix; '
             f'{kind}')
    return [nodes, width]


def of_other(kind, path, *, ext, detector):
    """
    Return what a PSF file of another program is, in lines.

    Parameters
    ----------
    kind : str
        See `photutils_mgauss.files.epsfs.psf_kind`.
    path : `~pathlib.Path`
    ext : str or None
        The extension that the user chose, None for all.
    detector : str or None
        The detector of a STDPSF file that the user chose, None for all.
    """
    from photutils_mgauss.files import epsfs
    from photutils_mgauss.files.psfex import read_psfex
    ext = 'all' if ext is None else ext
    if kind == 'stdpsf':
        return _each('detector', detector, _of_grid, epsfs.read_stdpsf(
            path, 'all' if detector is None else detector))
    if kind == 'stpsf':
        return _each('extension', ext, _of_grid,
                     epsfs.read_stpsf(path, ext))
    if kind == 'psfex':
        return _each('extension', ext, _of_psfex, read_psfex(path, ext=ext))
    return _each('extension', ext, _of_image,
                 epsfs.read_image_psf(path, ext=ext))


def _each(name, chosen, words, found):
    """Return a line on each PSF of a file, which is a dict of all or one."""
    found = found if isinstance(found, dict) else {chosen: found}
    option = {'detector': '--detector', 'extension': '--ext'}[name]
    lines = [f'  {name} {key}: {words(one)}' for key, one in found.items()]
    return lines + ([f'  {len(found)} PSFs: choose one with {option}']
                    if len(found) > 1 else [])


def _range(places):
    """Return the words for the area that nodes (n, 2) are in."""
    (left, bottom), (right, top) = places.min(axis=0), places.max(axis=0)
    return f'x {left:g} to {right:g}, y {bottom:g} to {top:g}'


def _of_grid(grid):
    n, ny, nx = grid.data.shape
    columns, rows = (len(set(values)) for values in grid.grid_xypos.T)
    nodes = f'{columns} x {rows}' if columns * rows == n else f'{n}'
    return (f'{nodes} nodes, {_range(grid.grid_xypos)}; images of {nx} x '
            f'{ny} samples, {grid.oversampling} to a pixel')


def _of_image(psf):
    ny, nx = psf.data.shape
    samples = max(psf.oversampling)
    return f'an image of {nx} x {ny} samples, {samples} to a pixel'


def _of_psfex(model):
    n, ny, nx = model.planes.shape
    variables = ' and '.join(model.contexts) or 'nothing'
    return (f'{nx} x {ny} samples of {model.sampling:g} pix, {n} terms of a '
            f'polynomial of {variables}')
