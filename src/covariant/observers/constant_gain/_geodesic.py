"""Defines the exact intrinsic observer (geodesic error, transport, curvature), which is the same in all coordinates.

Source: Aghannan & Rouchon 2003, equation (2), with the curvature sign of `covariant.geometry`; Maithripala, Berg &
Dayawansa 2004, equation (17), for groups.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Inexact

from covariant._typing import Code, Flag, Number, Scalar, Vector
from covariant.geometry import Budget
from covariant.models import MechanicalSystem, Motion, friction, source
from covariant.observers.base import (
    AbstractMechanicalObserver,
    LastInput,
    aged,
    as_gain,
    at_rest,
    check_positive,
    outcome,
    predicted,
    readability,
    sampled_correction,
    sampled_gains,
    step_result,
    still,
    time_since_measurement,
)
from covariant.signals import StepCode


class GeodesicState(NamedTuple):
    """State of a `Geodesic` observer.

    Attributes:
        q: Estimated configuration: coordinates (n,), or on a group a matrix (N, N).
        v: Estimated velocity (n,), in the frame.
        t: Time [s] of the estimate.
        log: The last solution `log_q(q̂)` (n,), a velocity at the measurement q, from which the next search starts.
        last_input: The last finite input (m,); None in continuous time.
        age: Time since the last measurement [s]; None in continuous time.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> state = observers.Geodesic(models.ball_and_beam(), alpha=4.0, beta=8.0).init(jnp.array([0.3, 0.1]))
        >>> state.log.tolist()
        [0.0, 0.0]
    """

    q: Inexact[Array, "..."]
    v: Vector
    t: Scalar
    log: Vector
    last_input: LastInput = None
    age: Scalar | None = None


class GeodesicInfo(NamedTuple):
    """Diagnostics of a step of a `Geodesic` observer.

    Attributes:
        innovation: Difference (n,) from q̂ to y before the correction, as in `Info`.
        distance: Length of the geodesic to the measurement, in the metric.
        residual: Distance in the metric by which the geodesic misses the measurement; infinite if there is none.
        result: A `covariant.signals.StepCode` code.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.observers.constant_gain import GeodesicInfo
        >>> zero = jnp.zeros(())
        >>> info = GeodesicInfo(jnp.zeros(1), distance=zero, residual=zero, result=jnp.zeros((), int))
        >>> info._fields
        ('innovation', 'distance', 'residual', 'result')
    """

    innovation: Vector
    distance: Scalar
    residual: Scalar
    result: Code


class Path(NamedTuple):
    """The geodesic between an estimate and a measurement, or a straight path that replaces it.

    Attributes:
        log: Velocity (n,) at the estimate that leads to the measurement in unit time.
        back: Velocity (n,) at the measurement that leads to the estimate in unit time.
        residual: Distance in the metric by which the geodesic misses the estimate; infinite if there is none.
        result: A `covariant.signals.StepCode` code.
        exact: Whether it is a geodesic; otherwise it is the first-order error.
        measured: Measured configuration; missing entries are those of the estimate.
    """

    log: Vector
    back: Vector
    residual: Scalar
    result: Code
    exact: Flag
    measured: Array


def path_to(model: MechanicalSystem, q: Array, guess: Vector, y: Array, budget: Budget) -> Path:
    """Path between an estimate and a measurement.

    The search starts at the measurement, because vectors are transported from there along the same geodesic.
    """
    space = model.space
    measured = space.manifold.measured(q, y)
    shot = space.shoot(measured, q, guess, budget)
    exact = (shot.result != StepCode.NOT_CONVERGED) & jnp.all(jnp.isfinite(shot.velocity))
    straight = space.manifold.towards(q, y)
    # A geodesic from q to q̂ arrives with the velocity −log_q̂(q).
    log, back = jnp.where(exact, jnp.stack([-shot.arrival, shot.velocity]), jnp.stack([straight, -straight]))
    residual = jnp.where(exact, shot.residual, jnp.inf)
    return Path(log, back, residual, jnp.maximum(readability(model, q, y), shot.result), exact, measured)


class AbstractGeodesicObserver(AbstractMechanicalObserver):
    """Start, flow and move along the geodesic to the measurement of the observers that search for it."""

    model: MechanicalSystem
    alpha: Scalar = eqx.field(converter=as_gain)
    beta: Scalar = eqx.field(converter=as_gain)
    budget: Budget = eqx.field(default=Budget(newton=1, steps=4), static=True)

    def __check_init__(self):
        check_positive(type(self).__name__, alpha=self.alpha, beta=self.beta)

    def init(self, y: Array, t: Number = 0.0) -> GeodesicState:
        q, v, t, last_input, age = at_rest(self.model, y, t)
        return GeodesicState(q, v, t, jnp.zeros_like(v), last_input, age)

    def flow(self, t: Scalar, state: GeodesicState, u: Float[Array, "m"], y: Array) -> GeodesicState:
        # A time derivative reports no result, so conjugate points are not counted.
        path, drive = self._correction(t, state, u, y, self.budget._replace(conjugate=False))
        # ξ = −log, hence plus α and plus β.
        w = state.v + self.alpha * path.log
        v_dot = drive + self.beta * path.log + friction(self.model, t, state.q, state.v, u)
        v_dot = v_dot - self.model.space.connection(state.q, w, state.v)
        # The log is only a warm start: it follows the computed geodesic, and the estimate does not depend on it.
        log_dot = 10 * self.alpha * (path.back - state.log)
        return GeodesicState(w, v_dot, jnp.ones_like(state.t), log_dot, still(state.last_input), still(state.age))

    def predict(self, state: GeodesicState, u: Float[Array, "m"], dt: Scalar) -> GeodesicState:
        return predicted(self.model, state, u, dt, self.substeps)

    @abc.abstractmethod
    def _correction(
        self, t: Scalar, state: GeodesicState, u: Float[Array, "m"], y: Array, budget: Budget
    ) -> tuple[Path, Vector]:
        """The geodesic to the measurement, and the acceleration that the flow has without friction and feedback."""

    def _moved(
        self,
        state: GeodesicState,
        u: Float[Array, "m"],
        y: Array,
        path: Path,
        part: Scalar,
        velocity: Vector,
        turned: Vector,
        code: Code,
    ) -> tuple[GeodesicState, GeodesicInfo]:
        """Move along the geodesic by a part of it, and transport the velocity with it; on a straight path, `turned`."""
        space, q, displacement = self.model.space, state.q, part * path.log
        end = space.transport_along(q, displacement, velocity, self.budget)
        new_q = jnp.where(path.exact, end.q, space.manifold.retract(q, displacement))
        moved = velocity - space.connection(q, displacement, turned)
        new_v = jnp.where(path.exact, end.w, space.projected(new_q, moved))
        result = outcome(new_q, new_v, space.manifold.seen(q, y), code)
        info = GeodesicInfo(self.innovation(state, u, y), space.norm(q, path.log), path.residual, result)
        # The same geodesic seen from the measurement; it is shortened, so its initial velocity shrinks with its length.
        log = (1 - part) * path.back
        return state._replace(q=new_q, v=new_v, log=log, age=aged(self.model, state, y)), info


class Geodesic(AbstractGeodesicObserver):
    """Observer (2) of Aghannan & Rouchon for any `MechanicalSystem`.

    With ξ = −log_q̂(q) it is

        q̂' = E(q̂) w,   w = v̂ − αξ
        ∇_w v̂ = T(q→q̂) S(q) − βξ + R(ξ, v̂)v̂ + raise(dissipation(q̂, v̂))

    If there is no finite geodesic, the first-order error of `Intrinsic` replaces it, and `result` says
    `NOT_CONVERGED`.

    Use it if initial errors are large, or the chart is strongly curved. The estimate is the same in all coordinates.
    At low gains on a curved space a large error may never vanish, where `Intrinsic` converges: figure 4 of the paper
    needs α = 2ω, β = ω² with ω ≥ 0.6 1/s. Without a closed form each step searches a geodesic, so it costs more.

    Attributes:
        model: The mechanical system.
        alpha: Gain α [1/s]; the error obeys s² + αs + β at any velocity.
        beta: Gain β [1/s²].
        budget: Work spent on the geodesic. `Budget()` converges and flags conjugate points; `Budget(newton=1, steps=4)`
            (default) is a fixed amount for real time, and `Budget(newton=1, steps=1, near=True)` a small one for small
            errors. Metrics with closed forms ignore it.
        curvature: False leaves the curvature term out, to show its effect; True by default.
        substeps: Number of Runge–Kutta steps in each sample; None (default) uses as many as dt and the friction need
            (offline).

    Raises:
        ValueError: A gain is not positive and finite.

    Example:
        The distance to the measurement is the same in all charts: here r = eˣ, for a unit mass at x.

        >>> import jax
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> observer = observers.Geodesic(models.oscillator("r"), alpha=4.0, beta=8.0)
        >>> state = observer.init(jnp.array([1.0]))
        >>> _, info = jax.jit(observer.correct)(state, jnp.zeros(1), jnp.exp(jnp.array([0.1])))
        >>> info.distance.round(4).item()
        0.1
    """

    curvature: bool = eqx.field(default=True, static=True)
    substeps: int | None = eqx.field(default=None, static=True)

    def correct(self, state: GeodesicState, u: Float[Array, "m"], y: Array) -> tuple[GeodesicState, GeodesicInfo]:
        (q, v, t), waited = state[:3], time_since_measurement(state)
        path, drive = self._correction(t, state, u, y, self.budget)
        missing = drive - source(self.model, t, q, u)  # acceleration missing in the prediction, which used S(q̂)
        gains = sampled_gains(self.alpha, self.beta, waited)
        correction = sampled_correction(self.model.space, Motion(q, v), gains, waited, -path.log, missing)
        code = step_result(correction, path.result)
        return self._moved(state, u, y, path, correction.part, v + correction.velocity, v, code)

    def _correction(
        self, t: Scalar, state: GeodesicState, u: Float[Array, "m"], y: Array, budget: Budget
    ) -> tuple[Path, Vector]:
        """The geodesic to the measurement, and the acceleration `T S(q) + R(ξ, v̂)v̂` computed from it."""
        space, q, v = self.model.space, state.q, state.v
        path = path_to(self.model, q, state.log, y, budget)
        s = source(self.model, t, path.measured, u)
        transported = space.transport_along(path.measured, path.back, s, budget).w
        # The displacement from the measurement to the estimate is −straight, hence the plus sign in the transport.
        straight = space.manifold.towards(q, y)
        drive = jnp.where(path.exact, transported, s + space.connection(q, straight, s))
        # ξ = −log, so R(ξ, v̂)v̂ becomes −R(log, v̂)v̂.
        return path, drive - space.curvature(q, path.log, v, v) if self.curvature else drive
