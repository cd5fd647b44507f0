r"""
The camera of a simulated image: its numbers, and its bands.

The defaults are Table 1 of Nie et al. and the CSST survey camera.
"""
from dataclasses import dataclass, field

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
    response : (n,) tuple of float, optional
        The relative efficiency at wavelengths that divide the band evenly,
        from the blue limit to the red: how much each wavelength counts in
        the PSF of `Optics`. By default all count alike. The zeropoint does
        not depend on it.

    Raises
    ------
    ValueError
        If the wavelengths do not ascend, a value is not positive, or the
        response is negative everywhere or somewhere.

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
    (['NUV', 'u', 'g', 'r', 'i', 'z', 'y'], (684.0, 842.0))
    """

    name: str
    wavelengths: tuple
    efficiency: float
    sky: float
    diameter: float = 2.0
    response: tuple = field(default=(1.0, 1.0), kw_only=True)

    def __post_init__(self):
        blue, red = as_floats(self.wavelengths, 'wavelengths', shape=(2,))
        if not 0 < blue < red:
            msg = ('wavelengths must be positive and ascend, got '
                   f'{self.wavelengths}')
            raise ValueError(msg)
        as_real(self.efficiency, 'efficiency', above=0, maximum=1)
        as_real(self.sky, 'sky')
        as_real(self.diameter, 'diameter', above=0)
        response = as_floats(self.response, 'response', shape=(None,))
        if response.size < 2 or response.min() < 0 or response.max() <= 0:
            msg = ('response must have two or more values, none negative and '
                   f'not all zero, got {self.response}')
            raise ValueError(msg)

    def colours(self, n):
        """
        Return wavelengths that stand for the band, and how much each counts.

        Parameters
        ----------
        n : int
            Their number: the middles of as many equal parts of the band.

        Returns
        -------
        (2, n) `~numpy.ndarray`
            Wavelengths [nm] and weights that sum to 1.

        Examples
        --------
        >>> from photutils_mgauss.simulation import Band
        >>> band = Band('g', (400, 500), 0.4, 22.6, response=(1, 3))
        >>> band.colours(2).tolist()
        [[425.0, 475.0], [0.375, 0.625]]
        """
        blue, red = self.wavelengths
        middles = (np.arange(n) + 0.5) / n
        knots = np.linspace(0, 1, len(self.response))
        weights = np.interp(middles, knots, self.response)
        return np.stack([blue + (red - blue) * middles,
                         weights / weights.sum()])

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
# signal to noise of 5: 25.4 (NUV), 25.4 (u), 26.3 (g), 26.0 (r), 25.9 (i),
# 25.2 (z) and 24.4 mag (y). The sky is the zodiacal light away from the
# ecliptic with some earthshine. Responses are chosen, too: a silicon detector
# that gains towards the red in the blue bands and loses beyond 800 nm.
CSST_BANDS = {
    name: Band(name, wavelengths, efficiency, sky, response=response)
    for name, wavelengths, efficiency, sky, response in (
        ('NUV', (255.0, 317.0), 0.18, 25.0, (0.60, 0.80, 0.90, 1.00, 1.00)),
        ('u', (322.0, 396.0), 0.20, 23.3, (0.75, 0.85, 0.92, 0.97, 1.00)),
        ('g', (401.0, 547.0), 0.37, 22.6, (0.85, 0.93, 0.98, 1.00, 1.00)),
        ('r', (547.0, 684.0), 0.41, 22.2, (1.00, 1.00, 1.00, 0.99, 0.97)),
        ('i', (684.0, 842.0), 0.43, 22.0, (1.00, 0.98, 0.95, 0.90, 0.84)),
        ('z', (842.0, 1000.0), 0.26, 21.9, (1.00, 0.88, 0.70, 0.48, 0.25)),
        ('y', (937.0, 1000.0), 0.31, 21.8, (1.00, 0.87, 0.70, 0.52, 0.36)),
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
