r"""
The camera of a simulated image: its numbers, and its bands.

The defaults are Table 1 of Nie et al. and the CSST survey camera.
"""
from dataclasses import dataclass

import numpy as np

from photutils_mgauss.utils.validation import as_floats, as_real, as_shape

# Photons per second and square centimetre in a relative band width of 1
# (d lambda / lambda) from a source of AB magnitude 0: 3631 Jy over h.
_AB_PHOTONS = 3631e-23 / 6.62607015e-27


@dataclass(frozen=True)
class Band:
    r"""
    A filter: what the telescope makes of a magnitude.

    The zeropoint, the AB magnitude that gives one electron per second, is
    that of a mean efficiency :math:`T` between two wavelengths,

    .. math::

        m_0 = 2.5 \log_{10}\left[\frac{3631\,\mathrm{Jy}}{h}
        \ln\frac{\lambda_2}{\lambda_1}\,
        \frac{\pi D^2}{4}\,T\right] .

    Parameters
    ----------
    name : str
        Its name.
    wavelengths : (2,) tuple of float
        The blue and the red limit [nm].
    efficiency : float
        Electrons per photon that reaches the pupil, optics included.
    sky : float
        The surface brightness of the sky [mag / arcsec^2].
    diameter : float, optional
        That of the unobstructed pupil [m].

    Raises
    ------
    ValueError
        If the wavelengths do not ascend or a value is not positive.

    Examples
    --------
    >>> from photutils_mgauss.simulation import Band
    >>> band = Band('g', (401, 547), 0.4, 22.6)
    >>> round(band.zeropoint, 3)
    25.825
    >>> round(float(band.rate(25.0)), 3)
    2.138

    ``CSST_BANDS`` is a dict of those the simulations know:

    >>> from photutils_mgauss import CSST_BANDS
    >>> list(CSST_BANDS), CSST_BANDS['i'].wavelengths
    (['g', 'r', 'i'], (684.0, 842.0))
    """

    name: str
    wavelengths: tuple
    efficiency: float
    sky: float
    diameter: float = 2.0

    def __post_init__(self):
        blue, red = as_floats(self.wavelengths, 'wavelengths', shape=(2,))
        if not 0 < blue < red:
            msg = ('wavelengths must be positive and ascend, got '
                   f'{self.wavelengths}')
            raise ValueError(msg)
        as_real(self.efficiency, 'efficiency', above=0, maximum=1)
        as_real(self.sky, 'sky')
        as_real(self.diameter, 'diameter', above=0)

    @property
    def zeropoint(self):
        """The AB magnitude of one electron per second."""
        blue, red = self.wavelengths
        area = np.pi * (50 * self.diameter)**2
        rate = _AB_PHOTONS * np.log(red / blue) * area * self.efficiency
        return float(2.5 * np.log10(rate))

    @property
    def pivot(self):
        """The middle wavelength of the band, geometrically [nm]."""
        return float(np.sqrt(self.wavelengths[0] * self.wavelengths[1]))

    def rate(self, magnitude):
        """
        Return electrons per second.

        Parameters
        ----------
        magnitude : array_like
            AB magnitudes.

        Returns
        -------
        float or `~numpy.ndarray`
        """
        magnitude = np.asarray(magnitude, float)
        return 10 ** (0.4 * (self.zeropoint - magnitude))

    def magnitude(self, rate):
        """
        Return AB magnitudes.

        Parameters
        ----------
        rate : array_like
            Electrons per second.

        Returns
        -------
        float or `~numpy.ndarray`
        """
        return self.zeropoint - 2.5 * np.log10(rate)


# The efficiencies are means over each band of the telescope and the detector,
# chosen so that two exposures of Table 1 reach the survey's depths at a
# signal to noise of 5: 26.3 (g), 26.0 (r) and 25.9 mag (i). The sky is the
# zodiacal light away from the ecliptic with some earthshine.
CSST_BANDS = {
    band.name: band for band in (
        Band('g', (401.0, 547.0), 0.37, 22.6),
        Band('r', (547.0, 684.0), 0.41, 22.2),
        Band('i', (684.0, 842.0), 0.43, 22.0),
    )}


@dataclass(frozen=True)
class Instrument:
    """
    A detector and its exposure; the defaults are Table 1 of Nie et al.

    Parameters
    ----------
    shape : (ny, nx) tuple of int, optional
        The pixels of the detector.
    pixel_scale : float, optional
        The side of a pixel [arcsec].
    gain : float, optional
        Electrons per count.
    read_noise : float, optional
        Standard deviation [electron].
    dark : float, optional
        Dark current [electron / s].
    bias : float, optional
        The level added before counting [electron].
    full_well : float, optional
        Electrons a pixel holds.
    exposure_time : float, optional
        Of one exposure [s].

    Raises
    ------
    ValueError
        If a value is negative or, where it must not, zero.

    Examples
    --------
    >>> from photutils_mgauss.simulation import CSST_BANDS, Instrument
    >>> camera = Instrument(exposure_time=300)
    >>> camera.gain, camera.read_noise, camera.full_well
    (1.1, 5.0, 90000.0)
    >>> round(camera.sky(CSST_BANDS['g']), 1)
    29.6
    """

    shape: tuple = (9232, 9216)
    pixel_scale: float = 0.074
    gain: float = 1.1
    read_noise: float = 5.0
    dark: float = 0.02
    bias: float = 500.0
    full_well: float = 90000.0
    exposure_time: float = 150.0

    def __post_init__(self):
        object.__setattr__(self, 'shape', as_shape(self.shape, 'shape'))
        for name in ('pixel_scale', 'gain', 'full_well', 'exposure_time'):
            as_real(getattr(self, name), name, above=0)
        for name in ('read_noise', 'dark', 'bias'):
            as_real(getattr(self, name), name, minimum=0)

    def sky(self, band):
        """
        Return the light of the sky in a pixel.

        Parameters
        ----------
        band : Band
            The filter.

        Returns
        -------
        float
            In one exposure [electron].
        """
        rate = band.rate(band.sky) * self.pixel_scale**2
        return float(rate * self.exposure_time)

    @property
    def dark_level(self):
        """The dark current of an exposure [electron]."""
        return self.dark * self.exposure_time

    @property
    def readout_variance(self):
        """The variance of reading a pixel, rounding included [electron^2]."""
        return self.read_noise**2 + self.gain**2 / 12
