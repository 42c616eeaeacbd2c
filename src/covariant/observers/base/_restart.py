"""Restarts an observer whose state is no longer finite."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from covariant._typing import Flag, Number


def all_finite(tree: object) -> Flag:
    """Whether all numbers of a tree of arrays are finite."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]))


def started(init: Callable[[Array, Number], Any], state: Any, y: Inexact[Array, "*n"]) -> Any:
    """Restart at a measurement, at the time of a state and in its form.

    In a compiled function, `init` raises nothing for an invalid measurement and returns NaN.
    """
    fresh = eqx.filter_jit(init)(y, _time(state))
    # A state written by hand may have fewer fields.
    there = [name for name in state._fields if getattr(state, name) is not None]
    filled = state._replace(**{name: getattr(fresh, name) for name in there})
    return jax.tree.map(lambda new, old: jnp.asarray(new, jnp.result_type(old)), filled, state)


def _time(state: Any) -> Number:
    """Latest time [s] in a state or in an inner one; 0 if there is none."""
    if "t" in state._fields:
        return jnp.ravel(state.t)[-1]
    return _time(state.inner) if "inner" in state._fields else 0.0
