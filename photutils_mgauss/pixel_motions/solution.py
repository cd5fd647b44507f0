"""What a fit to the pixels of all epochs found."""
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from photutils_mgauss.pixel_motions.campaign import Campaign
from photutils_mgauss.pixel_motions.cutouts import cutout_table
from photutils_mgauss.pixel_motions.errors import Errors
from photutils_mgauss.pixel_motions.solve import Solved
from photutils_mgauss.pixel_motions.stars import StarList
from photutils_mgauss.pixel_motions.tables import RELATIVE, flux_table
from photutils_mgauss.psf.renderer import MixtureRenderer
from photutils_mgauss.sky.observers import tdb
from photutils_mgauss.utils.notebook import with_table
from photutils_mgauss.utils.validation import as_shape


@dataclass(frozen=True, eq=False)
class PixelMotionSolution:
    """
    Positions, motions and fluxes of stars, from the pixels of all images.

    Parameters
    ----------
    stars : `~astropy.table.QTable`
        One row per star, with the columns of `MotionSolution.stars`: ``id``,
        ``ra``, ``dec``, ``pmra`` and so on with errors and correlations at
        ``ref_epoch``, the mean time of the images, ``flags`` (see
        `decode_motion_flags`); and ``flux`` and ``flux_err`` (n, images; NaN
        where an image does not show the star), ``n_images``,
        ``reduced_chi2``, and ``significance``, the signal-to-noise ratio of
        all images together.
    images : `~astropy.table.QTable`
        One row per image: the number of stars in it, and its ``shift``
        [pix] relative to the positions from its WCS and the other images.
    notes : tuple of str
        Sentences about problems of the images; the fit also gives each as
        a warning.

    Examples
    --------
    >>> from photutils_mgauss import (
    ...     ImageEpoch, Instrument, paper_exposures, PixelMotionFitter,
    ...     simulate_epochs, sky_field)
    >>> sources = sky_field(4, 4, size=0.12, magnitudes=(20, 22),
    ...                     parallaxes=False, separation=1.0, rng=1)
    >>> images = [ImageEpoch(one.image, one.psf, one.wcs, one.time,
    ...                      error=one.error)
    ...           for one in simulate_epochs(
    ...               sources, paper_exposures()[::3], rng=2,
    ...               instrument=Instrument(shape=(200, 200)))]
    >>> solution = PixelMotionFitter().fit(images, sources['id', 'ra', 'dec'])
    >>> solution
    <PixelMotionSolution: 8 of 8 stars, 3 images>
    >>> solution.stars['flux'].shape
    (8, 3)
    >>> solution.cutouts(size=15)['residual'].shape
    (3, 15, 15)
    >>> solution.fluxes['id', 'image', 'flux', 'flux_err'].colnames
    ['id', 'image', 'flux', 'flux_err']
    """

    stars: QTable
    images: QTable
    notes: tuple
    _campaign: Campaign = field(repr=False)
    _listed: StarList = field(repr=False)
    _solved: Solved = field(repr=False)
    _errors: Errors = field(repr=False)

    def __repr__(self):
        solved = int(np.isfinite(self.stars['ra']).sum())
        return (f'<PixelMotionSolution: {solved} of {len(self.stars)} stars, '
                f'{len(self.images)} images>')

    def _repr_html_(self):
        return with_table(repr(self), self.stars)

    def plot(self, *, ax=None):
        """
        Plot the proper-motion diagram.

        Parameters
        ----------
        ax : `~matplotlib.axes.Axes`, optional
            Where to draw; None is pyplot's current Axes.

        Returns
        -------
        `~matplotlib.axes.Axes`
        """
        from photutils_mgauss.plotting.motions import plot_proper_motions
        return plot_proper_motions(self.stars, ax=ax)

    @cached_property
    def fluxes(self):
        """
        One row per star and image that shows it: the light curves.

        ``id``, ``image``, ``time``, ``band``, ``x``, ``y``, ``flux`` and
        ``flux_err`` of the image alone, ``upper_limit`` (the flux, or 0 if
        that is negative, plus three errors) and ``local_bkg``.
        """
        return flux_table(self._campaign, self._listed, self._solved,
                          self._errors)

    @property
    def wcs(self):
        """The WCS of all images, corrected if frames were refined."""
        return self._campaign.frames

    @property
    def sky(self):
        """The stars as a `~astropy.coordinates.SkyCoord` with motions."""
        return SkyCoord(self.stars['ra'], self.stars['dec'],
                        pm_ra_cosdec=self.stars['pmra'],
                        pm_dec=self.stars['pmdec'], frame='icrs',
                        obstime=tdb(self.stars['ref_epoch'][0].value))

    def cutouts(self, star=None, *, size=15):
        """
        Return cutouts of one star from all images.

        Parameters
        ----------
        star : optional
            Its ``id``; by default the star with the smallest
            ``significance`` among those without a flag, except the flag
            for relative motions.
        size : int or (ny, nx) tuple of int, optional
            The shape of the stamps.

        Returns
        -------
        `~astropy.table.QTable`
            One row for each image that shows it: ``image``, ``time``,
            ``x``, ``y``, and (ny, nx) stamps with the star in the middle
            pixel: ``data`` less the sky, ``model`` of all stars and
            ``residual``. NaN outside of the image. Its ``meta`` has the
            ``ID`` and the ``SIGNIF`` of the star. Without any star there
            are no rows.

        Raises
        ------
        ValueError
            If there is no such star, or the size is not valid.

        """
        size = as_shape(size, 'size')
        if star is None and not self._measured.any():
            return QTable(names=('image', 'time', 'x', 'y', 'data', 'model',
                                 'residual'))
        row = self._row_of(star)
        table = cutout_table(self._campaign, self._solved, row, size)
        table.meta['ID'] = np.asarray(self.stars['id'])[row].item()
        table.meta['SIGNIF'] = float(self.stars['significance'][row])
        return table

    @property
    def _measured(self):
        """Whether nothing speaks against each star (n,)."""
        return (np.asarray(self.stars['flags']) & ~RELATIVE) == 0

    def _row_of(self, star):
        if star is None:
            signal = np.asarray(self.stars['significance'])
            return int(np.argmin(np.where(self._measured, signal, np.inf)))
        found = np.flatnonzero(np.asarray(self.stars['id']) == star)
        if not found.size:
            msg = f'star must be the id of one of the stars, got {star!r:.80}'
            raise ValueError(msg)
        return int(found[0])

    def model(self, image):
        """
        Draw the light of all stars in one image.

        Parameters
        ----------
        image : int
            Its number, from 0.

        Returns
        -------
        (ny, nx) `~numpy.ndarray`
            In the unit of the images, without a sky.
        """
        solved, campaign = self._solved, self._campaign
        seen = solved.weights[:, image] > 0
        stars = np.stack([*solved.pixels[seen, image].T,
                          solved.fluxes[seen, image] * campaign.scale])
        return MixtureRenderer(campaign.epochs[image].model).image(
            stars, 1e-3 * campaign.scale, campaign.shapes[image])
