"""What both astropy PSF models share: copies, units, class identity."""
import copy
from operator import attrgetter

import numpy as np
from astropy.modeling import Fittable2DModel, Parameter
from astropy.units import (
    Quantity,
    Unit,
    UnitsError,
    dimensionless_unscaled,
    pixel,
)

from photutils_mgauss.utils import compat
from photutils_mgauss.utils.validation import real_array

# How files hold the parameters of a model: the columns and their units.
PARAMETER_COLUMNS = dict.fromkeys(
    ('name', 'value', 'unit', 'fixed', 'lower', 'upper'), '')


# Steps of numerical derivatives of ties, relative to the parameter or 1.
_TIE_STEP = 6e-6


class PSFParameter(Parameter):
    """A Parameter that is cheap to copy and checks what a user sets."""

    # Asked for before astropy's constructor has set it.
    _validator = None

    # astropy reads each parameter several times a call: by its own function.
    @Parameter.value.setter
    def value(self, value):
        """Take a number that is checked."""
        if self._validator is not None:
            self._validator(self._model, value)
        Parameter.value.fset(self, value)

    def step_to(self, value):
        """Take a value that need not be checked, as from a fit."""
        self._value = np.array(value, dtype=np.float64)

    def bound_copy(self, model):
        """Return a copy that belongs to ``model``, at a tenth of deepcopy."""
        new = object.__new__(type(self))
        new.__dict__.update(self.__dict__)
        new._model = model
        if isinstance(new._value, np.ndarray):
            new._value = new._value.copy()
        return new


class PSFModel(Fittable2DModel):
    """
    A PSF with total flux ``flux`` at (``x_0``, ``y_0``), for photutils.

    Subclasses add `evaluate`, `fit_deriv`, ``_state`` (what is not in
    Parameters, hashable) and ``_half_size`` (of the bounding box).

    Every model is a grid of nodes, and whoever draws or fits stars with one
    asks for its ``grid``, ``pixel_integrated``, ``interpolation`` and
    ``outside`` alone. One mixture is a grid of one node, for which it makes
    no difference how nodes are put together.
    """

    flux = PSFParameter(default=1, description='Total flux of the star.')
    x_0 = PSFParameter(default=0, description='Position of the star in x.')
    y_0 = PSFParameter(default=0, description='Position of the star in y.')

    # In standard deviations of the widest Gaussian; 5.5 leaves out 3e-7 of
    # its flux.
    bbox_factor = 5.5

    interpolation = 'blend'
    outside = 'clamp'
    contexts = ()

    if compat.STALE_GROUP_MODELS:
        __class__ = property(compat.group_class)

    def __str__(self):
        return super().__str__().replace(self.__class__.__name__,
                                         type(self).__name__)

    def _finish(self):
        self._ready = True

    def _described(self, details=''):
        """Return the text of ``repr``; details stand before the number."""
        pixel = ', pixel_integrated=True' if self._pixel_integrated else ''
        flux, x_0, y_0 = (np.array2string(
            np.asarray(one.value), separator=', ', threshold=6,
            formatter={'float_kind': '{:g}'.format})
            for one in (self.flux, self.x_0, self.y_0))
        return (f'<{type(self).__name__}(flux={flux}, x_0={x_0}, y_0={y_0}, '
                f'{details}n_components={self.n_components}{pixel})>')

    @property
    def pixel_integrated(self):
        """Whether mixtures are integrated over pixels, not sampled."""
        return self._pixel_integrated

    @property
    def has_fixed_shape(self):
        """Whether nothing is free but the flux and the position."""
        return all(one.fixed for one in self._all_parameters()[3:])

    @property
    def bounding_box(self):
        """The limits ((y_min, y_max), (x_min, x_max)) around the star."""
        dx, dy = self._half_size()
        x_0, y_0 = self.x_0, self.y_0
        return ((y_0 - dy, y_0 + dy), (x_0 - dx, x_0 + dx))

    def _all_parameters(self):
        """Return a tuple of all Parameters, quickly."""
        return attrgetter(*self.param_names)(self)

    def _array_to_parameters(self):
        # Fits come here with every step, and may step anywhere.
        for name in self.param_names:
            metrics = self._param_metrics[name]
            getattr(self, name).step_to(np.reshape(
                self._parameters[metrics['slice']], metrics['shape']))

    def _along_ties(self, columns, values):
        """
        Return derivatives that follow the parameters' ties.

        A free parameter carries along those that are tied to it, which
        astropy's fitters leave out: what they move is the sum of the columns
        times the derivatives of the ties. It takes long: ask first whether
        there are any, but not has_tied, for which astropy makes a dict of all
        parameters.
        """
        values = np.array([float(np.squeeze(v)) for v in values])
        free = [i for i, name in enumerate(self.param_names)
                if not (self.fixed[name] or self.tied[name])]
        probe = self.copy()
        followed = list(columns)
        for i in free:
            step = np.zeros(values.size)
            step[i] = _TIE_STEP * max(1, abs(values[i]))
            slope = (probe._tied_values(values + step)
                     - probe._tied_values(values - step)) / (2 * step[i])
            slope[i] = 0
            followed[i] = columns[i] + sum(slope[j] * columns[j]
                                           for j in np.flatnonzero(slope))
        return followed

    def _tied_values(self, values):
        """Return all parameters after those that are tied were moved."""
        self.parameters = values
        moved = values.copy()
        for i, name in enumerate(self.param_names):
            if self.tied[name]:
                moved[i] = float(np.squeeze(self.tied[name](self)))
                # A later tie may use an earlier one.
                getattr(self, name).step_to(moved[i])
        return moved

    def copy(self):
        """
        Return a copy that shares everything but parameters and constraints.

        Photutils copies its model for every star; use `copy.deepcopy` for a
        copy whose ``meta`` is deep, too.

        Returns
        -------
        model : same class
        """
        new = object.__new__(type(self))
        state = dict(self.__dict__)
        for name in self.param_names:
            state[name] = state[name].bound_copy(new)
        state['_parameters'] = state['_parameters'].copy()
        state['_mconstraints'] = {key: list(value) for key, value
                                  in state['_mconstraints'].items()}
        state['_constraints_cache'] = {}
        if '_meta' in state:
            state['_meta'] = copy.copy(state['_meta'])
        new.__dict__.update(state)
        return new

    def __copy__(self):
        return self.copy()

    def __deepcopy__(self, memo):
        # What is shared is never changed in place, so it stays shared.
        new = self.copy()
        memo[id(self)] = new
        # A compound model has the same Parameters as its parts.
        memo.update((id(getattr(self, name)), getattr(new, name))
                    for name in self.param_names)
        if '_meta' in new.__dict__:
            new.__dict__['_meta'] = copy.deepcopy(self.meta, memo)
        return new

    def deepcopy(self):
        """
        Return a deep copy of the model.

        Returns
        -------
        model : same class
        """
        return copy.deepcopy(self)

    def __reduce__(self):
        state = {key: value for key, value in self.__dict__.items()
                 if key != '_group_class'}
        return _new_model, (type(self),), state

    @property
    def input_units(self):
        """The units of x and y, or None if positions have none."""
        unit = self.x_0.input_unit
        if unit is None:
            return None
        return {self.inputs[0]: unit, self.inputs[1]: self.y_0.input_unit}

    def _parameter_units_for_data_units(self, inputs_unit, outputs_unit):
        x_unit, y_unit = (inputs_unit[name] for name in self.inputs)
        if x_unit != y_unit:
            msg = f'x and y must have the same unit, got {x_unit} and {y_unit}'
            raise UnitsError(msg)
        lengths = dict.fromkeys(self._length_names(), x_unit)
        return {**lengths, 'flux': outputs_unit[self.outputs[0]]}

    def _parameter_table(self):
        """Return the columns of a table of parameters; NaN is no bound."""
        parameters = self._all_parameters()
        bounds = np.array([p.bounds for p in parameters], dtype=float)
        return {'name': list(self.param_names),
                'value': np.array([p.value for p in parameters], float),
                'unit': [str(p.unit or '') for p in parameters],
                'fixed': [bool(p.fixed) for p in parameters],
                'lower': bounds[:, 0], 'upper': bounds[:, 1]}

    @staticmethod
    def _parameter_keywords(table):
        """Return the keywords that give a new model these parameters."""
        names = [str(name) for name in table['name']]
        bounds = np.column_stack([table['lower'], table['upper']])
        values = {name: float(value) * Unit(unit) if unit else float(value)
                  for name, value, unit in zip(
                      names, table['value'], table['unit'], strict=True)}
        return {**values,
                'fixed': dict(zip(names, map(bool, table['fixed']),
                                  strict=True)),
                'bounds': {name: tuple(None if np.isnan(b) else float(b)
                                       for b in pair)
                           for name, pair in zip(names, bounds, strict=True)}}

    def _length_names(self):
        """Return the names of the parameters that are lengths."""
        return ['x_0', 'y_0']


def _new_model(cls):
    return object.__new__(cls)


def strip_units(values):
    """Return lengths without units, all in the unit of the first."""
    unit = next((v.unit for v in values if isinstance(v, Quantity)), None)
    if unit is None:
        return values
    return [v.to_value(unit) if isinstance(v, Quantity) else v
            for v in values]


def plain_positions(x, y, x_0, y_0):
    """
    Return points and the star's position without units.

    A star's position without a unit is in pixels, and so must the points be.
    """
    if not isinstance(x_0, Quantity):
        for name, value in (('x', x), ('y', y)):
            unit = getattr(value, 'unit', None)
            if unit not in (None, pixel, dimensionless_unscaled):
                msg = (f'{name} must be in pixels, as x_0 has no unit, got '
                       f'{unit}')
                raise UnitsError(msg)
    return strip_units([x, y, x_0, y_0])


def split_flux(flux):
    """Return the flux as a plain float array and its unit or None."""
    if isinstance(flux, Quantity):
        return real_array(flux.value, 'flux'), flux.unit
    return real_array(flux, 'flux'), None


def with_unit(values, unit):
    """Return the values with the unit, or as they are if it is None."""
    return values if unit is None else Quantity(values, unit, copy=False)


def flat_points(*arrays):
    """
    Return flat contiguous float64 arrays and the shape they broadcast to.

    Arrays of one element stay one element long: kernels treat them as
    numbers.
    """
    arrays = [real_array(a, 'positions and fluxes') for a in arrays]
    shape = arrays[0].shape
    if shape == arrays[1].shape and all(
            a.size == 1 and a.ndim <= len(shape) for a in arrays[2:]):
        # The usual case, at a fifth of the price of the general one.
        return [a.ravel() for a in arrays], shape
    shape = np.broadcast_shapes(*(a.shape for a in arrays))
    x, y, *rest = arrays
    flat = [np.broadcast_to(a, shape).ravel() for a in (x, y)]
    flat += [a.ravel() if a.size == 1 else np.broadcast_to(a, shape).ravel()
             for a in rest]
    return flat, shape
