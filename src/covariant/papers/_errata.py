"""Printed equations that are wrong, kept as counter-examples that visibly fail.

Source: Aghannan & Rouchon 2003, equation (14): all four curvature terms have the sign opposite to their own (5).
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._typing import Number, Scalar, Vector
from covariant.observers import AbstractFlowObserver, Info, MechanicalState


class PrintedBallAndBeam(AbstractFlowObserver):
    """Observer (14) for the normalised ball and beam, letter by letter as printed. Do not use it."""

    alpha: Number
    beta: Number
    curvature_sign: int = eqx.field(default=1, static=True)
    """1 as printed, −1 as (5) demands."""

    def init(self, y: Vector, t: Number = 0.0) -> MechanicalState:
        return MechanicalState(y, jnp.zeros_like(y), jnp.asarray(t, y.dtype))

    def estimate(self, state: MechanicalState) -> Float[Array, "two_n"]:
        return jnp.concatenate([state.q, state.v])

    def flow(self, t: Scalar, state: MechanicalState, u: Float[Array, "m"], y: Vector) -> MechanicalState:
        (r_hat, theta_hat), (vr, vt) = state.q, state.v
        r, theta = y
        er, et = r_hat - r, theta_hat - theta
        r_dot, theta_dot = vr - self.alpha * er, vt - self.alpha * et
        sr, st = -jnp.sin(theta), (u[0] - r * jnp.cos(theta)) / (1 + r**2)
        k = 1 + r_hat**2
        curvature_r = (-vr * vt * et + vt**2 * er) / k
        curvature_t = (vr**2 * et - vr * vt * er) / k**2
        vr_dot = r_hat * theta_dot * vt + (sr + r_hat * et * st) - self.beta * er
        vt_dot = -r_hat / k * (r_dot * vt + vr * theta_dot) + (st - r_hat / k * (er * st + et * sr)) - self.beta * et
        return MechanicalState(
            jnp.stack([r_dot, theta_dot]),
            jnp.stack([vr_dot, vt_dot]) + self.curvature_sign * jnp.stack([curvature_r, curvature_t]),
            jnp.ones_like(state.t),
        )

    def step(self, state: MechanicalState, u: Float[Array, "m"], y: Vector, dt: Scalar) -> tuple[MechanicalState, Info]:
        raise NotImplementedError("equation (14) as printed is a counter-example in continuous time only")
