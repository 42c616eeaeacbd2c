"""Bounds of the force on a mechanical system, and of its derivatives by the position, over boxes; by intervals."""

import functools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant.certificates._intrinsic import configuration_shape, entries_read
from covariant.lowering import Conditions, enclose, expand, lower
from covariant.models import MechanicalSystem, applied_force, input_count
from covariant.proofs import Box, check_box, show_conditions


def force_bounds(
    model: MechanicalSystem, places: Box, inputs: Float[np.ndarray, "2 m"], times: tuple[float, float]
) -> Float[np.ndarray, "2 n"]:
    """Bounds of `force − grad U` over boxes of inputs, times, and positions (on a group, of matrix entries).

    They come from interval arithmetic with outward rounding. The force may jump within the boxes. Raises `ValueError`
    where it has no bound or is not defined everywhere.
    """
    given, shape = _given_box(places, inputs, times), configuration_shape(model, len(places.low))
    force = functools.partial(applied_force, model)
    lowered = lower(force, jnp.zeros(()), jnp.zeros(shape), jnp.zeros(inputs.shape[1]), real=True)
    assert lowered.conditions is not None
    defined = lowered.conditions._replace(
        conditions=tuple(c for c in lowered.conditions.conditions if c.kind in ("true", "finite"))
    )
    _need_conditions("the force of the model is not defined", defined, given)
    found = enclose(lowered, given.low[None], given.high[None])
    bounds = np.concatenate([found.low, found.high])
    if not np.isfinite(bounds).all():
        raise ValueError(f"the force of the model has no bound over {places}; make the box smaller")
    return bounds


def force_slopes(
    model: MechanicalSystem, places: Box, inputs: Float[np.ndarray, "2 m"], times: tuple[float, float]
) -> Float[np.ndarray, "n n"]:
    """Bounds of |∂f_i/∂q_j| over the same boxes; on a group along the directions of the body frame.

    Raises `ValueError` where the force has no such bound, for instance where it jumps.
    """
    given, shape = _given_box(places, inputs, times), configuration_shape(model, len(places.low))
    n = model.manifold.zero(jnp.zeros(shape)).size

    def force(t, q, u, step):
        return applied_force(model, t, model.manifold.nudged(q, step), u)

    lowered = lower(force, jnp.zeros(()), jnp.zeros(shape), jnp.zeros(inputs.shape[1]), jnp.zeros(n), real=True)
    assert lowered.conditions is not None
    whole = given.with_fixed(np.zeros(n))
    _need_conditions("the force of the model jumps, or is not defined", lowered.conditions, whole)
    steps = range(len(given.low), len(whole.low))
    found = enclose(expand(lowered._replace(conditions=None), steps, 1), whole.low[None], whole.high[None])
    bounds = np.maximum(np.abs(found.low), np.abs(found.high))[0, n:].reshape(n, n).T
    if not np.isfinite(bounds).all():
        raise ValueError(f"the slope of the model's force has no bound over {places}; make the box smaller")
    return bounds


def force_reads_time(model: MechanicalSystem, n: int) -> bool:
    """Whether `force − grad U`, or where it is defined, depends on time."""
    q = jnp.zeros(configuration_shape(model, n))
    read = entries_read(functools.partial(applied_force, model), jnp.zeros(()), q, jnp.zeros(input_count(model, n)))
    return 0 in read


def _given_box(places: Box, inputs: Float[np.ndarray, "2 m"], times: tuple[float, float]) -> Box:
    """Time, positions and inputs as one box."""
    names = ("t", *places.names, *(f"u{i + 1}" for i in range(inputs.shape[1])))
    low, high = (
        np.concatenate([[t], ends, u]) for t, ends, u in zip(times, (places.low, places.high), inputs, strict=True)
    )
    return check_box(Box(names, ("s", *places.units, *("",) * inputs.shape[1]), low, high))


def _need_conditions(what: str, conditions: Conditions, domain: Box) -> None:
    reason = show_conditions(conditions, domain)
    if reason:
        raise ValueError(f"{what} everywhere in the region: {reason}")
