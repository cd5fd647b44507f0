"""The PSF images that a grid of mixtures is fitted to, from any source."""
import warnings
from dataclasses import dataclass
from os import PathLike

import numpy as np
from astropy.utils.exceptions import AstropyUserWarning
from photutils.psf import ImagePSF

from photutils_mgauss.files.epsfs import places_in_meta
from photutils_mgauss.files.psfex import read_psfex
from photutils_mgauss.utils import compat
from photutils_mgauss.utils.validation import (
    as_floats,
    as_grid_shape,
    shown,
)

__all__ = ['NodeImages', 'of_gridded_psf', 'of_image_psf', 'of_psfex']


@dataclass(frozen=True, eq=False)
class NodeImages:
    """
    PSF images at M places.

    Attributes
    ----------
    images : (M, ny, nx) `~numpy.ndarray`
        Flux densities; all zero or all NaN where there is no PSF.
    positions : (M, 2) `~numpy.ndarray`
        The places (x, y) [pix].
    oversampling : (y, x) tuple of int
        Samples per unit of ``unit``.
    origin : (x, y) tuple of float
        The sample that is the star's position.
    unit : float
        The length that ``oversampling`` divides [pix]; 1 unless the sampling
        is not an integer.
    """

    images: np.ndarray
    positions: np.ndarray
    oversampling: tuple = (1, 1)
    origin: tuple = None
    unit: float = 1.0

    @property
    def centre(self):
        """The origin, by default the middle of the images."""
        if self.origin is not None:
            return tuple(self.origin)
        return tuple((n - 1) / 2 for n in self.images.shape[:0:-1])

    def widest_radius(self):
        """
        Return the radius of the circle that stays off the edge [unit].

        Two samples are left: some libraries put fill values into the first.
        """
        ny, nx = self.images.shape[1:]
        x, y = self.centre
        return min((min(x, nx - 1 - x) - 2) / self.oversampling[1],
                   (min(y, ny - 1 - y) - 2) / self.oversampling[0])

    @property
    def blank(self):
        """Which places have no PSF, (M,) bool."""
        flat = self.images.reshape(len(self.images), -1)
        return ((flat == 0) | np.isnan(flat)).all(axis=1)

    def filled_borders(self):
        """
        Return the mask (M, ny, nx) of borders that hold one value only.

        A row of exactly equal numbers was not measured.
        """
        mask = np.zeros(self.images.shape, bool)
        for axis in (1, 2):
            lines = np.moveaxis(self.images, axis, 0)
            constant = (lines == lines[..., :1]).all(axis=-1)
            outer = np.logical_and.accumulate(constant)
            outer |= np.logical_and.accumulate(constant[::-1])[::-1]
            np.moveaxis(mask, axis, 0)[outer] = True
        return mask & ~self.blank[:, None, None]


def of_gridded_psf(psf):
    """
    Return the ePSFs of a photutils grid.

    Parameters
    ----------
    psf : `~photutils.psf.GriddedPSFModel` or `~photutils.psf.STDPSFGrid`
        The grid.

    Returns
    -------
    NodeImages
    """
    if not hasattr(psf, 'grid_xypos'):
        hint = ('; GriddedMixturePSF.from_file reads files'
                if isinstance(psf, str | PathLike) else '')
        msg = f'psf must be a GriddedPSFModel, got {psf!r:.80}{hint}'
        raise TypeError(msg)
    oversampling = np.broadcast_to(psf.oversampling, 2).tolist()
    positions = _split_seams(_positions(psf))
    _check_one_chip(positions)
    return NodeImages(np.asarray(psf.data, dtype=float), positions,
                      tuple(oversampling))


def _positions(psf):
    """Return the places (x, y) of a photutils grid, as its file has them."""
    positions = np.array(psf.grid_xypos, float)
    meta = getattr(psf, 'meta', None) or {}
    places = (places_in_meta(meta) if compat.EXCHANGED_STPSF_NODES
              else None)
    if places is None:
        return positions
    read = np.array(meta['grid_xypos'], float)
    # As photutils orders images.
    order = np.lexsort(read.T)
    if not (_alike(read, places[:, ::-1])
            and np.array_equal(read[order], positions)
            and not np.array_equal(places[order], positions)):
        return positions
    warnings.warn('psf: this version of photutils exchanges x and y of the '
                  'nodes in files of STPSF; the mixtures stand where the '
                  'keywords DET_YXn say', AstropyUserWarning, stacklevel=2)
    return places[order]


def _alike(a, b):
    """Whether two sets of places are the same in any order."""
    return a.shape == b.shape and np.array_equal(
        a[np.lexsort(a.T)], b[np.lexsort(b.T)])


def of_psfex(path, grid_shape, *, limits=None, contexts=None):
    """
    Return a PSFEx model evaluated on a grid.

    Parameters
    ----------
    path, grid_shape, limits, contexts
        As of `GriddedMixturePSF.from_psfex`.

    Returns
    -------
    NodeImages
    """
    model = path if hasattr(path, 'image_at') else read_psfex(path)
    x, y = _psfex_lattice(model, as_grid_shape(grid_shape), limits)
    images = [model.image_at(x_0, y_0, **(contexts or {}))
              for x_0, y_0 in zip(x, y, strict=True)]
    return NodeImages(np.array(images), np.column_stack([x, y]),
                      origin=model.origin, unit=model.sampling)


def of_image_psf(psf, grid_xypos=None):
    """
    Return one or several ePSF images, those missing from a grid blank.

    Parameters
    ----------
    psf, grid_xypos
        As of `GriddedMixturePSF.from_image_psf`.

    Returns
    -------
    NodeImages
    """
    psfs = _image_psfs(psf)
    if grid_xypos is None:
        grid_xypos = np.zeros((1, 2))
    grid_xypos = as_floats(grid_xypos, 'grid_xypos', shape=(len(psfs), 2))
    positions, place = _full_lattice(grid_xypos)
    images = np.zeros((len(positions), *psfs[0].data.shape))
    images[place] = [one.data for one in psfs]
    return NodeImages(images, positions,
                      tuple(psfs[0].oversampling.tolist()),
                      tuple(psfs[0].origin.tolist()))


def _split_seams(positions):
    """
    Move lines of nodes that lie on another line one pixel further.

    Where two chips meet, grids that cover both have a last line of the one
    and a first line of the other, at one coordinate. The next pixel belongs
    to the other chip.
    """
    if len(np.unique(positions, axis=0)) == len(positions):
        return positions
    ends = np.flatnonzero(np.diff(positions[:, 0]) < 0)
    n = ends[0] + 1 if ends.size else len(positions)
    x, y = positions[:n, 0].copy(), positions[::n, 1].copy()
    whole = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    if not np.array_equal(whole, positions):
        return positions
    for axis in (x, y):
        axis[1:] += np.diff(axis) == 0
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _check_one_chip(positions):
    """Raise if several nodes are at one place."""
    places, counts = np.unique(positions, axis=0, return_counts=True)
    if (counts > 1).any():
        where = tuple(places[counts.argmax()].tolist())
        msg = (f'psf must have one node at each place, got {counts.max()} '
               f'nodes at {where}: the grid covers several chips. Give a '
               'dict with the grid of each chip, or read an STDPSF file with '
               "GriddedMixturePSF.from_file(path, detector='all')")
        raise ValueError(msg)


def _psfex_lattice(model, grid_shape, limits):
    """Return the positions x, y (M,) of the nodes for a PSFEx model."""
    axes = []
    limits = model.position_range if limits is None else limits
    for n, limit, dependence in zip(grid_shape[::-1], limits,
                                    model.position_range, strict=True):
        if dependence is None:
            axes.append(np.array([0.0 if limit is None else limit[0]]))
        else:
            axes.append(np.linspace(*limit, n) if n > 1
                        else np.array([np.mean(limit)]))
    x, y = np.meshgrid(*axes)
    return x.ravel(), y.ravel()


def _image_psfs(psf):
    """Return a list of ImagePSF models that are alike."""
    several = isinstance(psf, (list, tuple)) and not hasattr(psf, 'epsf')
    psfs = [getattr(one, 'epsf', one) for one in (psf if several else [psf])]
    for one in psfs:
        if not isinstance(one, ImagePSF):
            msg = f'psf must be made of ImagePSF models, got {shown(one)}'
            raise TypeError(msg)
        pairs = [(getattr(one, name), getattr(psfs[0], name))
                 for name in ('origin', 'oversampling')]
        pairs.append((one.data.shape, psfs[0].data.shape))
        if not all(np.array_equal(*pair) for pair in pairs):
            msg = ('psf must have ePSFs of one shape, origin and '
                   'oversampling, got different ones')
            raise ValueError(msg)
    return psfs


def _full_lattice(grid_xypos):
    """Return all nodes of the rectangular grid, and which ones are given."""
    x, i = np.unique(grid_xypos[:, 0], return_inverse=True)
    y, j = np.unique(grid_xypos[:, 1], return_inverse=True)
    place = j * x.size + i
    if np.unique(place).size != place.size:
        msg = 'grid_xypos must not have two nodes at one place'
        raise ValueError(msg)
    nodes = np.stack(np.meshgrid(x, y), axis=-1)
    return nodes.reshape(-1, 2), place
