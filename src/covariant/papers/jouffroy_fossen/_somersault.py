"""Simulates ODIN under output feedback, section IV of Jouffroy & Fossen 2004, with a quaternion, through pitch 90°."""

import jax.numpy as jnp
import numpy as np

from covariant.models import marine
from covariant.observers import craft_observer
from covariant.papers.jouffroy_fossen._odin import K1, K2, KD, KP, LAMBDA, closed_loop
from covariant.simulation import Backstepping, follow


def _over_the_nose(t):
    half = 0.3 * t / 2
    zero = jnp.zeros_like(t)
    return jnp.stack([jnp.sin(0.1 * t), jnp.cos(0.2 * t), 5.0 + zero, jnp.cos(half), zero, jnp.sin(half), zero])


def somersault(duration: float = 30.0) -> dict[str, np.ndarray]:
    """Simulate the paper's controller and observer with a quaternion, along a path that turns over the nose.

    The reference pitches by 0.3 rad/s without end, while ODIN starts with errors in all directions.

    Args:
        duration: Length of the simulation [s].

    Returns:
        Stamps `t` (T,) [s], `pitch` (T,) [rad] in yaw-pitch-roll angles, and the norms (T,) of the errors `observer`
        and `tracking`.
    """
    robot = marine.odin(quaternion=True)
    # A quaternion changes by half the angle, which gives K2 of its entries a quarter of the effect.
    k1, k2 = np.diag([*np.diag(K1), K1[5, 5]]), np.diag([*np.diag(K2)[:3], *[4.0 * K2[5, 5]] * 4])
    first = np.array([0.5, 0.5, 5.5, 0.97, 0.1, -0.2, 0.1, *[0.0] * 6])
    first[3:7] /= np.linalg.norm(first[3:7])
    t = np.linspace(0.0, duration, round(10 * duration) + 1)
    controller = Backstepping(robot, follow(_over_the_nose), KP, KD, LAMBDA)
    x, tracking, observer = closed_loop(controller, craft_observer(robot, k1, k2), first, first + 0.1, t)
    w, qx, qy, qz = x[:, 3:7].T
    pitch = np.arcsin(np.clip(2.0 * (w * qy - qx * qz), -1.0, 1.0))
    return {"t": t, "pitch": pitch, "observer": observer, "tracking": tracking}
