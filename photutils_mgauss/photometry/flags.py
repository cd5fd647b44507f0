"""Flags of stars in words."""
from functools import partial

from photutils_mgauss.utils.flags import decode, names_of_bits

__all__ = ['decode_psf_flags']


def decode_psf_flags(flags, *, return_bit_values=False):
    """
    Return the names of the bits of ``flags``.

    Like `photutils.psf.decode_psf_flags`, but including the additional
    bits of tables of `CrowdedMixturePhotometry`.

    Parameters
    ----------
    flags : int or array_like of int
        One flag, or the column ``flags`` of a table.
    return_bit_values : bool, optional
        Whether to return the bits instead of their names.

    Returns
    -------
    list
        The names of the bits that are set; of an array, a nested list of its
        shape with such a list for each flag. A bit without a name in the
        installed photutils is called ``unknown_bit_N``.

    Raises
    ------
    TypeError, ValueError
        If ``flags`` are not integers, or negative.

    Examples
    --------
    >>> from photutils_mgauss import decode_psf_flags
    >>> decode_psf_flags([0, 8 + 262144])
    [[], ['no_convergence', 'not_a_star']]
    """
    return decode(flags, partial(names_of_bits,
                                 return_bit_values=return_bit_values))
