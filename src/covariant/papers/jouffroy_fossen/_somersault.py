"""Simulates ODIN on SE(3), beyond section IV of Jouffroy & Fossen 2004: a pitch of 90° is not singular there."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from covariant.models import Motion, marine
from covariant.observers import Intrinsic
from covariant.simulation import observe


@eqx.filter_jit
def _somersault(t: Array):
    system = marine.odin_on_group()
    observer = Intrinsic(system, 8.0, 16.0)
    x0 = Motion(system.group.identity(), jnp.zeros(6))
    start = observer.init(system.group.exp(jnp.array([0.3, -0.2, 0.2, 0.1, 0.15, -0.2])))
    start = start._replace(v=jnp.array([0.2, 0.1, -0.1, 0.1, -0.2, 0.1]))

    def torque(s, x):
        return jnp.array([5.0, 0.0, 0.0, 0.0, 150.0, 0.0])

    x, state = observe(system, observer, x0, start, t, torque, rtol=1e-9, atol=1e-12)
    error = jax.vmap(system.group.between)(x.q, state.q)
    # −g₃₁ is the sine of the pitch in yaw-pitch-roll angles; rounding may take it beyond ±1.
    return jnp.arcsin(jnp.clip(-x.q[:, 2, 0], -1.0, 1.0)), jnp.concatenate([error, state.v - x.v], axis=1)


def somersault(duration: float = 16.0) -> dict[str, np.ndarray]:
    """Simulate ODIN on SE(3), turned over its nose by a constant torque, with the intrinsic observer on the group.

    Apart from drag, the error law is s² + 8s + 16; with s² + 2s + 1 the gains are too low for this speed, and an error
    remains.

    Args:
        duration: Length of the simulation [s].

    Returns:
        Stamps `t` (T,) [s], `pitch` (T,) [rad], and the norm of the observer's `error` (T,).
    """
    t = np.linspace(0.0, duration, round(20 * duration) + 1)
    pitch, error = _somersault(jnp.asarray(t))
    return {"t": t, "pitch": np.asarray(pitch), "error": np.linalg.norm(np.asarray(error), axis=1)}
