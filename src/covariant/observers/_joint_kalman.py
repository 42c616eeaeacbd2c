"""Kalman filter of every coordinate by itself, whose acceleration is coloured noise: Singer's. Knows no model.

    q' = v,   v' = a,   a' = −a/τ + w,   w white of the density 2σ²/τ:

in the long run a has the standard deviation σ and is forgotten after τ. For dt much shorter than τ this is white jerk;
over a gap the acceleration fades out, where white jerk would fly off. Of all linear filters it has the least error for
such a motion. In units of σ and τ nothing is left but `θ = dt/τ` and the noise of a sample, `s/στ²`.

Source: Singer 1970, Estimating optimal tracking filter performance for manned maneuvering targets, IEEE TAES 6(4);
Bar-Shalom, Li & Kirubarajan 2001, Estimation with Applications to Tracking and Navigation, chapter 6.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from covariant._linalg import semidefinite_root, triangular
from covariant._typing import Code, Matrix, Number, Scalar, Vector
from covariant.geometry import AbstractManifold, Coordinates, wrap
from covariant.observers._gate import Gate, Judged, open_gate
from covariant.observers._gated_filter import AbstractGatedFilter, Expectation
from covariant.observers._model_free import AbstractLinearFilter, response
from covariant.observers._protocol import as_gain, check_positive, outcome
from covariant.observers._square_root import updated


class JointState(NamedTuple):
    """Position, velocity and acceleration (n,), and of each coordinate a square root `root` (n, 3, 3) of their
    covariance in units of στ², στ and σ.

    - `refused` (n,), `scale` (n,): what the gate remembers; see `Gate.judge`.
    """

    q: Vector
    v: Vector
    a: Vector
    root: Float[Array, "n 3 3"]
    refused: Int[Array, "n"]
    scale: Vector


class JointInfo(NamedTuple):
    """As `FilterInfo`, with the sum `nis` of the squared innovations over their predicted variances, and the standard
    deviations `velocity_std` (n,) of the velocity after the correction."""

    innovation: Vector
    nis: Scalar
    velocity_std: Vector
    result: Code


class JointKalman(AbstractGatedFilter, AbstractLinearFilter):
    """Kalman filter of each coordinate with Singer's acceleration, exact at irregular stamps.

    - `motion_std`: σ, standard deviation of the accelerations [rad/s² or m/s²].
    - `motion_time`: τ, over which they change [s].
    - `measurement_std`: s, of the noise of one sample [rad or m].
    - `circles`: indices of the coordinates that are angles on a full circle, which are followed modulo a turn.
    - `gate`: which measurements are refused as outliers; None refuses none. See `Gate`.

    At the start the velocity is known to be zero within στ. Raises `ValueError` for numbers that are not positive.
    """

    motion_std: Scalar = eqx.field(converter=as_gain)
    motion_time: Scalar = eqx.field(converter=as_gain)
    measurement_std: Scalar = eqx.field(converter=as_gain)
    circles: tuple[int, ...] = eqx.field(default=(), static=True)
    gate: Gate | None = Gate()

    def __check_init__(self):
        numbers = {"motion_std": self.motion_std, "motion_time": self.motion_time}
        check_positive("JointKalman", **numbers, measurement_std=self.measurement_std)

    @property
    def noise(self) -> Scalar:
        """Standard deviation of a sample in units of στ²."""
        return self.measurement_std / (self.motion_std * self.motion_time**2)

    def init(self, y: Vector, t: Number = 0.0) -> JointState:
        rest = jnp.zeros_like(y)
        return JointState(y, rest, rest, self._first_root(y), *open_gate(y))

    def estimate(self, state: JointState) -> Float[Array, "two_n"]:
        return jnp.concatenate([state.q, state.v])

    @property
    def _units(self) -> Float[Array, "3"]:
        """The units of position, velocity and acceleration: τ², τ and 1 times σ."""
        time = jnp.asarray(self.motion_time)
        return jnp.stack([time**2, time, jnp.ones_like(time)])

    def predict(self, state: JointState, u: Float[Array, "m"], dt: Scalar) -> JointState:
        step, added = singer(dt / self.motion_time)
        units = self._units.astype(dt.dtype)[:, None]
        q, v, a = units * (step @ (jnp.stack([state.q, state.v, state.a]) / units))
        noise = semidefinite_root(added)
        root = jax.vmap(lambda each: triangular(jnp.concatenate([step @ each, noise], axis=1)))(state.root)
        return state._replace(q=q, v=v, a=a, root=root)

    @property
    def _manifold(self) -> AbstractManifold:
        return Coordinates()

    def _expected(self, state: JointState, u: Float[Array, "m"], y: Vector) -> Expectation:
        present = ~jnp.isnan(y)
        innovation = wrap(self.circles, jnp.where(present, y - state.q, 0.0))
        unit = self._units[0].astype(y.dtype)
        cov = jnp.diag(jnp.sum(state.root[:, 0] ** 2, axis=1) + self.noise**2) * unit**2 * self.motion_std**2
        return Expectation(y, innovation, cov, present)

    def _used(self, state: JointState, y: Vector, expected: Expectation, used: Bool[Array, "n"]) -> JointState:
        gain, root = jax.vmap(updated, (0, 0, None, 0))(
            state.root, state.root[:, :1], jnp.full((1, 1), self.noise**2), used[:, None]
        )
        units = self._units.astype(y.dtype)
        error = (units / units[0])[:, None] * gain[..., 0].T * expected.innovation[None]
        return state._replace(q=state.q + error[0], v=state.v + error[1], a=state.a + error[2], root=root)

    def _started_anew(self, state: JointState, corrected: JointState, y: Vector, expected: Expectation) -> JointState:
        q = state.q + expected.innovation
        return corrected._replace(q=q, v=state.v, a=state.a, root=self._first_root(y))

    def _result(self, state: JointState, new: JointState, y: Vector, expected: Expectation, verdict: Judged) -> Code:
        return outcome(new.q, new.v, y, verdict.result(jnp.zeros((), jnp.int32)))

    def _info(self, state: JointState, new: JointState, expected: Expectation, result: Code) -> JointInfo:
        nis = jnp.sum(expected.innovation**2 / jnp.diag(expected.cov))
        unit = self._units[1].astype(state.v.dtype)
        std = self.motion_std * unit * jnp.sqrt(jnp.sum(new.root[:, 1] ** 2, axis=1))
        return JointInfo(expected.innovation, nis, std, result)

    def _first_root(self, y: Vector) -> Float[Array, "n 3 3"]:
        one = jnp.ones_like(y)
        return jax.vmap(jnp.diag)(jnp.stack([self.noise * one, one, one], axis=1))

    def weights(self, rate: float) -> Float[np.ndarray, "k"]:
        time, noise = float(self.motion_time), float(self.noise)
        step, added = map(np.asarray, jax.jit(singer)(1 / (rate * time)))
        cov = _stationary(step, added, noise**2)
        gain = cov[:, 0] / (cov[0, 0] + noise**2)
        return response(step, gain) / time  # of a velocity in units of στ from positions in units of στ²


TERMS = 25
"""Terms of the series for θ ≤ 1: the next is below 1e-17."""

_POSITION = [(-1) ** k / math.factorial(k) for k in range(2, TERMS)]
_VELOCITY_SQUARE = [(-1) ** k * (2**k - 2) / math.factorial(k) / (k + 1) for k in range(2, TERMS)]
_POSITION_SQUARE = [(-1) ** k * (2**k - 2 - 2 * k) / math.factorial(k) / (k + 1) for k in range(4, TERMS)]


def singer(theta: Scalar) -> tuple[Matrix, Matrix]:
    """Transition (3, 3) of position, velocity and acceleration over θ = dt/τ, in units of στ², στ, σ, and the
    covariance (3, 3) of what the noise adds.

    An acceleration of 1 moves the velocity by `f(x) = 1 − e⁻ˣ` and the position by `g(x) = x − f(x)` in the time x; the
    covariance is twice the integral of the products of g, f and e⁻ˣ from 0 to θ, where `g' = f`, `f' = e⁻ˣ`.
    """
    far = theta > 1
    near = jnp.where(far, 1.0, theta)  # where the closed forms would be differences of equal numbers
    fades, f = jnp.exp(-theta), -jnp.expm1(-theta)
    g = jnp.where(far, theta - f, near**2 * _series(_POSITION, near))
    ff = jnp.where(far, g - f**2 / 2, near**3 * _series(_VELOCITY_SQUARE, near))  # ∫f²
    gg = theta**3 / 3 - theta**2 + 2 * (1 - (1 + theta) * fades) + ff
    gg = jnp.where(far, gg, near**5 * _series(_POSITION_SQUARE, near))  # ∫g²
    zero, one = jnp.zeros_like(theta), jnp.ones_like(theta)
    step = [[one, theta, g], [zero, one, f], [zero, zero, fades]]
    added = [[2 * gg, g**2, 2 * (f * g - ff)], [g**2, 2 * ff, f**2], [2 * (f * g - ff), f**2, -jnp.expm1(-2 * theta)]]
    return jnp.stack([jnp.stack(row) for row in step]), jnp.stack([jnp.stack(row) for row in added])


def _series(coefficients: list[float], x: Scalar) -> Scalar:
    total = jnp.zeros_like(x)
    for coefficient in coefficients[::-1]:
        total = total * x + coefficient
    return total


def _stationary(step: np.ndarray, added: np.ndarray, noise: float) -> np.ndarray:
    """The covariance before a measurement of the first component that measurements no longer change.

    By doubling: each pass takes twice as many samples at once (Anderson & Moore 1979, Optimal Filtering, section 6.7).
    """
    a, cov = step.T, added
    told = np.zeros_like(cov)
    told[0, 0] = 1 / noise
    for _ in range(60):
        passed = np.linalg.solve(np.eye(3) + told @ cov, np.concatenate([a, told], axis=1))
        more = a.T @ cov @ passed[:, :3]
        told = told + a @ passed[:, 3:] @ a.T
        cov, before = cov + more, cov
        a = a @ passed[:, :3]
        if np.abs(cov - before).max() <= 1e-14 * np.abs(cov).max():
            break
    return cov
