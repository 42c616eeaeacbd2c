"""Parameters of a model, with units and sources for readers, and as leaves of a pytree for programs."""

import math
import sys
from collections.abc import Callable, Collection, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from covariant._functional import Functional
from covariant._typing import Numbers
from scalargraph.errors import InputError

AnyArray = Array | np.ndarray

POSITIVE, ZERO_OR_MORE, ANY_SIGN = math.ulp(0.0), 0.0, -sys.float_info.max
"""Least values of a number. With the smallest positive float, one comparison `≥` also expresses "positive"."""
RANGES = {POSITIVE: "positive", ZERO_OR_MORE: "≥ 0", ANY_SIGN: "finite"}


class Parameter(eqx.Module):
    """A number of a model, or an array of numbers, with its unit and its source.

    The value is a leaf of the model's pytree, so the same model with other values needs no new compilation.

    Use it in your own model, so that files, tables and messages name the number with its unit. Pass the values to the
    functions through `Parametric`, so that `covariant.fit` can fit them.

    Attributes:
        value: The number or array, converted to real floating point.
        unit: Unit, such as "kg m^2"; "1" for none.
        source: Source of the value.

    Example:
        >>> from covariant import models
        >>> mass = models.Parameter(2, "kg", "weighed")
        >>> mass.value.item(), mass.unit
        (2.0, 'kg')
    """

    value: Float[Array, "..."] = eqx.field(converter=lambda value: jnp.asarray(value, float))
    unit: str = eqx.field(static=True)
    source: str = eqx.field(static=True)


class Parametric(Functional):
    """A function of a model whose parameters are stored separately from its code.

    `Parametric(f, mass=1.0)` is called like `f`, without the keyword `mass`. A program is compiled once for `f` and the
    shapes of its parameters; a closure, such as a lambda that uses a number from its surroundings, would be compiled
    again for each number. The parameters are passed to `f` as arrays, with the real type of its first floating-point
    argument that has an axis.

    Attributes:
        function: The function `f`. Define it at module level, so that it is the same object each time.
        parameters: Its parameters by name: numbers, arrays, or nested dictionaries of them.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> def potential(q, stiffness):
        ...     return stiffness * q[0] ** 2 / 2
        >>> spring = models.Parametric(potential, stiffness=3.0)
        >>> spring(jnp.array([2.0])).item()
        6.0
    """

    function: Callable[..., Array] = eqx.field(static=True)
    parameters: dict[str, Any]

    def __init__(self, function: Callable[..., Array], /, **parameters: object):
        self.function = function
        self.parameters = {name: _numbers(value) for name, value in parameters.items()}

    def __call__(self, *arguments: Array) -> Array:
        # Double-precision parameters would otherwise promote a single-precision state.
        real = next((jnp.finfo(a.dtype).dtype for a in arguments if jnp.ndim(a) and _inexact(a)), jnp.zeros(()).dtype)
        return self.function(*arguments, **jax.tree.map(lambda number: number.astype(real), self.parameters))


Inputs = int | Mapping[str, str] | None
"""Number of inputs of a model, or the unit of each by its name; None for as many as velocities."""


def name_inputs(inputs: Inputs) -> tuple[int | None, tuple[str, ...], tuple[str, ...]]:
    """Number, names and units of inputs; no names where only their number is given."""
    named = inputs if isinstance(inputs, Mapping) else {}
    return (len(named) or None) if isinstance(inputs, Mapping) else inputs, tuple(named), tuple(named.values())


def values(parameters: dict[str, Parameter]) -> dict[str, Array]:
    """Values of parameters by name, as the keywords of a `Parametric`."""
    return {name: parameter.value for name, parameter in parameters.items()}


def _numbers(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _numbers(entry) for name, entry in value.items()}
    return jnp.asarray(value, float)


def _inexact(array: AnyArray) -> bool:
    return jnp.issubdtype(array.dtype, jnp.inexact)


def namespace(*given: object) -> Any:
    """The array library for these numbers: `jax.numpy` if one of them is traced by JAX, else NumPy.

    Open parameters of a family are traced. With NumPy a model is built without compiling anything.
    """
    return np if known(given) else jnp


def known(given: object) -> bool:
    """Whether the values of all these numbers are known, that is, none is traced by JAX."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(given))


def check_parameters(
    system: str, parameters: dict[str, Parameter], signed: Collection[str] = (), may_vanish: Collection[str] = ()
) -> dict[str, Parameter]:
    """Check the values of parameters: each must be finite and, unless named as an exception, positive."""
    for name, parameter in parameters.items():
        least = ANY_SIGN if name in signed else ZERO_OR_MORE if name in may_vanish else POSITIVE
        check_range(f"{system}: {name} [{parameter.unit}]", parameter.value, least)
    return parameters


def check_range(what: str, value: Numbers, least: float) -> None:
    """Raise `ValueError` for a number that is not finite or below its least value; traced numbers are not checked."""
    if known(value) and not ((numbers := np.asarray(value)) >= least).all() & np.isfinite(numbers).all():
        raise InputError(f"{what} must be {RANGES[least]}; got {numbers.tolist()!r}")
