"""
The bits of the column ``flags``: photutils' and this package's own.

Photutils' `~photutils.psf.decode_psf_flags` leaves bits out that it does not
know.
"""
import numpy as np
from photutils.psf import decode_psf_flags

# Ours stand out of the way of any that photutils may add.
SATURATED, BLENDED, NOT_A_STAR = 1 << 16, 1 << 17, 1 << 18
NOT_SEEN, REPEATED, MOTIONLESS = 1 << 19, 1 << 20, 1 << 21

OWN_NAMES = {
    SATURATED: 'mostly_masked',
    BLENDED: 'blended',
    NOT_A_STAR: 'not_a_star',
    NOT_SEEN: 'not_detected',
    REPEATED: 'repeated_entry',
    MOTIONLESS: 'no_motion',
}


def names_of_bits(flag, *, return_bit_values=False):
    """
    Return a name for each bit that is set, or the bits themselves.

    Parameters
    ----------
    flag : int
    return_bit_values : bool, optional

    Returns
    -------
    list of str or list of int
        Bits that nobody has a name for are called by their number.
    """
    flag = int(flag)
    bits = [1 << k for k in range(flag.bit_length()) if flag >> k & 1]
    if return_bit_values:
        return bits
    return [_name(bit) for bit in bits]


def _name(bit):
    if bit in OWN_NAMES:
        return OWN_NAMES[bit]
    names = decode_psf_flags(bit)
    return names[0] if names else f'unknown_bit_{bit}'


def decode(flags, words_of=names_of_bits):
    """
    Return the words of a flag, or of each of many, nested as they are.

    Parameters
    ----------
    flags : int or array_like of int
    words_of : callable, optional
        Given a flag, it returns a list.

    Raises
    ------
    TypeError, ValueError
        If ``flags`` are not integers, or negative.
    """
    try:
        flags = np.ma.filled(np.ma.asarray(flags), 0)
    except ValueError as error:
        msg = f'flags must be an array of integers, got {flags!r:.80}'
        raise TypeError(msg) from error
    if flags.dtype.kind not in 'ui':
        msg = f'flags must be integers, got dtype {flags.dtype}'
        raise TypeError(msg)
    if (flags < 0).any():
        msg = f'flags must not be negative, got {flags.min()}'
        raise ValueError(msg)
    # Few of the many flags of a table differ.
    values, which = np.unique(flags, return_inverse=True)
    words = [words_of(int(value)) for value in values]
    return _nest(which.reshape(flags.shape), words)


def _nest(which, words):
    if which.ndim == 0:
        return list(words[int(which)])
    return [_nest(part, words) for part in which]
