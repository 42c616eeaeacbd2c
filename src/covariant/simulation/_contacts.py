"""Simulates machines whose feet land on level ground and leave it, with the contacts recorded as inputs."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from covariant._integrate import compiled
from covariant._typing import Number, Scalar, Vector
from covariant.models import MechanicalSystem, Motion, advance, applied_force, resistance, standing
from covariant.signals import Record
from scalargraph.errors import InputError

Torques = Callable[[Scalar, Motion, Bool[Array, "k"]], Vector]
"""Inputs without the contacts, `(t, motion, down) -> (m − k,)`; `down` tells which feet are on the ground."""


@compiled
def simulate_contacts(
    model: MechanicalSystem, start: Motion, t: Float[Array, "T"], torques: Torques, ground: Number = 0.0, steps: int = 4
) -> Record:
    """Integrate a machine with feet over level ground, and record its noise-free state and inputs.

    A foot lands at the first stamp at which it moves down and is not above the ground; the impact is plastic, and the
    foot then stays in place. It leaves the ground at the first stamp at which the ground would have to pull. So
    contacts change only at stamps, and a foot may sink in for up to one sample. Feet never slip, however inclined a leg
    is.

    Args:
        model: A model with `feet`, whose last coordinate is the height [m].
        start: Motion at the first stamp, with all feet in the air.
        t: Stamps (T,) [s].
        torques: Inputs without the contacts, a function of time, motion and the feet on the ground.
        ground: Height of the ground [m].
        steps: Runge–Kutta steps of order 4 in each sample.

    Returns:
        The record. Contacts are the last columns of u, and act from their stamp on: the state at a touch-down is the
        one before the impact.

    Example:
        A mass falls by 0.1 m, and stays on the ground:

        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> from covariant.simulation import simulate_contacts
        >>> names = {"coordinates": ("x", "z"), "units": ("m", "m"), "inputs": 1}
        >>> no_force, mass = (lambda t, q, u: jnp.zeros(2)), (lambda q: jnp.eye(2))
        >>> point = models.Lagrangian(mass, lambda q: 9.81 * q[1], no_force, **names, feet=lambda q: q[None])
        >>> start, t = models.Motion(jnp.array([0.0, 0.1]), jnp.zeros(2)), jnp.arange(0.0, 0.3, 0.005)
        >>> fall = simulate_contacts(point, start, t, lambda s, x, down: jnp.zeros(0), steps=1)
        >>> landed = int(fall.u[:, 0].argmax())
        >>> round(float(t[landed]), 3), fall.x[landed : landed + 2, 3].round(2).tolist()
        (0.145, [-1.42, 0.0])
    """
    feet = model.feet
    if feet is None:
        raise InputError("simulate_contacts: the model has no feet")

    def step(now, bounds):
        motion, down, spots = now
        begin, end = bounds
        u = jnp.concatenate([torques(begin, motion, down), down.astype(t.dtype)])
        here: Any = standing(model, down, spots)
        force = applied_force(model, begin, motion.q, u) + resistance(model, begin, motion.q, motion.v, u)
        push = here.space.load(*motion, force).reshape(spots.shape)[:, -1]
        place, speed = jax.jvp(feet, (motion.q,), (model.manifold.tangent(*motion),))
        spots = jnp.where(down[:, None], spots, place)
        # A foot that has just left the ground and still rises must not land again at once.
        after = jnp.where(down, push > 0, (place[:, -1] <= ground) & (speed[:, -1] < 0))
        u = u.at[u.shape[0] - down.shape[0] :].set(after.astype(u.dtype))
        there: Any = standing(model, after, spots)
        moved = advance(there, begin, Motion(*there.space.impact(*motion)), u, end - begin, steps)
        return (moved, after, spots), (motion, u)

    place = feet(start.q)
    first = start, jnp.zeros(len(place), bool), place
    _, (motion, u) = jax.lax.scan(step, first, (t, jnp.append(t[1:], 2 * t[-1] - t[-2])))
    return Record(t, u, motion.q, jax.vmap(model.state)(motion))
