"""What is asked of the fit of a field, checked before pixels are read."""
from dataclasses import dataclass

import numpy as np

from photutils_mgauss.field.choice import by_default
from photutils_mgauss.field.contexts import context_names
from photutils_mgauss.utils.validation import as_choice, as_integer, as_real

# The degree of the polynomials with a PSF to start from.
_TUNED_DEGREE = 1


@dataclass(frozen=True)
class FieldOptions:
    """
    The options of `fit_mixture_field`, under their names there.

    Raises
    ------
    TypeError, ValueError
        If one is not valid, or does not go with another.
    """

    n_components: object = None
    degree: object = None
    radius: float | None = None
    local_bkg: bool = False
    effective_gain: float | None = None
    reject: bool = True
    regularization: float = 1.0
    start: object = None
    centre: str = 'core'
    normalise: str = 'auto'
    pixel_integrated: object = 'auto'
    correlated_noise: bool = True
    contexts: tuple = ()
    brighter_fatter: object = False

    def __post_init__(self):
        checked = {
            'n_components': _number(self.n_components, 'n_components', 1),
            'degree': _number(self.degree, 'degree', 0),
            'regularization': as_real(self.regularization,
                                      'regularization', above=0),
            'contexts': context_names(self.contexts)}
        if self.radius is not None:
            checked['radius'] = as_real(self.radius, 'radius', minimum=2)
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        self._check_words()
        if self.start is not None:
            self._check_known()
        object.__setattr__(self, 'pixel_integrated', _pixel_integrated(
            self.pixel_integrated, self.start))

    def size(self, n_stars):
        """Return number of Gaussians and degree, or 'auto', for n stars."""
        degree = self.degree
        if self.start is not None and degree is None:
            degree = _TUNED_DEGREE
        return by_default(self.n_components, degree, n_stars)

    def _check_words(self):
        """Raise unless the options are those that there are."""
        as_choice(self.centre, 'centre', ('core', 'flux', 'catalogue'))
        as_choice(self.normalise, 'normalise',
                  ('auto', 'stamps', 'curve-of-growth'))
        if self.centre == 'catalogue' and not self.contexts:
            msg = ("centre must be 'core' or 'flux' without contexts, got "
                   "'catalogue'")
            raise ValueError(msg)
        if not isinstance(self.brighter_fatter, (bool, np.bool_)) and (
                self.brighter_fatter != 'auto'):
            msg = ("brighter_fatter must be 'auto', True or False, got "
                   f'{self.brighter_fatter!r}')
            raise ValueError(msg)

    def _check_known(self):
        """Raise if more is asked of a known PSF than its changes."""
        if self.normalise == 'curve-of-growth':
            msg = ("normalise must be 'stamps' with start, whose wings are "
                   f'known already, got {self.normalise!r}')
            raise ValueError(msg)
        if self.contexts or self.brighter_fatter is True:
            msg = ('contexts and brighter_fatter=True must not be given with '
                   'start, of which only changes with position are fitted')
            raise ValueError(msg)


def _number(value, name, minimum):
    if value is None or (isinstance(value, str) and value == 'auto'):
        return value
    return as_integer(value, name, minimum=minimum)


def _pixel_integrated(value, start):
    """Return whether to integrate over pixels, or 'auto'."""
    if not isinstance(value, (bool, np.bool_)) and value != 'auto':
        msg = f"pixel_integrated must be 'auto', True or False, got {value!r}"
        raise ValueError(msg)
    if start is None:
        return value if isinstance(value, str) else bool(value)
    known = bool(getattr(start, 'pixel_integrated', False))
    if value is True and not known:
        msg = ('pixel_integrated must not be True where start is sampled: its '
               "mixtures contain the pixel already; leave it at 'auto'")
        raise ValueError(msg)
    return known if isinstance(value, str) else bool(value)
