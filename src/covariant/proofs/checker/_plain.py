"""A function without custom derivative rules, so that JAX differentiates the function itself."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from covariant.proofs.checker._primitives import CALLS, is_real, unrolled


def plain(function: Callable) -> Callable:
    """The function without custom derivative rules and without `stop_gradient`, for JAX to differentiate.

    In it |x|, min and max are choices, whose derivatives at a kink are those of both sides.
    """

    def inlined(*x: Any) -> Any:
        closed, shape = jax.make_jaxpr(function, return_shape=True)(*x)
        found = _inlined(closed.jaxpr, closed.consts, jax.tree.leaves(x))
        return jax.tree.unflatten(jax.tree.structure(shape), found)

    return inlined


CHOICES: dict[str, Callable] = {
    "abs": lambda a: jnp.where(a < 0, -a, a),
    "max": lambda a, b: jnp.where(a < b, b, a),
    "min": lambda a, b: jnp.where(a < b, a, b),
    "clamp": lambda low, a, high: CHOICES["min"](CHOICES["max"](a, low), high),
    "stop_gradient": lambda a: a,
    "mirrored": lambda a, _: a,
}


def _inlined(jaxpr: Any, consts: Sequence, x: Sequence) -> list:
    known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *x], strict=True))

    def read(atom: Any) -> Any:
        return atom.val if hasattr(atom, "val") else known[atom]

    for eqn in jaxpr.eqns:
        name, p, x = eqn.primitive.name, eqn.params, list(map(read, eqn.invars))
        if name in CALLS:
            inner = p.get("jaxpr", p.get("call_jaxpr"))
            out = _inlined(inner.jaxpr, inner.consts, x)
        elif name == "scan":
            out = unrolled(p, x, _inlined, jnp.stack)
        elif name in ("cond", "while"):
            raise ValueError(f"the operation '{name}' is not known to the check")
        elif name in CHOICES and is_real(eqn.invars[0]):
            out = [CHOICES[name](*x)]
        else:
            out = eqn.primitive.bind(*x, **p)
            out = out if eqn.primitive.multiple_results else [out]
        known |= dict(zip(eqn.outvars, out, strict=True))
    return [read(atom) for atom in jaxpr.outvars]
