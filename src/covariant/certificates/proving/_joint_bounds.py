"""Bounds the forces in joints, and the slopes of friction, by interval arithmetic."""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant.certificates.base import any_configuration, friction_of, need_conditions, need_joint_friction
from covariant.models import MechanicalSystem
from scalargraph import enclose, expand, lower
from scalargraph.errors import InputError
from scalargraph.proofs import Box, check_box


class JointBounds(NamedTuple):
    """Least and largest values of the forces in the joints.

    Attributes:
        force: generalised force (2, n) of the input.
        total: sum (2, n) of this force, the friction and an unknown force.
        slopes: −∂f_i/∂v_i (2, n) of the friction f, which are ≥ 0 if friction opposes the motion.
    """

    force: Float[np.ndarray, "2 n"]
    total: Float[np.ndarray, "2 n"]
    slopes: Float[np.ndarray, "2 n"]


def joint_bounds(
    model: MechanicalSystem,
    inputs: Float[np.ndarray, "2 m"],
    speed: Float[np.ndarray, "n"],
    unknown: Float[np.ndarray, "n"],
) -> JointBounds:
    """Bound input forces, friction, and the slopes of the friction."""
    m, q = inputs.shape[1], any_configuration(model)
    force = lower(lambda u: model.force(jnp.zeros(()), q, u), jnp.zeros(m), real=True)
    input_box = check_box(Box(tuple(f"u{i + 1}" for i in range(m)), ("",) * m, inputs[0], inputs[1]))
    # The force may jump, since only its values are bounded.
    need_conditions("the force of the model is not defined", force, input_box, smooth=False)
    enclosure = enclose(force._replace(conditions=None), input_box.low[None], input_box.high[None])
    force_bounds = np.concatenate([enclosure.low, enclosure.high])
    friction, slopes = friction_bounds(model, speed)
    outward = [[-np.inf], [np.inf]]
    total = np.nextafter(force_bounds + friction, outward)
    total = np.where(unknown > 0, np.nextafter(total + [[-1.0], [1.0]] * unknown, outward), total)
    bounds = JointBounds(force_bounds, total, slopes)
    if not all(np.isfinite(each).all() for each in bounds):
        raise InputError("the force, the friction or its slope has no bound over the velocities; make them smaller")
    return bounds


def friction_bounds(
    model: MechanicalSystem, speed: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "2 n"], Float[np.ndarray, "2 n"]]:
    """Bound the friction and its slopes, for friction in each joint that depends on the velocity of this joint only."""
    friction, slopes = friction_on(model, speed, -speed[None], speed[None])
    return friction[:, 0], slopes[:, 0]


def friction_on(
    model: MechanicalSystem,
    speed: Float[np.ndarray, "n"],
    low: Float[np.ndarray, "k n"],
    high: Float[np.ndarray, "k n"],
) -> tuple[Float[np.ndarray, "2 k n"], Float[np.ndarray, "2 k n"]]:
    """The same on boxes of velocities among all."""
    n = len(speed)
    friction = lower(functools.partial(friction_of, model, any_configuration(model)), jnp.zeros(n), real=True)
    velocity_box = Box(model.velocities or tuple(f"v_{name}" for name in model.coordinates), ("",) * n, -speed, speed)
    # All conditions are needed, since slopes have bounds only if the friction is continuous.
    need_conditions("the friction of the model jumps, or is not defined", friction, velocity_box)
    derivatives = expand(friction._replace(conditions=None), range(n), 1)
    enclosure = enclose(derivatives, low, high)
    # The derivatives are listed velocity by velocity; on the diagonal are those of friction i by velocity i.
    diagonal = n + np.arange(n) * (n + 1)
    slopes = np.stack([0.0 - enclosure.high[:, diagonal], 0.0 - enclosure.low[:, diagonal]])
    return np.stack([enclosure.low[:, :n], enclosure.high[:, :n]]), slopes


def has_dry_friction(model: MechanicalSystem, speed: Float[np.ndarray, "n"]) -> bool:
    """Test whether friction of joints is steep near rest, so that a box of velocities hardly limits its slope."""
    if not model.manifold.commuting:
        return False
    try:
        need_joint_friction(model)
    except InputError:
        return False
    n = len(speed)
    step, friction = 1e-6 * speed, functools.partial(friction_of, model, jnp.zeros(n))

    def drag(v):
        change = np.asarray(friction(jnp.asarray(v + step))) - np.asarray(friction(jnp.asarray(v - step)))
        with np.errstate(all="ignore"):  # velocities may be denormal
            return -change / (2 * step)

    # Differences suffice, since no proof relies on this.
    at_rest, moving = drag(np.zeros(n)), drag(speed / 10)
    return bool((at_rest > 2 * moving).any())
