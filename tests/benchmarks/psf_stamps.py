"""PSF stamps of a small space telescope, to measure fits on."""
import numpy as np

ARCSEC = np.pi / 180 / 3600
DIAMETER = 2.0  # [m], unobstructed
WAVELENGTHS = (430e-9, 460e-9, 490e-9, 520e-9)  # [m]
PIXEL = 0.074  # [arcsec]; stamps are sampled twice as finely
SMEARING = 0.040  # [arcsec], jitter and diffusion as one Gaussian
RMS_WAVEFRONT = 80e-9  # [m]
N_FINE, STEP = 128, PIXEL / 8


def zernikes(x, y):
    """Return defocus to the second trefoil, Noll 4 to 10, and spherical."""
    r2 = x * x + y * y
    return np.array([
        np.sqrt(3) * (2 * r2 - 1), np.sqrt(6) * 2 * x * y,
        np.sqrt(6) * (x * x - y * y), np.sqrt(8) * (3 * r2 - 2) * y,
        np.sqrt(8) * (3 * r2 - 2) * x, np.sqrt(8) * (3 * x * x - y * y) * y,
        np.sqrt(8) * (x * x - 3 * y * y) * x,
        np.sqrt(5) * (6 * r2 * r2 - 6 * r2 + 1)])


def field_coefficients(n_side, rng):
    """Return smooth random coefficients (n_side^2, 8) of a wavefront."""
    axis = np.linspace(-1, 1, n_side)
    u, v = np.meshgrid(axis, axis)
    basis = np.array([u**i * v**j for i in range(4) for j in range(4 - i)])
    size = 1 / (1 + np.arange(4)[:, None] + np.arange(4))
    size = np.array([size[i, j] for i in range(4) for j in range(4 - i)])
    c = np.einsum('zp,pij->zij', rng.standard_normal((8, 10)) * size, basis)
    c *= RMS_WAVEFRONT / np.sqrt((c**2).sum(axis=0).mean())
    return c.reshape(8, -1).T


def make_stamps(n_side=30, *, seed=1, oversampling=2):
    """
    Return ePSFs on a grid of the field, native sum 1.

    They are (n_side^2, 30, 30) or, with an oversampling of 4, twice as large.

    The middle of a stamp is between its pixels, and it holds about 98 % of
    the flux.
    """
    pupil_axis = (np.arange(64) - 31.5) / 32
    x, y = np.meshgrid(pupil_axis, pupil_axis)
    inside = x * x + y * y <= 1
    modes = zernikes(x, y)
    angle = (np.arange(N_FINE) - (N_FINE - 1) / 2) * 2 * STEP * ARCSEC
    kernels = [np.exp(-2j * np.pi * np.outer(
        angle, pupil_axis * DIAMETER / 2) / w) for w in WAVELENGTHS]
    frequency = np.fft.fftfreq(N_FINE, 2 * STEP)
    fx, fy = np.meshgrid(frequency, frequency)
    blur = (np.exp(-2 * (np.pi * SMEARING)**2 * (fx**2 + fy**2))
            * np.sinc(fx * PIXEL) * np.sinc(fy * PIXEL))
    rng = np.random.default_rng(seed)
    cut = {2: _every_second, 4: _middle}[oversampling]
    return np.array([cut(_image(np.tensordot(c, modes, 1), inside, kernels,
                                blur))
                     for c in field_coefficients(n_side, rng)])


def _image(path, inside, kernels, blur):
    total = 0
    for kernel, wavelength in zip(kernels, WAVELENGTHS, strict=True):
        field = inside * np.exp(2j * np.pi * path / wavelength)
        total = total + np.abs(kernel @ field @ kernel.T)**2
    total = np.fft.ifft2(np.fft.fft2(total) * blur).real
    return total * 16 / total.sum()  # per native pixel of 4 x 4 samples


def _middle(image):
    cut = slice(N_FINE // 2 - 30, N_FINE // 2 + 30)
    return image[cut, cut]


def _every_second(image):
    # Every second sample, between which the middle lies.
    first = N_FINE // 2 - 30
    middle = (image[first:first + 60] + image[first + 1:first + 61]) / 2
    middle = (middle[:, first:first + 60] + middle[:, first + 1:first + 61]
              ) / 2
    return middle[::2, ::2]
