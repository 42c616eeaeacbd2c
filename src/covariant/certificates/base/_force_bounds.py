"""Bounds the force on a mechanical system, and its derivatives by the position, by interval arithmetic."""

import functools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant.certificates.base._intrinsic import any_configuration, configuration_shape, entries_read
from covariant.models import MechanicalSystem, applied_force, input_count
from scalargraph import Lowered, enclose, expand, lower
from scalargraph.errors import InputError
from scalargraph.proofs import Box, check_box, show_conditions


def force_bounds(
    model: MechanicalSystem, places: Box, inputs: Float[np.ndarray, "2 m"], times: tuple[float, float]
) -> Float[np.ndarray, "2 n"]:
    """Bound `force − grad U` over boxes of inputs, times, and positions.

    The bounds come from interval arithmetic with outward rounding. The force may jump within the boxes.

    Args:
        model: the mechanical system.
        places: box of positions, on a group a box of the entries of its matrices.
        inputs: least and largest inputs (2, m).
        times: first and last time [s].

    Returns:
        Least and largest force (2, n), in the units of the model.

    Raises:
        ValueError: the force has no bound or is not defined everywhere.

    Example:
        >>> import numpy as np
        >>> from covariant.certificates.base import force_bounds
        >>> from covariant.models import oscillator
        >>> from scalargraph.proofs import box
        >>> inputs = np.array([[-0.5], [0.5]])
        >>> force_bounds(oscillator(), box(q=(-1.0, 1.0)), inputs, (0.0, 0.0)).round(6).tolist()  # u − q
        [[-1.5], [1.5]]
    """
    region, shape = _force_box(places, inputs, times), configuration_shape(model, len(places.low))
    force = functools.partial(applied_force, model)
    lowered = lower(force, jnp.zeros(()), jnp.zeros(shape), jnp.zeros(inputs.shape[1]), real=True)
    # The bound is also valid for a force that jumps.
    need_conditions("the force of the model is not defined", lowered, region, smooth=False)
    enclosure = enclose(lowered, region.low[None], region.high[None])
    bounds = np.concatenate([enclosure.low, enclosure.high])
    if not np.isfinite(bounds).all():
        raise InputError(f"the force of the model has no bound over {places}; make the box smaller")
    return bounds


def force_slopes(
    model: MechanicalSystem, places: Box, inputs: Float[np.ndarray, "2 m"], times: tuple[float, float]
) -> Float[np.ndarray, "n n"]:
    """Bound |∂f_i/∂q_j| over boxes of inputs, times and positions; on a group along the directions of
    the body frame.
    """
    region, shape = _force_box(places, inputs, times), configuration_shape(model, len(places.low))
    n = model.manifold.zero(jnp.zeros(shape)).size

    def force(t, q, u, step):
        return applied_force(model, t, model.manifold.nudged(q, step), u)

    lowered = lower(force, jnp.zeros(()), jnp.zeros(shape), jnp.zeros(inputs.shape[1]), jnp.zeros(n), real=True)
    # The step from the position is fixed at 0; it only serves to bound derivatives by it.
    whole = region.with_fixed(np.zeros(n))
    need_conditions("the force of the model jumps, or is not defined", lowered, whole)
    steps = range(len(region.low), len(whole.low))
    enclosure = enclose(expand(lowered._replace(conditions=None), steps, 1), whole.low[None], whole.high[None])
    # The derivatives are listed step by step; after transposition, each row belongs to one force.
    bounds = np.maximum(np.abs(enclosure.low), np.abs(enclosure.high))[0, n:].reshape(n, n).T
    if not np.isfinite(bounds).all():
        raise InputError(f"the slope of the model's force has no bound over {places}; make the box smaller")
    return bounds


def force_reads_time(model: MechanicalSystem) -> bool:
    """Test whether `force − grad U`, or the set on which it is defined, depends on time."""
    q = any_configuration(model)
    u = jnp.zeros(input_count(model, model.manifold.zero(q).size))
    read = entries_read(functools.partial(applied_force, model), jnp.zeros(()), q, u)
    return 0 in read


def _force_box(places: Box, inputs: Float[np.ndarray, "2 m"], times: tuple[float, float]) -> Box:
    """Time, positions and inputs as one box."""
    names = ("t", *places.names, *(f"u{i + 1}" for i in range(inputs.shape[1])))
    both = zip(times, (places.low, places.high), inputs, strict=True)
    low, high = (np.concatenate([[t], ends, u]) for t, ends, u in both)
    return check_box(Box(names, ("s", *places.units, *("",) * inputs.shape[1]), low, high))


def need_conditions(what: str, function: Lowered, domain: Box, *, smooth: bool = True) -> None:
    """Refuse functions whose conditions, or those of being defined alone, are not shown on a box."""
    assert function.conditions is not None
    conditions = tuple(c for c in function.conditions.conditions if smooth or c.kind in ("true", "finite"))
    if reason := show_conditions(function.conditions._replace(conditions=conditions), domain):
        raise InputError(f"{what} everywhere in the region: {reason}")
