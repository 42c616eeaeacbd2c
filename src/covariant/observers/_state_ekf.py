"""Extended Kalman filter of a state-space model in covariance form, with sampled measurements and a gate.

Source: Gelb 1974, Applied Optimal Estimation, section 6.1; Joseph form of the covariance update.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from covariant._integrate import rk4
from covariant._linalg import solve
from covariant._typing import Code, Matrix, Number, Scalar, Vector
from covariant.geometry import AbstractManifold
from covariant.models import StateSpace
from covariant.observers._gate import Gate, Judged, open_gate
from covariant.observers._gated_filter import AbstractGatedFilter, Expectation
from covariant.observers._protocol import Held, check_finite, no_input
from covariant.observers._sampled import steps_for
from covariant.observers._square_root import normalised_square
from covariant.signals import Result


class StateEKFState(NamedTuple):
    """Estimated state x (n,) at time t [s], its covariance `cov` (n, n), what the gate remembers of each output
    (`refused`, `scale`), and the last finite input `held`."""

    x: Vector
    t: Scalar
    cov: Matrix
    refused: Int[Array, "p"]
    scale: Vector
    held: Held = None


class StateEKFInfo(NamedTuple):
    """As `Info`, with the predicted covariance of the innovation (p,) and its normalised square `nis`, whose root is
    the `distance`, and the standard deviations `state_std` (n,) after the correction."""

    innovation: Vector
    distance: Scalar
    innovation_cov: Matrix
    nis: Scalar
    state_std: Vector
    result: Code


class StateEKF(AbstractGatedFilter):
    """Extended Kalman filter of `x' = f(t, x, u)`, `y = h(t, x, u)`, linearised along the integrated model.

    - `process_cov` (n, n): spectral density of the white noise in f [(unit of x)²/s].
    - `measurement_cov` (p, p): covariance of one sample of the outputs.
    - `start` (n,), `start_cov` (n, n): first estimate and its covariance.
    - `substeps`: Runge–Kutta steps in each sample; None takes as many as dt and the model need (offline).
    - `gate`: which outputs are refused as outliers; None refuses none. See `Gate`.

    Raises `ValueError` for covariances that are not finite.
    """

    model: StateSpace
    process_cov: Matrix
    measurement_cov: Float[Array, "p p"]
    start: Vector
    start_cov: Matrix
    substeps: int | None = eqx.field(default=None, static=True)
    gate: Gate | None = Gate()

    def __check_init__(self):
        check_finite(
            "StateEKF",
            process_cov=self.process_cov,
            measurement_cov=self.measurement_cov,
            start=self.start,
            start_cov=self.start_cov,
        )

    def init(self, y: Float[Array, "p"], t: Number = 0.0) -> StateEKFState:
        start, cov = jnp.asarray(self.start, y.dtype), jnp.asarray(self.start_cov, y.dtype)
        refused, scale = open_gate(jnp.zeros_like(y))
        u = no_input(self.model, start)
        return self.correct(StateEKFState(start, jnp.asarray(t, y.dtype), cov, refused, scale, u), u, y)[0]

    def estimate(self, state: StateEKFState) -> Vector:
        return state.x

    def predict(self, state: StateEKFState, u: Float[Array, "m"], dt: Scalar) -> StateEKFState:
        """Estimate and covariance dt [s] later, with u held constant."""
        count = self.needed_substeps(state, u, dt) if self.substeps is None else self.substeps

        def ahead(x):
            moved = rk4(lambda s, x: self.model.f(s, x, u), state.t, x, dt, count)
            return moved, moved

        transition, x = jax.jacfwd(ahead, has_aux=True)(state.x)
        # Simpson's rule for what white noise adds, with the mean of both ends for the transition over half the step.
        half = (jnp.eye(len(x), dtype=x.dtype) + transition) / 2
        density = jnp.asarray(self.process_cov, x.dtype)
        added = density + 4 * half @ density @ half.T + transition @ density @ transition.T
        return state._replace(x=x, t=state.t + dt, cov=transition @ state.cov @ transition.T + dt / 6 * added)

    @property
    def _manifold(self) -> AbstractManifold:
        return self.model.manifold

    def _expected(self, state: StateEKFState, u: Float[Array, "m"], y: Float[Array, "p"]) -> Expectation:
        x = state.x
        slope: Array = jax.jacfwd(self.model.h, 1)(state.t, x, u)
        innovation = -self.model.output_error(self.model.h(state.t, x, u), y)
        cov = slope @ state.cov @ slope.T + jnp.asarray(self.measurement_cov, x.dtype)
        return Expectation(y, innovation, cov, ~jnp.isnan(y), details=slope)

    def _used(
        self, state: StateEKFState, y: Float[Array, "p"], expected: Expectation, used: Bool[Array, "p"]
    ) -> StateEKFState:
        x, slope, noise = state.x, expected.details, jnp.asarray(self.measurement_cov, state.x.dtype)
        # The noise of an output that is not used must not affect the others, even where the two are correlated.
        noise = jnp.where(used[:, None] & used[None, :], noise, jnp.eye(len(y), dtype=x.dtype))
        output = jnp.where(used[:, None], slope, 0.0)
        gain = solve(output @ state.cov @ output.T + noise, output @ state.cov).T
        left = jnp.eye(len(x), dtype=x.dtype) - gain @ output
        cov = left @ state.cov @ left.T + gain @ noise @ gain.T
        moved = x + gain @ jnp.where(used, expected.innovation, 0.0)
        return state._replace(x=moved, cov=(cov + cov.T) / 2)

    def _started_anew(
        self, state: StateEKFState, corrected: StateEKFState, y: Float[Array, "p"], expected: Expectation
    ) -> StateEKFState:
        # Outputs do not tell a state: the estimate stays, and is believed no more than at the start.
        return corrected._replace(cov=jnp.asarray(self.start_cov, state.x.dtype))

    def _result(
        self, state: StateEKFState, new: StateEKFState, y: Float[Array, "p"], expected: Expectation, verdict: Judged
    ) -> Code:
        own = jnp.where(jnp.any(expected.present), int(Result.OK), int(Result.COASTED)).astype(jnp.int32)
        finite = jnp.all(jnp.isfinite(new.x)) & jnp.all(jnp.isfinite(new.cov))
        return jnp.where(finite, verdict.result(own), int(Result.NOT_FINITE)).astype(jnp.int32)

    def _info(self, state: StateEKFState, new: StateEKFState, expected: Expectation, result: Code) -> StateEKFInfo:
        _, innovation, cov, present, *_ = expected
        nis = normalised_square(cov, innovation, present)
        return StateEKFInfo(innovation, jnp.sqrt(nis), cov, nis, jnp.sqrt(jnp.diag(new.cov)), result)

    def advance(
        self, state: StateEKFState, u: Float[Array, "m"], y: Float[Array, "p"], dt: Scalar
    ) -> tuple[StateEKFState, StateEKFInfo]:
        new, info = self.correct(self.predict(state, u, dt), u, y)
        before = jnp.sqrt(jnp.diag(state.cov))  # a stamp that is repeated changes nothing
        return new, info._replace(state_std=jnp.where(dt > 0, info.state_std, before))

    def needed_substeps(self, state: StateEKFState, u: Array, dt: Scalar) -> Code:
        """Steps that keep h·rate ≤ 1, with a bound on the largest eigenvalue of ∂f/∂x."""
        power = jax.jacfwd(self.model.f, 1)(state.t, state.x, u)
        for _ in range(3):
            power = power @ power
        return steps_for(dt, 2 * jnp.sqrt(jnp.sum(power * power)) ** 0.125)
