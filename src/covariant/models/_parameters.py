"""Parameters of a model: with units and sources for people, and as leaves of the pytree for programs."""

from collections.abc import Callable, Collection
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from covariant._functional import Functional

AnyArray = Array | np.ndarray


class Parameter(eqx.Module):
    """A number of a model, or an array of numbers, with its unit and its source.

    The value is a leaf of the model's pytree: the same model with other values needs no new compilation.
    """

    value: Float[Array, "..."] = eqx.field(converter=lambda value: jnp.asarray(value, float))
    unit: str = eqx.field(static=True)
    source: str = eqx.field(static=True)


class Parametric(Functional):
    """A function of a model whose numbers are kept apart from its code.

    `Parametric(f, mass=1.0)` is called as `f` without its keyword `mass`. A program is compiled once for `f` and the
    shapes of its parameters; a closure, such as a lambda that uses a number from around it, would be compiled again for
    each number. `f` should be a function of a module, so that it is the same object each time. It gets the parameters
    as arrays, of the real type that matches its first floating-point argument with an axis.
    """

    function: Callable[..., Array] = eqx.field(static=True)
    parameters: dict[str, Any]

    def __init__(self, function: Callable[..., Array], /, **parameters: Any):
        self.function = function
        self.parameters = {name: _numbers(given) for name, given in parameters.items()}

    def __call__(self, *arguments: Any) -> Array:
        real = next((jnp.finfo(a.dtype).dtype for a in arguments if jnp.ndim(a) and _inexact(a)), jnp.zeros(()).dtype)
        return self.function(*arguments, **jax.tree.map(lambda number: number.astype(real), self.parameters))


def values(parameters: dict[str, Parameter]) -> dict[str, Array]:
    """The numbers of the parameters by name, for a `Parametric`."""
    return {name: parameter.value for name, parameter in parameters.items()}


def _numbers(given: Any) -> Any:
    if isinstance(given, dict):
        return {name: _numbers(entry) for name, entry in given.items()}
    return jnp.asarray(given, float)


def _inexact(array: Any) -> bool:
    return jnp.issubdtype(array.dtype, jnp.inexact)


def namespace(*given: Any) -> Any:
    """NumPy, or `jax.numpy` where one of the numbers is being traced by JAX, as the open ones of a family are.

    In NumPy a model is built without compiling anything.
    """
    return np if known(given) else jnp


def known(given: Any) -> bool:
    """Whether numbers can be looked at: none of them is being traced by JAX."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(given))


def check_parameters(
    system: str, parameters: dict[str, Parameter], signed: Collection[str] = (), may_vanish: Collection[str] = ()
) -> dict[str, Parameter]:
    """The parameters; raises `ValueError` for one that is not finite, or not positive and not named as an exception."""
    for name, parameter in parameters.items():
        if isinstance(parameter.value, Tracer):
            continue
        value = np.asarray(parameter.value)
        wanted = "finite" if name in signed else "≥ 0" if name in may_vanish else "positive"
        least = {"finite": -np.inf, "≥ 0": 0.0, "positive": np.nextafter(0, 1)}[wanted]
        if not (np.isfinite(value) & (value >= least)).all():
            raise ValueError(f"{system}: {name} [{parameter.unit}] must be {wanted}; got {value.tolist()!r}")
    return parameters
