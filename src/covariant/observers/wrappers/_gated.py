"""Adds a gate to observers without a covariance: those with constant gains, and filters without a model.

An observer with constant gains may start far from the truth, and its innovations are then large for a while although
there are no outliers. So the gate must not use the innovations alone. Let r be the innovation before a correction and
`e` the error that the previous correction left, both from the estimate to the measurement. Then

    d = r − e

is the new information in this measurement: it consists of noise, and of the velocity error times the step, for any
gains and any size of the error. The measurement is refused if neither the noise s of a sample nor a velocity explains
it: `d² > 2(ks)² + (cS dt)²`. Here k is the threshold of the gate in deviations, S is the usual speed of the motion, and
c is 4 at the start and falls to 2 once smaller d have been seen. An outlier that passes has at most the effect of a
velocity cS over one step.

Observers with constant gains start at rest, and learn the velocity as slowly as they forget it. With a `fast_start`
their gains are at least those of a line through all readings since the start, 4/t and 6/t² after the time t, so that
the estimate is about as good as its readings allow. That the speed is the usual one counts as a time before the start.

Consecutive refused readings that show a credible velocity, below cS with c = 4, give the state that velocity at the
third of them; see `Gate`. If measurements agree with each other but not with the estimate, for example because the
observer has lost a spinning body, d stays large. When its mean square exceeds that of a velocity error of 2S, the
estimate is `ASTRAY`.

Source: Bar-Shalom, Li & Kirubarajan 2001, Estimation with Applications to Tracking and Navigation, section 5.4;
Morrison 1969, Introduction to Sequential Smoothing and Prediction, for the gains of an expanding memory.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from covariant._typing import Matrix, Number, Scalar, Vector
from covariant.models import MechanicalSystem, Motion
from covariant.observers.base import (
    CREDIBLE,
    AbstractObserver,
    Gate,
    GateMemory,
    Judged,
    LastInput,
    Sample,
    State,
    Velocity,
    as_gain,
    check_positive,
    check_whole,
    no_input,
    start,
    step_length,
)
from covariant.signals import StepCode
from scalargraph.errors import InputError


class GatedState(NamedTuple):
    """State of a `Gated` observer.

    Attributes:
        inner: State of the observer behind the gate.
        t: Time [s] of the state.
        gate: Memory of the gate.
        slip: Average (n,) of d², relative to its threshold for `ASTRAY`.
        last_input: The last finite input (m,).
        dt: Length of the last prediction [s].
        running: Time since the start or restart [s]; None without a fast start.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> model = models.oscillator()
        >>> observer = observers.Gated(observers.ModelCopy(model, 2.0, 4.0), model, noise=1e-3, speed=1.0)
        >>> state = observer.init(jnp.array([0.5]))
        >>> state.inner.q.tolist(), state.gate.refused.tolist()
        ([0.5], [0])
    """

    inner: Any
    t: Scalar
    gate: GateMemory
    slip: Vector
    last_input: LastInput = None
    dt: Scalar | None = None
    running: Scalar | None = None


class Gated(AbstractObserver):
    """An observer with a gate for its measurements, which also reports a wrong velocity.

    A refused measurement counts as missing, and `result` says `OUTLIER`. After `gate.patience` consecutive refusals the
    estimate restarts from the measured configuration, and `result` says `RESTARTED`; the velocity `v` in the observer's
    state is kept, unless it is not credible. Refused readings that show a credible velocity restart the estimate at
    once, with that velocity as its `v`. If the measurements show a velocity error of more than twice the usual
    velocity, `result` says `ASTRAY`.

    Attributes:
        observer: Observer of a mechanical system, or filter of its coordinates. Its state is `state.inner`.
        model: Mechanical system whose configurations are measured.
        noise: Standard deviation of the noise of one sample [rad or m], a number or (n,).
        speed: Usual size of the velocities [rad/s or m/s], a number or (n,).
        gate: The gate, by default `Gate()`.
        fast_start: Whether the gains of an observer with constant ones, its `alpha` and `beta`, are larger just after
            the start, so that it knows the velocity as soon as its readings tell it; False (default) keeps them
            constant, as certificates assume.

    Raises:
        ValueError: `noise` or `speed` is not positive and finite, an observer without constant gains should start fast,
            or the reports of the observer concern its own steps, such as a proved bound: bound the gated observer
            instead.

    Example:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> from covariant import StepCode, models, observers
        >>> model = models.oscillator()
        >>> observer = observers.Gated(observers.ModelCopy(model, 2.0, 4.0), model, noise=1e-3, speed=1.0)
        >>> state = observer.init(jnp.zeros(1))
        >>> state, info = jax.jit(observer.step)(state, jnp.zeros(1), jnp.array([5.0]), 0.01)
        >>> StepCode(int(info.result)).name, observer.estimate(state).tolist()
        ('OUTLIER', [0.0, 0.0])
    """

    observer: AbstractObserver
    model: MechanicalSystem
    noise: Scalar | Vector = eqx.field(converter=as_gain)
    speed: Scalar | Vector = eqx.field(converter=as_gain)
    gate: Gate = Gate()
    fast_start: bool = eqx.field(default=False, static=True)

    def __check_init__(self):
        check_positive("Gated", noise=self.noise, speed=self.speed)
        if self.fast_start and not hasattr(self.observer, "beta"):
            raise InputError(f"Gated: {type(self.observer).__name__} has no constant gains, and so no fast_start")
        check_whole("Gated", self.observer)

    def init(self, y: Array, t: Number = 0.0) -> GatedState:
        """State at rest at a measured configuration, with an open gate.

        Args:
            y: First measurement, complete: coordinates (n,), or on a group a matrix (N, N).
            t: Its time stamp [s], 0 by default.

        Returns:
            The state.
        """
        rest = self.model.manifold.zero(y)
        inner = without_last_input(self.observer.init(y, t))
        last_input = no_input(self.model, rest)
        t = jnp.asarray(t, rest.dtype)
        running = jnp.zeros_like(t) if self.fast_start else None
        return GatedState(inner, t, GateMemory.at_start(rest), rest, last_input, jnp.zeros_like(t), running)

    def estimate(self, state: GatedState) -> Any:
        return self.observer.estimate(state.inner)

    def predict(self, state: GatedState, u: Float[Array, "m"], dt: Scalar) -> GatedState:
        inner = self.observer.predict(state.inner, u, dt)
        running = None if state.running is None else state.running + dt
        return state._replace(inner=inner, t=state.t + dt, gate=state.gate.advanced(dt), dt=dt, running=running)

    def correct(self, state: GatedState, u: Float[Array, "m"], y: Array) -> tuple[GatedState, Any]:
        """Correct a predicted state by a measurement that passes the gate.

        Args:
            state: State that `predict` returned.
            u: Input (m,) that acted over the prediction.
            y: Measurement, NaN where missing.

        Returns:
            The corrected state, or the state of a restart, and the info of the inner observer, with the innovation
            before the gate and the result code of gate and observer.
        """
        manifold = self.model.manifold
        present, innovation = ~manifold.missing(y), self.innovation(state, u, y)
        verdict = self._judge(state, innovation, present)
        # A state without a velocity follows readings that show one through its ordinary correction.
        outlying = verdict.far if self._holds_velocity(state) else verdict.far & ~verdict.moved
        inner, info = self._at_its_gains(state).correct(state.inner, u, self._without(y, outlying))
        used = present & ~outlying
        motion = self.model.motion(self.observer.estimate(inner))
        slip = self._average_slip(state, innovation, used)
        if not self._holds_velocity(state):
            verdict = verdict._replace(far=outlying, restart=verdict.restart & ~jnp.any(verdict.moved))
        restart = verdict.restart
        memory = verdict.memory.used(used, manifold.ambient.towards(motion.q, y))
        new = state._replace(inner=inner, gate=memory, slip=slip)
        restarted = self._restarted(state, motion, verdict, y)
        # A restart keeps a scale above 1; a smaller scale would make the gate too narrow.
        restarted = restarted._replace(gate=restarted.gate._replace(scale=jnp.maximum(memory.scale, 1.0)))
        new = jax.tree.map(lambda a, b: jnp.where(restart, a, b), restarted, new)
        astray = jnp.any(slip > 1).astype(jnp.int32) * int(StepCode.ASTRAY)
        result = jnp.maximum(jnp.maximum(info.result, verdict.result(info.result)), astray)
        return new, info._replace(innovation=innovation, result=result.astype(info.result.dtype))

    def innovation(self, state: GatedState, u: Float[Array, "m"], y: Array) -> Vector:
        return self.observer.innovation(state.inner, u, y)

    def _at_its_gains(self, state: GatedState) -> Any:
        """The inner observer, just after the start with larger gains and without learning a force."""
        observer: Any = self.observer
        if state.running is None:
            return observer
        # With the time in which the usual speed moves by √12 noises, as the slope of a line over it tells no more.
        t = state.running + 12**0.5 * jnp.max(self.noise / self.speed)
        starts: dict[str, Any] = {
            "alpha": jnp.maximum(observer.alpha, 4 / t),
            "beta": jnp.maximum(observer.beta, 6 / t**2),
        }
        if hasattr(observer, "force_rate"):
            starts["force_rate"] = jnp.where(starts["beta"] > observer.beta, 0.0, observer.force_rate)
        return eqx.tree_at(lambda o: [getattr(o, name) for name in starts], observer, list(starts.values()))

    @property
    def start_length(self) -> float:
        """Time [s] after which the gains are those of the inner observer; 0 without a fast start."""
        observer: Any = self.observer
        longest = jnp.maximum(4 / observer.alpha, jnp.sqrt(6 / observer.beta)) if self.fast_start else 0.0
        return float(jnp.max(longest))

    def _average_slip(self, state: GatedState, innovation: Vector, used: Bool[Array, "n"]) -> Vector:
        limit = 2 * (self.gate.deviations * self.noise) ** 2 + (CREDIBLE / 2 * self.speed * state.gate.unused) ** 2
        # Twice the variance: two samples contribute to the difference d.
        change = (innovation - state.gate.left) ** 2 / limit - state.slip
        return state.slip + jnp.where(used, change, 0.0) / (1 + self.gate.patience)

    def _judge(self, state: GatedState, innovation: Vector, present: Bool[Array, "n"]) -> Judged:
        """The gate's verdict on whether noise and velocity explain d; see the head of this file."""
        dt, rate = step_length(state), CREDIBLE / self.gate.deviations * self.speed
        expected = 2 * self.noise**2 + (rate * dt) ** 2
        # A velocity error acts over a gap without readings, and so widens the gate; refused readings do not.
        least = (2 * self.noise**2 + (rate * (state.gate.idle - dt / 2)) ** 2) / expected
        cov, noise, usual = (self._diagonal(square, innovation) for square in (expected, self.noise**2, self.speed**2))
        predicted = Velocity(self.model.motion(self.observer.estimate(state.inner)).v, usual)
        # In d, the error left by the last used reading is already subtracted, so `left` is zero here.
        sample = Sample(innovation - state.gate.left, cov, noise, present)
        memory = state.gate._replace(left=jnp.zeros_like(innovation))
        verdict = self.gate.judge(self.model.manifold, sample, memory, predicted, usual, least)
        return verdict._replace(memory=verdict.memory._replace(left=state.gate.left))

    def _diagonal(self, variances: Vector | Scalar, like: Vector) -> Matrix:
        return jnp.diag(jnp.broadcast_to(variances, like.shape).astype(like.dtype))

    def _without(self, y: Array, outlying: Bool[Array, "n"]) -> Array:
        """The measurement with NaN in refused entries; on a group, in all entries if one is refused."""
        return jnp.where(outlying if self.model.manifold.commuting else jnp.any(outlying), jnp.nan, y)

    def _holds_velocity(self, state: GatedState) -> bool:
        return "v" in state.inner._fields

    def _restarted(self, state: GatedState, motion: Motion, verdict: Judged, y: Array) -> GatedState:
        """The state at the measured configuration, with the velocity of the verdict if that is credible."""
        manifold = self.model.manifold
        q = start(manifold, motion.q, manifold.ambient.towards(motion.q, y), y, verdict.anew)
        restarted = self.init(q, state.t)._replace(last_input=state.last_input, dt=state.dt)
        if state.running is None:  # in a state written by hand
            restarted = restarted._replace(running=None)
        if not self._holds_velocity(state):
            return restarted
        v = verdict.velocity.mean
        credible = jnp.all(jnp.abs(v) <= CREDIBLE * self.speed)
        # A force that the observer has learnt continues to act.
        learnt = {"force": state.inner.force} if "force" in state.inner._fields else {}
        return restarted._replace(inner=restarted.inner._replace(v=jnp.where(credible, v, 0.0), **learnt))


def without_last_input(state: State) -> State:
    """State of the inner observer without a field for the last input, since it receives only valid inputs."""
    return state._replace(last_input=None) if "last_input" in state._fields else state
