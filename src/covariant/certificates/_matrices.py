"""The claims of a certificate as the checker forms them: JAX functions that must be positive definite, or defined.

They are made from the observer's flow and the frame of the metric, as those of the prover are, but in another way: by
derivatives of JAX, for functions without the custom derivative rules that JAX was given.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from covariant.certificates._subject import Subject, values
from covariant.models import applied_force
from covariant.proofs.checker import plain

Matrix = Callable[[Any], Any]


def contraction(about: Subject, rate: float) -> Matrix:
    """`−(FᵀN + Ṅ + NF) − rate N`, a function z (d,) -> (2n, 2n)."""

    def matrix(z):
        point, t = about.at(z), jnp.zeros(())
        x, flow = point.x, plain(point.flow)
        slope, velocity = jax.jacfwd(lambda y: (flow(t, y),) * 2, has_aux=True)(x)

        def both(s):
            at = x + s * velocity
            return plain(point.metric.coframe)(s, at), plain(point.metric.gram)(s, at)

        (coframe, gram), (turn, change) = jax.jvp(both, (t,), (t + 1,))
        moved = gram @ (turn + coframe @ slope) @ point.metric.frame(t, x)
        return -(moved + moved.T + change) - rate * gram

    return matrix


def width_bound(about: Subject, row: int, square: float) -> Matrix:
    """`square N − r rᵀ` for a row r of the Jacobian of error and velocity, a function z (d,) -> (2n, 2n)."""

    def matrix(z):
        point = about.at(z)
        r = point.error_jacobian()[row]
        return square * point.metric.gram(jnp.zeros(()), point.x) - jnp.outer(r, r)

    return matrix


def disturbance(about: Subject, sizes: np.ndarray, square: float) -> Matrix:
    """`square I − BᵀMB`, B the scaled Jacobian of the flow in errors of measurement and force, z -> (2n, 2n)."""
    n = len(sizes) // 2

    def matrix(z):
        point, t = about.at(z), jnp.zeros(())
        slope = jax.jacfwd(plain(lambda at: about.at(at).flow(t, point.x)))(z)
        b = jnp.concatenate([slope[:, -2 * n : -n] @ point.noise_jacobian(), slope[:, -n:]], axis=1) * sizes[None]
        b = point.metric.coframe(t, point.x) @ b
        return square * jnp.eye(2 * n) - b.T @ point.metric.gram(t, point.x) @ b

    return matrix


def everything(about: Subject) -> Matrix:
    """Everything that the claims are computed from, a function of z (d,) and 2n + 1 zeros -> (...).

    The zeros are added to time and state: what a claim holds fixed is a variable here, so that jumps in it are found.
    """

    def parts(y):
        z, t, zeros = jnp.split(y, (len(about.names), len(about.names) + 1))
        return jnp.concatenate([part.ravel() for part in values(about)(t[0], about.at(z).x + zeros, z)])

    return parts


def force(model: Any, shape: tuple[int, ...]) -> Matrix:
    """The force on the system, a function of time, position and input -> (n,)."""

    def applied(y):
        t, q, u = jnp.split(y, (1, 1 + int(np.prod(shape))))
        return applied_force(model, t[0], q.reshape(shape), u)

    return applied


def within(function: Matrix, low: np.ndarray, high: np.ndarray) -> Matrix:
    """A matrix that is positive definite where a function (n,) is within bounds (n,)."""

    def matrix(y):
        found = function(y)
        return jnp.diag(jnp.concatenate([found - low, high - found]))

    return matrix


def slopes(model: Any, shape: tuple[int, ...], n: int) -> Matrix:
    """Derivatives of the force by the position, or in the body frame: time, position, input, zeros (n,) -> (n²,)."""

    def derivatives(y):
        t, q, u = jnp.split(y[:-n], (1, 1 + int(np.prod(shape))))
        applied = plain(lambda step: applied_force(model, t[0], model.manifold.nudged(q.reshape(shape), step), u))
        return jax.jacfwd(applied)(y[-n:]).ravel()

    return derivatives


def stepped(model: Any, shape: tuple[int, ...], n: int) -> Matrix:
    """The force at a small step from the position, as in `slopes`: time, position, input, step (n,) -> (n,)."""

    def applied(y):
        t, q, u = jnp.split(y[:-n], (1, 1 + int(np.prod(shape))))
        return applied_force(model, t[0], model.manifold.nudged(q.reshape(shape), y[-n:]), u)

    return applied
