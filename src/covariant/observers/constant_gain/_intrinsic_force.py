"""Extends the approximate intrinsic observer by an estimate of an unknown force: integral action, with three poles.

Source: an extension of Aghannan & Rouchon 2003, equation (5); Johnson 1971, Accommodation of external disturbances in
linear regulator and servomechanism problems, IEEE TAC 16(6), for the state of the disturbance.

With the force d, a covector, the model accelerates by `S(q) + raise(d)`. For an observer that knows d this is only
another source, so transport, curvature and the sampled correction apply to it as they do to S. If the estimate of the
force is off by δ, the error law becomes

    ξ' = ζ − (α + ρ)ξ,   ζ' = −(β + αρ)ξ + η,   η' = −βρ ξ − raise(δ ∘ B(v, ·)),   η = raise(δ).

Without the last term its poles are those of (s² + αs + β)(s + ρ). The last term arises because a force with constant
components in the frame is not parallel: along a motion with velocity v its covariant derivative is −d ∘ B(v, ·). Its
size is |B(v, ·)| |η|, and it vanishes if the metric is constant. On a double pendulum at 20 rad/s it changes the rates
of decay by 1 % for ω = 50 and ρ = 18, and by a fourth for ω = 10 and ρ = 5, which is slower than the motion.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Inexact

from covariant._typing import Code, Number, Scalar, Vector
from covariant.models import MechanicalSystem, friction
from covariant.observers.base import (
    AbstractMechanicalObserver,
    LastInput,
    as_gain,
    at_rest,
    check_not_negative,
    check_positive,
    outcome,
    predicted,
    readability,
    sampled_force_gains,
    step_result,
    still,
    time_since_measurement,
)
from covariant.observers.constant_gain._intrinsic import Intrinsic


class IntrinsicForceState(NamedTuple):
    """State of an `IntrinsicForce` observer.

    Attributes:
        q: Estimated configuration: coordinates (n,), or on a group a matrix (N, N).
        v: Estimated velocity (n,), in the frame.
        t: Time [s] of the estimate.
        force: Estimated force (n,) that the model does not contain, a covector in the frame [N or N m].
        last_input: The last finite input (m,); None in continuous time.
        age: Time since the last measurement [s]; None in continuous time.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> observer = observers.IntrinsicForce(models.ball_and_beam(), alpha=4.0, beta=8.0, force_rate=1.0)
        >>> observer.init(jnp.array([0.3, 0.1])).force.tolist()
        [0.0, 0.0]
    """

    q: Inexact[Array, "..."]
    v: Vector
    t: Scalar
    force: Vector
    last_input: LastInput = None
    age: Scalar | None = None


class IntrinsicForceInfo(NamedTuple):
    """Diagnostics of a step of an `IntrinsicForce` observer.

    Attributes:
        innovation: Difference (n,) from q̂ to y before the correction, as in `Info`.
        distance: Its length in the metric.
        slow: Estimated force (n,) after the correction [N or N m], in the order of the observer's `slow_names`.
        result: A `covariant.signals.StepCode` code.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> observer = observers.IntrinsicForce(models.oscillator(), alpha=4.0, beta=8.0, force_rate=1.0)
        >>> _, info = observer.step(observer.init(jnp.zeros(1)), jnp.zeros(1), jnp.array([0.5]), 0.01)
        >>> bool(info.slow[0] > 0)  # what has moved the unit mass away, if it was a force
        True
    """

    innovation: Vector
    distance: Scalar
    slow: Vector
    result: Code


class IntrinsicForce(AbstractMechanicalObserver):
    """`Intrinsic` with an estimate of a constant unknown force, so that a load or friction causes no velocity error.

    With the error ξ from q to q̂, and the force d̂ added to that of the model, it is `Intrinsic` with

        w = v̂ − (α + ρ)ξ,   v̂' = … − (β + αρ)ξ,   d̂' = −βρ lower(ξ)

    To first order the error has the poles of (s² + αs + β)(s + ρ) at any velocity, apart from a coupling proportional
    to connection and velocity, because a force that is constant in the frame is not parallel. On a group the force is a
    wrench in the body frame. For ρ = 0 and no force it is `Intrinsic`.

    Without a measurement the force stays for 1/ρ, and is then forgotten at the rate ρ, as in a hole of a log.

    Use it if the model lacks something persistent, such as loads, friction or a part of the mass; and in the loop of a
    controller, where a constant velocity error acts like a torque. It is somewhat noisier than `Intrinsic` with the
    same α and β. `IntrinsicKalman` with `external_force` estimates the same force with its uncertainty.

    Attributes:
        model: The mechanical system, without the force.
        alpha: Gain α [1/s], the damping 2ζω of two of the poles.
        beta: Gain β [1/s²], the squared frequency ω² of these poles.
        force_rate: Rate ρ [1/s] at which the force is learnt, the third pole; 0 holds the force.
        order: Order of the error, as for `Intrinsic`.
        coefficients: Where B and R of the error terms are evaluated, as for `Intrinsic`.
        curvature: False leaves the curvature term out, to show its effect; True by default.
        substeps: Number of Runge–Kutta steps in each sample; None (default) uses as many as dt and the friction need
            (offline).

    Raises:
        ValueError: A gain is not positive and finite, `force_rate` is negative, or `order` or `coefficients` has
            another value; or in `init`, the first measurement is not a configuration.

    Example:
        A load of 2 N on a unit mass on a unit spring, which the model does not know:

        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> t = np.linspace(0.0, 4.0, 401)
        >>> record = Record(t, np.zeros((401, 1)), 2.0 - np.cos(t)[:, None])
        >>> observer = observers.IntrinsicForce(models.oscillator(), alpha=14.0, beta=100.0, force_rate=5.0)
        >>> run = observers.run(observer, record)
        >>> bool(abs(run.estimate[-1, 1] - np.sin(4.0)) < 1e-3), run.info.slow[-1].round(2).tolist()
        (True, [2.0])
    """

    model: MechanicalSystem
    alpha: Scalar = eqx.field(converter=as_gain)
    beta: Scalar = eqx.field(converter=as_gain)
    force_rate: Scalar = eqx.field(converter=as_gain)
    order: Literal[1, 2] = eqx.field(default=1, static=True)
    coefficients: Literal["measured", "estimated"] = eqx.field(default="measured", static=True)
    curvature: bool = eqx.field(default=True, static=True)
    substeps: int | None = eqx.field(default=None, static=True)

    def __check_init__(self):
        check_positive("IntrinsicForce", alpha=self.alpha, beta=self.beta)
        check_not_negative("IntrinsicForce", force_rate=self.force_rate)
        self._knowing(None)  # checks the other fields

    @property
    def slow_names(self) -> tuple[str, ...]:
        """Names (n) of the components of the force, in the order of `IntrinsicForceInfo.slow`."""
        manifold = self.model.manifold
        if None in manifold.shape:  # coordinates without names, whose number is unknown
            return ()
        return tuple(f"external_force{i + 1}" for i in range(jax.eval_shape(manifold.zero, manifold.origin()).size))

    def init(self, y: Array, t: Number = 0.0) -> IntrinsicForceState:
        q, v, t, last_input, age = at_rest(self.model, y, t)
        return IntrinsicForceState(q, v, t, jnp.zeros_like(v), last_input, age)

    def flow(self, t: Scalar, state: IntrinsicForceState, u: Float[Array, "m"], y: Array) -> IntrinsicForceState:
        (q, v), observer = state[:2], self._knowing(state.force)
        xi, drive = observer.measured_error(t, q, v, u, y)
        w, v_dot = observer.rates(q, v, xi, drive + friction(self.model, t, q, v, u))
        force_dot = -self.beta * self.force_rate * self.model.space.lower(q, xi)
        one, stored = jnp.ones_like(state.t), (still(state.last_input), still(state.age))
        return IntrinsicForceState(w, v_dot, one, force_dot, *stored)

    def predict(self, state: IntrinsicForceState, u: Float[Array, "m"], dt: Scalar) -> IntrinsicForceState:
        age = jnp.zeros_like(state.t) if state.age is None else state.age

        def remembered(after: Scalar) -> Vector:
            # The time in which a force is learnt is that after which it is forgotten. At usual steps none is, so that a
            # force that lasts leaves no error.
            late, later = (jnp.maximum(1.0, self.force_rate * (age + each)) for each in (0.0, after))
            return jnp.exp(late - later) * state.force

        def force(t: Scalar, q: Array, u: Float[Array, "m"]) -> Vector:
            return self.model.force(t, q, u) + remembered(t - state.t)

        model = eqx.tree_at(lambda m: m.force, self.model, force)
        return predicted(model, state._replace(force=remembered(dt)), u, dt, self.substeps)

    def correct(
        self, state: IntrinsicForceState, u: Float[Array, "m"], y: Array
    ) -> tuple[IntrinsicForceState, IntrinsicForceInfo]:
        q, space, waited = state.q, self.model.space, time_since_measurement(state)
        k1, k2, k3 = sampled_force_gains(self.alpha, self.beta, self.force_rate, waited)
        new, correction, xi, missing = self._knowing(state.force).corrected(state, u, y, (k1, k2))
        # K3 = k3 (1 − N dt²/12), and the missing acceleration is −Nξ. A late sample tells nothing about the force.
        learnt = k3 * space.lower(q, xi + waited * waited / 12 * missing)
        force = state.force - jnp.where(correction.restarted, 0.0, learnt)
        code = step_result(correction, readability(self.model, q, y))
        result = outcome(new.q, jnp.concatenate([new.v, force]), self.model.manifold.seen(q, y), code)
        info = IntrinsicForceInfo(self.innovation(state, u, y), space.norm(q, xi), force, result)
        return new._replace(force=force), info

    def _knowing(self, force: Vector | None) -> Intrinsic:
        """The observer `Intrinsic` of the model with a known force (n,), with the gains of position and velocity."""
        model = self.model
        if force is not None:
            model = eqx.tree_at(lambda m: m.force, model, lambda t, q, u: self.model.force(t, q, u) + force)
        gains = self.alpha + self.force_rate, self.beta + self.alpha * self.force_rate
        return Intrinsic(model, *gains, self.order, self.coefficients, self.curvature, self.substeps)
