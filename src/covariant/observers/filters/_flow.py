"""Integrates a motion and slow states over one step, with derivatives with respect to all of them."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._integrate import linearised, rk4_step
from covariant._typing import Scalar, Vector
from covariant.geometry import AbstractManifold, AbstractSpace
from covariant.models import MechanicalSystem, Motion, acceleration, advance
from covariant.observers.sensors import SlowStates, SlowVector


def flow_with_slope(
    manifold: AbstractManifold,
    model: Callable[[SlowVector], MechanicalSystem],
    acting: Callable[[SlowVector], Float[Array, "m"]],
    states: SlowStates,
    start: tuple[Array, Vector, Scalar, SlowVector],
    h: Scalar,
) -> tuple[tuple[Array, Vector, SlowVector], Float[Array, "e e"]]:
    """One Runge–Kutta step.

    Args:
        manifold: Manifold of the configurations.
        model: The model with given slow states in it.
        acting: The inputs that act with given slow states.
        states: The slow states, k in all.
        start: Configuration, velocity (n,), time [s] and slow states (k,).
        h: Length of the step [s].

    Returns:
        Configuration, velocity and slow states after the step, and their derivative (2n + k, 2n + k) in the frame.
    """
    q, v, t, slow = start
    n = len(v)

    def displaced(error: Float[Array, "e"]) -> Any:
        begin = Motion(manifold.retract(q, error[:n]), v + error[n : 2 * n])
        mean, end_slow = states.advanced(begin.v, slow + error[2 * n :], h)
        end = advance(model(mean), t, begin, acting(mean), h, 1)
        # The value is zero, since the end is compared with itself; the derivative is the displacement in the frame.
        return jnp.concatenate([manifold.local(jax.lax.stop_gradient(end.q), end.q), end.v, end_slow]), (*end, end_slow)

    def rates(t: Scalar, x: Float[Array, "e"]) -> Float[Array, "e"]:
        q, v, mean = jnp.split(x, [n, 2 * n])
        return jnp.hstack([v, acceleration(model(mean), t, q, v, acting(mean)), 0 * mean])

    none = jnp.zeros(2 * n + len(slow), v.dtype)
    if not manifold.commuting:
        slope, end = jax.jacfwd(displaced, has_aux=True)(none)
        return end, slope
    # In coordinates, integrating the variational equation with the equation of motion takes less work.
    mean, end_slow = states.advanced(v, slow, h)
    of_mean, of_slow = jax.jacfwd(lambda e: states.advanced(v + e[n : 2 * n], slow + e[2 * n :], h))(none)
    axes = jnp.concatenate([jnp.eye(2 * n, len(none), dtype=none.dtype), of_mean])
    end, slope = rk4_step(linearised(rates), t, (jnp.concatenate([q, v, mean]), axes), h)
    end_q, end_v, _ = jnp.split(end, [n, 2 * n])
    end_q, end_v = model(mean).space.restored(end_q, end_v)
    return (end_q, end_v, end_slow), jnp.concatenate([slope[: 2 * n], of_slow])


def parallel(space: AbstractSpace, q: Array, v: Vector) -> Float[Array, "two_n two_n"]:
    """Matrix `[[I, 0], [B(·, v), I]]` from small differences (s, δv) of motions at (q, v), in the frame, to (ε, ν)."""
    axes = jnp.eye(v.shape[0], dtype=v.dtype)
    connections = jax.vmap(lambda a: space.connection(q, a, v), out_axes=1)(axes)
    return jnp.block([[axes, jnp.zeros_like(axes)], [connections, axes]])


def apart(space: AbstractSpace, q: Array, v: Vector) -> Float[Array, "two_n two_n"]:
    """Inverse (2n, 2n) of `parallel`, from (ε, ν) to small differences (s, δv) in the frame."""
    return inverse(parallel(space, q, v))


def inverse(unipotent: Float[Array, "two_n two_n"]) -> Float[Array, "two_n two_n"]:
    """Inverse of a matrix `parallel`, or of its inverse."""
    return 2 * jnp.eye(len(unipotent), dtype=unipotent.dtype) - unipotent


def with_part_across(space: AbstractSpace, q: Array, root: Float[Array, "N N"], n: int) -> Float[Array, "N K"]:
    """A root of a covariance of (ε, ν, slow) at q; on a leaf, where it is zero along normals, with a part added."""
    if not space.manifold.redundant:
        return root
    axes = jnp.eye(n, dtype=root.dtype)
    across = axes - jax.vmap(lambda a: space.projected(q, a), out_axes=1)(axes)
    sizes = jnp.sqrt(jnp.sum(root[: 2 * n].reshape(2, -1) ** 2, axis=1))
    beside = jnp.kron(jnp.diag(sizes), across)
    return jnp.concatenate([root, jnp.pad(beside, ((0, len(root) - 2 * n), (0, 0)))], axis=1)
