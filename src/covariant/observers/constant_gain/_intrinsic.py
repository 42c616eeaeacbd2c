"""Defines the approximate intrinsic observer: explicit, locally contracting, frame-independent to first order.

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
from covariant.observers.base import (
    AbstractMechanicalObserver,
    Info,
    SampledState,
    acceleration_gain,
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
from scalargraph.errors import InputError


class Intrinsic(AbstractMechanicalObserver):
    """Observer (5) of Aghannan & Rouchon for any `MechanicalSystem`, in the frame of its space.

    With ξ the error from q to q̂, `B(a, b) = ∇_a b` and R the curvature it is

        q̂' = E(q̂) w,   w = v̂ − αξ
        v̂' = −B(q̂)(w, v̂) + S(q) − B(ξ, S) − βξ + R(ξ, v̂)v̂ + raise(dissipation(q̂, v̂))

    On a group it is the observer of Maithripala, Berg & Dayawansa, whose published α is half of this one. If two
    shortest paths lead to the measurement, as after half a turn, one of them is used, and `result` says `CUT_LOCUS`.

    It is the default choice for mechanical systems: cheap, with two constant gains, and with a known error law for
    small errors. `calibration.gains` finds the gains, and `certify` proves how far it converges. Use `order=2` or
    `Geodesic` for larger errors, and `IntrinsicKalman` if noise is known or measurements are missing for long.

    Attributes:
        model: The mechanical system.
        alpha: Gain α [1/s]; the error obeys s² + αs + β at any velocity.
        beta: Gain β [1/s²].
        order: 1 (default) uses the published error ξ = e := −local(q̂, q), which is q̂ − q in coordinates; 2 uses
            ξ = e − ½(B + Q)(q̂)(e, e), where Q is the acceleration of the retraction, 0 in coordinates and along
            one-parameter groups.
        coefficients: Where B and R of the error terms are evaluated: at the "measured" (default) position, as in (5),
            or at the "estimated" one, as in (14); the difference is of second order.
        curvature: False leaves the curvature term out, to show its effect; True by default.
        substeps: Number of Runge–Kutta steps in each sample; None (default) uses as many as dt and the friction need
            (offline).

    Raises:
        ValueError: A gain is not positive and finite, or `order` or `coefficients` has another value; or in `init`, the
            first measurement is not a configuration.

    Example:
        A unit mass on a unit spring, whose velocity is estimated from its position:

        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> t = np.linspace(0.0, 4.0, 401)
        >>> record = Record(t, np.zeros((401, 1)), np.cos(t)[:, None])
        >>> run = observers.run(observers.Intrinsic(models.oscillator(), alpha=4.0, beta=8.0), record)
        >>> bool(abs(run.estimate[-1, 1] + np.sin(4.0)) < 1e-3)
        True
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
            raise InputError(f"Intrinsic: order must be 1 or 2; got {self.order!r}")
        if self.coefficients not in ("measured", "estimated"):
            raise InputError(f"Intrinsic: coefficients must be 'measured' or 'estimated'; got {self.coefficients!r}")

    def init(self, y: Array, t: Number = 0.0) -> SampledState:
        return at_rest(self.model, y, t)

    def flow(self, t: Scalar, state: SampledState, u: Float[Array, "m"], y: Array) -> SampledState:
        q, v, _, last_input, age = state
        xi, drive = self.measured_error(t, q, v, u, y)
        w, v_dot = self.rates(q, v, xi, drive + friction(self.model, t, q, v, u))
        return SampledState(w, v_dot, jnp.ones_like(state.t), still(last_input), still(age))

    def rates(self, q: Array, v: Vector, xi: Vector, drive: Vector) -> tuple[Vector, Vector]:
        """Velocity w of the estimate, and v̂'.

        Args:
            q: Estimated configuration.
            v: Estimated velocity (n,).
            xi: Error ξ (n,) from q to q̂.
            drive: Acceleration (n,) without the feedback −βξ and the connection term −B(w, v̂).

        Returns:
            `w = v̂ − αξ` (n,), and v̂' (n,).
        """
        w = v - self.alpha * xi
        return w, drive - self.beta * xi - self.model.space.connection(q, w, v)

    def bend(self, at: Array, drive: Vector, xi: Vector, v: Vector) -> Vector:
        """Add the curvature term `R(ξ, v̂)v̂` to an acceleration, unless `curvature` is False.

        Args:
            at: Configuration at which the curvature is evaluated.
            drive: Acceleration (n,).
            xi: Error ξ (n,) from q to q̂.
            v: Estimated velocity (n,).

        Returns:
            Acceleration (n,).
        """
        return drive + self.model.space.curvature(at, xi, v, v) if self.curvature else drive

    def predict(self, state: SampledState, u: Float[Array, "m"], dt: Scalar) -> SampledState:
        return predicted(self.model, state, u, dt, self.substeps)

    def correct(self, state: SampledState, u: Float[Array, "m"], y: Array) -> tuple[SampledState, Info]:
        new, correction, xi, _ = self.corrected(state, u, y, self.sample_gains(time_since_measurement(state)))
        code = step_result(correction, readability(self.model, state.q, y))
        result = outcome(new.q, new.v, self.model.manifold.seen(state.q, y), code)
        return new, Info(self.innovation(state, u, y), self.model.space.norm(state.q, xi), result)

    def corrected(
        self, state: Any, u: Float[Array, "m"], y: Array, gains: tuple[Scalar, Scalar]
    ) -> tuple[Any, Any, Vector, Vector]:
        """The corrected state, the correction, the error ξ (n,), and the acceleration (n,) that a prediction lacks."""
        (q, v, t), waited = state[:3], time_since_measurement(state)
        xi, missing = self.missing_acceleration(t, q, v, u, y)
        correction = sampled_correction(self.model.space, Motion(q, v), gains, waited, xi, missing)
        new_q, new_v = self.moved(q, v, -correction.part * xi, correction.velocity)
        return state._replace(q=new_q, v=new_v, age=aged(self.model, state, y)), correction, xi, missing

    def missing_acceleration(
        self, t: Scalar, q: Array, v: Vector, u: Float[Array, "m"], y: Array
    ) -> tuple[Vector, Vector]:
        """Compute the error, and the acceleration that a prediction lacks, since it uses S at the estimate.

        Args:
            t: Time [s].
            q: Estimated configuration.
            v: Estimated velocity (n,).
            u: Input (m,).
            y: Measurement.

        Returns:
            The error ξ (n,) at q̂, and the acceleration (n,), to first order −Nξ with N = ∇S − R(·, v̂)v̂.
        """
        xi, drive = self.measured_error(t, q, v, u, y)
        return xi, drive - source(self.model, t, q, u)

    def moved(self, q: Array, v: Vector, displacement: Vector, velocity: Vector) -> Motion:
        """Displace an estimate, and change its velocity.

        Args:
            q: Estimated configuration.
            v: Estimated velocity (n,).
            displacement: Displacement (n,) of the configuration, in the frame.
            velocity: Change (n,) of the velocity.

        Returns:
            The new motion.
        """
        # To first order v̂ keeps its direction along the displacement, by parallel transport from q̂ to the new q̂.
        carried = v - self.model.space.connection(q, displacement, v)
        end = self.model.manifold.retract(q, displacement)
        return Motion(end, self.model.space.projected(end, carried + velocity))

    def smooth_correction(self, t: Scalar, q: Array, v: Vector, u: Float[Array, "m"], y: Array, age: Scalar) -> Motion:
        """Correct an estimate as `correct` does to first order in the missing acceleration, without a restart.

        `correct` divides the missing acceleration by `1 + square/18`, which is not differentiable for a zero error.

        Args:
            t: Time [s].
            q: Predicted configuration.
            v: Predicted velocity (n,).
            u: Input (m,).
            y: Measurement.
            age: Time since the last measurement [s], positive.

        Returns:
            The corrected motion.
        """
        return self.smoothly_moved(q, v, *self.missing_acceleration(t, q, v, u, y), age)

    def smoothly_moved(self, q: Array, v: Vector, xi: Vector, missing: Vector, age: Scalar) -> Motion:
        """Correct an estimate by a known error, as `smooth_correction` does.

        Args:
            q: Predicted configuration.
            v: Predicted velocity (n,).
            xi: Error ξ (n,) at q.
            missing: Acceleration (n,) that the prediction lacks.
            age: Time since the last measurement [s], positive.

        Returns:
            The corrected motion.
        """
        k1, k2 = self.sample_gains(age)
        return self.moved(q, v, -k1 * xi, acceleration_gain(k1, k2, age) * missing - k2 * xi)

    def sample_gains(self, age: Scalar) -> tuple[Scalar, Scalar]:
        """Compute the gains of a measurement.

        Args:
            age: Time since the last measurement [s].

        Returns:
            The gain of the position [1], and that of the velocity [1/s].
        """
        return sampled_gains(self.alpha, self.beta, age)

    def measured_error(self, t: Scalar, q: Array, v: Vector, u: Float[Array, "m"], y: Array) -> tuple[Vector, Vector]:
        """Compute the error, and the acceleration that follows from the measurement.

        Args:
            t: Time [s].
            q: Estimated configuration.
            v: Estimated velocity (n,).
            u: Input (m,).
            y: Measurement.

        Returns:
            The error ξ (n,) at q̂, and the acceleration `T S(q) + R(ξ, v̂)v̂` (n,) without friction.
        """
        # The innovation leads from q̂ to q, while the error of the paper leads from q to q̂.
        e = -self.model.manifold.towards(q, y)
        measured = self.model.manifold.measured(q, y)
        xi = e if self.order == 1 else second_order(self.model.space, q, e)
        return xi, self.measured_acceleration(t, q, v, u, measured, xi)

    def measured_acceleration(self, t: Scalar, q: Array, v: Vector, u: Float[Array, "m"], measured: Array, xi: Vector):
        """Compute the acceleration that follows from a complete measurement, for a known error.

        Args:
            t: Time [s].
            q: Estimated configuration.
            v: Estimated velocity (n,).
            u: Input (m,).
            measured: Measured configuration.
            xi: Error ξ (n,) at q̂.

        Returns:
            The acceleration `T S(q) + R(ξ, v̂)v̂` (n,) without friction.
        """
        at = measured if self.coefficients == "measured" else q
        s = source(self.model, t, measured, u)
        # ξ leads from the measurement to the estimate, so transport along it subtracts B(ξ, S), (5).
        # A first-order transport may leave a part normal to a leaf, which is removed.
        return self.model.space.projected(q, self.bend(at, s - self.model.space.connection(at, xi, s), xi, v))


def second_order(space: AbstractSpace, q: Array, e: Vector) -> Vector:
    """Riemannian error to second order, `ξ = e − ½(B + Q)(e, e)`.

    Args:
        space: Configuration space.
        q: Configuration at which B and Q are evaluated.
        e: First-order error (n,), in the frame.

    Returns:
        Error ξ (n,).

    Example:
        In the chart r = eˣ of a line, `B(e, e) = −e²/r`. From r = 0.9 to 1 the distance is ln(1/0.9) ≈ 0.1054:

        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> space = models.oscillator("r").space
        >>> xi = observers.second_order(space, jnp.array([1.0]), jnp.array([0.1]))
        >>> xi.round(6).tolist()
        [0.105]
    """
    return e - (space.connection(q, e, e) + space.manifold.retraction_acceleration(q, e)) / 2
