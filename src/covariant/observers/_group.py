"""The intrinsic observer on a Lie group: attitude or pose in, velocity out, with no coordinates anywhere.

Source: Maithripala, Berg & Dayawansa 2004, equations (17)–(21), corrected: the curvature has the sign of Aghannan &
Rouchon's equation (2), the connection's arguments in the transport (19) are the other way round, (21) lacks an α.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._typing import Code, Element, Flag, Number, Scalar, Vector
from covariant.geometry import Budget
from covariant.models import GroupSystem, Motion, friction, source
from covariant.observers._protocol import AbstractFlowObserver, Held, check_positive, no_input, outcome, still
from covariant.observers._sampled import predict, sampled_gains
from covariant.signals import Result


class GroupState(NamedTuple):
    """Estimate (g, v) at time t [s], and the error `log` from g to the measurement as last found, to search from;
    `held` is the last finite input."""

    g: Element
    v: Vector
    t: Scalar
    log: Vector
    held: Held = None


class GroupInfo(NamedTuple):
    """What a step saw.

    `innovation`: `log(ĝ⁻¹ y)` before the correction, in the body, 0 where missing; `distance`: its length in the metric
    (with `error="riemannian"` the geodesic distance); `residual`: the length by which the geodesic missed, infinite
    where none was found; `result`: a `covariant.signals.Result` code.
    """

    innovation: Vector
    distance: Scalar
    residual: Scalar
    result: Code


class _Correction(NamedTuple):
    towards: Vector  # −ζ_e: body velocity at the estimate that leads to the measurement in unit time
    innovation: Vector
    drive: Vector
    residual: Scalar
    result: Code
    exact: Flag  # along a geodesic that was found, not along the group's one-parameter curve


class Group(AbstractFlowObserver):
    """Observer of Maithripala, Berg & Dayawansa for any `GroupSystem`, with `ζ_e = log(g⁻¹ g̃)`:

        g̃' = g̃ w,  w = ζ̃ − αζ_e
        ζ̃' = −B(w, ζ̃) + T S − βζ_e + R(ζ_e, ζ̃)ζ̃ + I⁻¹ dissipation(g̃, ζ̃)

    - `alpha` [1/s], `beta` [1/s²]: gains; the error obeys s² + αs + β whatever the velocity.
    - `error`: "group" as published, the group logarithm and `T S = S − B(ζ_e, S)`; "riemannian" takes the logarithm and
      the parallel transport of the metric, as `Geodesic` does in coordinates. They agree to first order in the error.
    - `budget`: work spent on the Riemannian geodesic, as for `Geodesic`.
    - `doubled_alpha`: True gives α the paper's meaning, w = ζ̃ − 2αζ_e.
    - `curvature`: False leaves the curvature term out, to see what it is for.
    - `substeps`: Runge–Kutta steps a sample; None takes as many as dt and the friction need (offline).

    After half a turn two ways back are equally short: one is taken and `result` says `CUT_LOCUS`. Where no geodesic is
    found the group logarithm stands in for it and `result` says `NOT_CONVERGED`. A measurement with any NaN counts as
    missing as a whole. Raises an error at the start when the first measurement is not an element of the group, and
    `ValueError` for gains that are not positive and finite.
    """

    model: GroupSystem
    alpha: Number
    beta: Number
    error: Literal["group", "riemannian"] = eqx.field(default="group", static=True)
    budget: Budget = eqx.field(default=Budget(newton=1, steps=4), static=True)
    doubled_alpha: bool = eqx.field(default=False, static=True)
    curvature: bool = eqx.field(default=True, static=True)
    substeps: int | None = eqx.field(default=None, static=True)

    def __check_init__(self):
        check_positive("Group", alpha=self.alpha, beta=self.beta)
        if self.error not in ("group", "riemannian"):
            raise ValueError(f"Group: error must be 'group' or 'riemannian'; got {self.error!r}")

    def init(self, y: Element, t: Number = 0.0) -> GroupState:
        y = check_element(self.model, y)
        rest = jnp.zeros(self.model.group.dimension, y.real.dtype)
        return GroupState(y, rest, jnp.asarray(t, rest.dtype), rest, no_input(self.model, rest))

    def estimate(self, state: GroupState) -> Motion:
        return Motion(state.g, state.v)

    def flow(self, t: Scalar, state: GroupState, u: Float[Array, "m"], y: Element) -> GroupState:
        """Time derivative of the state; in the place of g stands the body velocity w of `g̃' = g̃ w`."""
        found = self._correction(t, state, u, y)
        w, v_dot = self.rates(state.v, found.towards, found.drive + friction(self.model, state.g, state.v))
        # Only a warm start: it follows the geodesic found, and no estimate depends on how closely.
        log_dot = 10 * self._alpha * (found.towards - state.log)
        return GroupState(w, v_dot, jnp.ones_like(state.t), log_dot, still(state.held))

    def rates(self, v: Vector, towards: Vector, drive: Vector) -> tuple[Vector, Vector]:
        """Body velocity w of the estimate and v̂', from the way to the measurement and the acceleration it calls for."""
        w = v + self._alpha * towards
        return w, drive + self.beta * towards - self.model.metric.connection(w, v)

    def bend(self, drive: Vector, towards: Vector, v: Vector) -> Vector:
        """An acceleration carried to the estimate, with the curvature term `R(ζ_e, ζ̃)ζ̃`, unless it is left out."""
        return drive - self.model.metric.curvature(towards, v, v) if self.curvature else drive

    def advance(self, state: GroupState, u: Float[Array, "m"], y: Element, dt: Scalar) -> tuple[GroupState, GroupInfo]:
        g, v = predict(self.model, state.t, state.g, state.v, u, dt, self.substeps)
        t = state.t + dt
        k1, k2 = sampled_gains(self._alpha, self.beta, dt)
        found = self._correction(t, GroupState(g, v, t, state.log), u, y)
        missing = found.drive - source(self.model, t, g, u)  # what the prediction, made with S(g̃), left out
        corrected = v + k2 * found.towards + dt * missing
        new_g = g @ self.model.group.exp(k1 * found.towards)
        new_v = corrected - self.model.metric.connection(k1 * found.towards, v)
        left = (1 - k1) * found.towards
        if self.error == "riemannian":
            # Go the fraction k1 along the geodesic to the measurement; velocity and the rest of it come along.
            end = self.model.metric.transport_along(k1 * found.towards, jnp.stack([corrected, left]), self.budget)
            new_g = jnp.where(found.exact, g @ end.g, new_g)
            chosen = jnp.where(found.exact, end.w, jnp.stack([new_v, left]))
            new_v, left = chosen[0], chosen[1]
        distance = self.model.metric.norm(found.towards)
        info = GroupInfo(found.innovation, distance, found.residual, outcome(new_g, new_v, y, found.result))
        return GroupState(new_g, new_v, t, left), info

    @property
    def _alpha(self) -> Number:
        return 2 * self.alpha if self.doubled_alpha else self.alpha

    def _correction(self, t: Scalar, state: GroupState, u: Float[Array, "m"], y: Element) -> _Correction:
        """The way to the measurement and the acceleration `T S + R(ζ_e, ζ̃)ζ̃` that it calls for."""
        metric, group = self.model.metric, self.model.group
        measured = jnp.where(jnp.any(jnp.isnan(y)), state.g, y)
        between = group.inverse(state.g) @ measured
        innovation = group.log(between)
        s = source(self.model, t, measured, u)
        result = uniqueness(self.model, between)
        towards, residual, exact = innovation, jnp.zeros_like(state.t), jnp.zeros((), bool)
        drive = s + metric.connection(towards, s)
        if self.error == "riemannian":
            shot = metric.shoot(between, state.log, self.budget)
            exact = (shot.result != Result.NOT_CONVERGED) & jnp.all(jnp.isfinite(shot.velocity))
            towards = jnp.where(exact, shot.velocity, innovation)
            residual, result = jnp.where(exact, shot.residual, jnp.inf), jnp.maximum(result, shot.result)
            transported = metric.transport_along(-jnp.where(exact, shot.arrival, 0.0), s, self.budget).w
            drive = jnp.where(exact, transported, drive)
        return _Correction(towards, innovation, self.bend(drive, towards, state.v), residual, result, exact)


def uniqueness(model: GroupSystem, between: Element) -> Code:
    """`OK`, or `CUT_LOCUS` where a second way to the measurement is as short."""
    return jnp.where(model.group.unique_log(between), int(Result.OK), int(Result.CUT_LOCUS)).astype(jnp.int32)


def check_element(model: GroupSystem, y: Element) -> Element:
    """The measurement itself; an error when it runs and y is not in the group, as a quaternion given as a matrix."""
    order = model.group.order
    if y.shape != (order, order):
        raise ValueError(f"the first measurement must be a matrix ({order}, {order}) of the group; got shape {y.shape}")
    tolerance = 100 * float(jnp.finfo(y.dtype).eps) ** 0.5
    outside = ~model.group.contains(y, tolerance)
    return eqx.error_if(
        y, outside, "the first measurement is not an element of the group; pass rotations as orthogonal matrices"
    )
