"""The approximate intrinsic observer: explicit, locally contracting, and independent of the frame to first order.

Source: Aghannan & Rouchon 2003, equation (5); Maithripala, Berg & Dayawansa 2004, equations (17)–(21), with three
corrections: the curvature has the sign of Aghannan & Rouchon's equation (2), the arguments of the connection in the
transport (19) are exchanged, and (21) lacks an α. Friction and the second-order error are additions.
"""

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._typing import Number, Scalar, Vector
from covariant.geometry import AbstractSpace
from covariant.models import MechanicalSystem, Motion, friction, source
from covariant.observers._protocol import (
    AbstractMechanicalObserver,
    HeldState,
    Info,
    aged,
    as_gain,
    at_rest,
    check_positive,
    outcome,
    still,
    uniqueness,
)
from covariant.observers._sampled import predicted, sampled_correction, worth


class Intrinsic(AbstractMechanicalObserver):
    """Observer (5) of Aghannan & Rouchon for any `MechanicalSystem`, in the frame of its space:

        q̂' = E(q̂) w,   w = v̂ − αξ
        v̂' = −B(q̂)(w, v̂) + S(q) − B(ξ, S) − βξ + R(ξ, v̂)v̂ + raise(dissipation(q̂, v̂))

    with ξ the error from q to q̂, `B(a, b) = ∇_a b` and R the curvature. On a group it is the observer of Maithripala,
    Berg & Dayawansa, whose published α is half of this one.

    - `alpha` [1/s], `beta` [1/s²]: gains; the error obeys s² + αs + β whatever the velocity.
    - `order`: 1 takes ξ = e := −local(q̂, q) as published, q̂ − q in coordinates; 2 takes ξ = e − ½(B + Q)(q̂)(e, e),
      where Q is the acceleration of the retraction, 0 in coordinates and along one-parameter groups.
    - `coefficients`: where B and R of the error terms are evaluated, at the "measured" position as in (5) or at the
      "estimated" one as in (14); the difference is of second order.
    - `curvature`: False leaves the curvature term out, to show its effect.
    - `substeps`: Runge–Kutta steps in each sample; None takes as many as dt and the friction need (offline).

    Where two shortest paths lead to the measurement, as after half a turn, one is taken and `result` says `CUT_LOCUS`.
    Raises `ValueError` for gains that are not positive and finite; raises an error at the start where the first
    measurement is no configuration.
    """

    model: MechanicalSystem
    alpha: Scalar = eqx.field(converter=as_gain)
    beta: Scalar = eqx.field(converter=as_gain)
    order: Literal[1, 2] = eqx.field(default=1, static=True)
    coefficients: Literal["measured", "estimated"] = eqx.field(default="measured", static=True)
    curvature: bool = eqx.field(default=True, static=True)
    substeps: int | None = eqx.field(default=None, static=True)

    def __check_init__(self):
        check_positive("Intrinsic", alpha=self.alpha, beta=self.beta)
        if self.order not in (1, 2):
            raise ValueError(f"Intrinsic: order must be 1 or 2; got {self.order!r}")
        if self.coefficients not in ("measured", "estimated"):
            raise ValueError(f"Intrinsic: coefficients must be 'measured' or 'estimated'; got {self.coefficients!r}")

    def init(self, y: Array, t: Number = 0.0) -> HeldState:
        return at_rest(self.model, y, t)

    def flow(self, t: Scalar, state: HeldState, u: Float[Array, "m"], y: Array) -> HeldState:
        q, v, _, held, age = state
        xi, drive = self._correction(t, q, v, u, y)
        w, v_dot = self.rates(q, v, xi, drive + friction(self.model, t, q, v, u))
        return HeldState(w, v_dot, jnp.ones_like(state.t), still(held), still(age))

    def rates(self, q: Array, v: Vector, xi: Vector, drive: Vector) -> tuple[Vector, Vector]:
        """Velocity w of the estimate and v̂', from the error ξ and the acceleration `drive` without the feedback."""
        w = v - self.alpha * xi
        return w, drive - self.beta * xi - self.model.space.connection(q, w, v)

    def bend(self, at: Array, drive: Vector, xi: Vector, v: Vector) -> Vector:
        """The acceleration `drive` with the curvature term `R(ξ, v̂)v̂` at the configuration `at` added, if it is on."""
        return drive + self.model.space.curvature(at, xi, v, v) if self.curvature else drive

    def predict(self, state: HeldState, u: Float[Array, "m"], dt: Scalar) -> HeldState:
        return predicted(self.model, state, u, dt, self.substeps)

    def correct(self, state: HeldState, u: Float[Array, "m"], y: Array) -> tuple[HeldState, Info]:
        q, v, t, _, age = state
        xi, drive = self._correction(t, q, v, u, y)
        missing = drive - source(self.model, t, q, u)  # acceleration missing in the prediction, which used S(q̂)
        taken = sampled_correction(self.model.space, Motion(q, v), self.alpha, self.beta, age, xi, missing)
        way = -taken.part * xi
        new_q = self.model.manifold.retract(q, way)
        new_v = v - self.model.space.connection(q, way, v) + taken.velocity
        result = outcome(new_q, new_v, y, worth(taken, uniqueness(self.model, q, y)))
        info = Info(self.innovation(state, u, y), self.model.space.norm(q, xi), result)
        return state._replace(q=new_q, v=new_v, age=aged(self.model, state, y)), info

    def _correction(self, t: Scalar, q: Array, v: Vector, u: Float[Array, "m"], y: Array) -> tuple[Vector, Vector]:
        """The error ξ at q̂, and the acceleration `T S(q) + R(ξ, v̂)v̂` computed from the measurement."""
        e = -self.model.manifold.towards(q, y)
        measured = self.model.manifold.measured(q, y)
        at = measured if self.coefficients == "measured" else q
        xi = e if self.order == 1 else second_order(self.model.space, q, e)
        s = source(self.model, t, measured, u)
        return xi, self.bend(at, s - self.model.space.connection(at, xi, s), xi, v)


def second_order(space: AbstractSpace, q: Any, e: Vector) -> Vector:
    """`ξ = e − ½(B + Q)(e, e)` at q, the Riemannian error to second order."""
    return e - (space.connection(q, e, e) + space.manifold.retraction_acceleration(q, e)) / 2
