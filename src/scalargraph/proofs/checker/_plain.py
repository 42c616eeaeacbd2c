"""Computes the checker's derivatives: JAX differentiates a function after its custom derivative rules are removed.

The prover differentiates a graph instead, by `scalargraph`, so that an error in one of the two methods is detected.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from scalargraph import LoweringError
from scalargraph.errors import InputError
from scalargraph.graph import Branch, Call, ClosedJaxpr, Scan, While, equations
from scalargraph.proofs.checker._primitives import is_real, unrolled


def plain(function: Callable) -> Callable:
    """The function without custom derivative rules and without `stop_gradient`, for JAX to differentiate.

    In it |x|, min and max are written as choices, so that at a kink both one-sided derivatives are considered.
    """

    def inlined(*x: Any) -> Any:
        closed, shape = jax.make_jaxpr(function, return_shape=True)(*x)
        try:
            results = _evaluate_body(ClosedJaxpr(closed.jaxpr, closed.consts), jax.tree.leaves(x))
        except LoweringError as error:
            raise InputError(f"{error}") from error
        return jax.tree.unflatten(jax.tree.structure(shape), results)

    return inlined


def jacobian(function: Callable[[Any], Any], x: Any) -> Any:
    """Compute the Jacobian of a function of an array, with the axes of x last."""
    return jax.jacfwd(plain(function))(x)


def value_and_jacobian(function: Callable[[Any], Any], x: Any) -> tuple[Any, Any]:
    """Compute value and Jacobian with one evaluation of the function."""
    inlined = plain(function)
    slope, value = jax.jacfwd(lambda y: (inlined(y),) * 2, has_aux=True)(x)
    return value, slope


def along(function: Callable[[Any], Any], x: Any, direction: Any) -> tuple[Any, Any]:
    """Compute value and directional derivative of a function."""
    return jax.jvp(plain(function), (x,), (direction,))


CHOICES: dict[str, Callable] = {
    # JAX has one derivative at a kink. A choice is open there for Taylor models, which then take the hull of both
    # sides.
    "abs": lambda a: jnp.where(a < 0, -a, a),
    "max": lambda a, b: jnp.where(a < b, b, a),
    "min": lambda a, b: jnp.where(a < b, a, b),
    "clamp": lambda low, a, high: CHOICES["min"](CHOICES["max"](a, low), high),
    "stop_gradient": lambda a: a,
    "mirrored": lambda a, _: a,
}


def _evaluate_body(body: ClosedJaxpr, x: Sequence) -> list:
    known = dict(zip([*body.jaxpr.constvars, *body.jaxpr.invars], [*body.consts, *x], strict=True))

    def read(atom):
        return atom.val if hasattr(atom, "val") else known[atom]

    for eqn in equations(body.jaxpr):
        x = list(map(read, eqn.invars))
        match eqn.form:
            case Call(inner):
                out = _evaluate_body(inner, x)
            case Scan():
                out = unrolled(eqn.form, x, _evaluate_body, jnp.stack)
            case Branch() | While():
                raise InputError(f"the operation '{eqn.name}' is not known to the check")
            case None if eqn.name in CHOICES and is_real(eqn.invars[0]):
                out = [CHOICES[eqn.name](*x)]
            case None:
                out = eqn.primitive.bind(*x, **eqn.params)
                out = out if eqn.primitive.multiple_results else [out]
        known |= dict(zip(eqn.outvars, out, strict=True))
    return [read(atom) for atom in body.jaxpr.outvars]
