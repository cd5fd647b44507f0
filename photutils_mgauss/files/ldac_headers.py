"""The header of the image in a catalogue of the format LDAC."""
import warnings
from dataclasses import dataclass
from pathlib import Path

from astropy.io import fits

from photutils_mgauss.files.fits_files import open_fits
from photutils_mgauss.files.image_header import Cards
from photutils_mgauss.files.image_layers import wcs_of_header

__all__ = ['LDACHeader', 'read_ldac_header']

_CARD = 80  # letters
_MARK = b'SIMPLE'


@dataclass(frozen=True, eq=False)
class LDACHeader:
    """
    What the header of an image says of all stars that were seen in it.

    Attributes
    ----------
    wcs : `~astropy.wcs.WCS` or None
    time : `~astropy.time.Time` or None
        The middle of the exposure.
    """

    wcs: object
    time: object


def read_ldac_header(path):
    """
    Return what a catalogue says of its image.

    Parameters
    ----------
    path : str or path-like

    Returns
    -------
    LDACHeader or None
        None for catalogues of other formats, and of several images.

    Raises
    ------
    OSError
        If the file cannot be opened.
    ValueError
        If it is damaged.
    """
    with Path(path).open('rb') as file:
        if file.read(len(_MARK)) != _MARK:
            return None
    with open_fits(path, 'a catalogue of the format LDAC') as hdus:
        found = [hdu for hdu in hdus if hdu.name == 'LDAC_IMHEAD']
        if len(found) != 1:
            return None
        cards = found[0].data.field(0).ravel()
        header = fits.Header.fromstring(''.join(
            str(card).ljust(_CARD) for card in cards))
        with warnings.catch_warnings():
            # It notes what it repairs in old headers.
            warnings.simplefilter('ignore')
            return LDACHeader(wcs_of_header(header), Cards(header).time)
