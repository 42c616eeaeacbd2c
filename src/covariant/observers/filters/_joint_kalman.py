"""Kalman filter for each coordinate separately, without a model: the acceleration is Singer's coloured noise.

    q' = v,   v' = a,   a' = −a/τ + w,   w white of the density 2σ²/τ:

In the long run, a has the standard deviation σ and the correlation time τ. For dt much shorter than τ this is white
jerk. Over a gap the acceleration decays, while white jerk would let it grow without bound. For such a motion, no linear
filter has a smaller error. In units of σ and τ its only parameters are `θ = dt/τ` and the noise `s/στ²` of a sample.

Source: Singer 1970, Estimating optimal tracking filter performance for manned maneuvering targets, IEEE TAES 6(4);
Bar-Shalom, Li & Kirubarajan 2001, Estimation with Applications to Tracking and Navigation, chapter 6.
"""

import functools
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from covariant._linalg import semidefinite_root, triangular
from covariant._typing import Code, Matrix, Number, Scalar, Vector
from covariant.geometry import AbstractManifold, Coordinates, wrap
from covariant.observers.base import (
    Gate,
    GateMemory,
    Judged,
    Velocity,
    as_gain,
    check_positive,
    isotropic,
    outcome,
    updated,
)
from covariant.observers.differentiators import AbstractLinearFilter, response
from covariant.observers.filters._gated_filter import AbstractGatedFilter, Expectation, Moved, Used


class JointState(NamedTuple):
    """State of a `JointKalman`: the estimate, a square root of its covariance, and the memory of the gate.

    Attributes:
        q: Position (n,) [rad or m].
        v: Velocity (n,) [rad/s or m/s].
        a: Acceleration (n,) [rad/s² or m/s²].
        root: Square root (n, 3, 3) of the covariance of position, velocity and acceleration of each coordinate, in
            units of στ², στ and σ.
        gate: Memory of the gate.

    Example:
        >>> import numpy as np
        >>> from covariant import observers
        >>> kalman = observers.JointKalman(motion_std=2.0, motion_time=1.0, measurement_std=1e-2)
        >>> kalman.init(np.array([0.1])).root.round(6).tolist()
        [[[0.005, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]]
    """

    q: Vector
    v: Vector
    a: Vector
    root: Float[Array, "n 3 3"]
    gate: GateMemory


class JointInfo(NamedTuple):
    """Diagnostics of a step of a `JointKalman`.

    Attributes:
        innovation: Measured minus extrapolated position (n,), 0 where it is missing.
        nis: Normalised innovation squared: the sum of the squared innovations over their predicted variances.
        velocity_std: Standard deviations (n,) of the velocity after the correction.
        result: A `covariant.signals.StepCode` code.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, observers
        >>> kalman = observers.JointKalman(motion_std=1.0, motion_time=1.0, measurement_std=1e-2)
        >>> record = Record(np.array([0.0, 0.1]), y=np.array([[0.0], [0.1]]))
        >>> run = observers.run(kalman, record)
        >>> run.info.innovation[1].tolist(), round(run.info.nis[1].item(), 2)  # the first velocity has the variance 1
        ([0.1], 0.98)
    """

    innovation: Vector
    nis: Scalar
    velocity_std: Vector
    result: Code


class JointKalman(AbstractGatedFilter, AbstractLinearFilter):
    """Kalman filter of each coordinate with Singer's acceleration, exact at irregular stamps.

    At the start the velocity is zero with the standard deviation στ, and the acceleration zero with σ.

    Use it if there is no model, but the size and the duration of usual accelerations are known: it is the best linear
    filter for these. It needs a matrix for each coordinate, while `PLL` needs two numbers.

    Attributes:
        motion_std: Standard deviation σ of the accelerations [rad/s² or m/s²].
        motion_time: Correlation time τ of the accelerations [s].
        measurement_std: Standard deviation s of the noise of one sample [rad or m].
        circles: Indices of the coordinates that are angles on a full circle, which are followed modulo a turn; none by
            default.
        gate: Gate that refuses outliers; None refuses nothing. See `Gate`.

    Raises:
        ValueError: A standard deviation or the correlation time is not positive and finite.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, observers
        >>> t = np.linspace(0.0, 2.0, 201)
        >>> kalman = observers.JointKalman(motion_std=1.0, motion_time=1.0, measurement_std=1e-4)
        >>> run = observers.run(kalman, Record(t, y=np.sin(t)[:, None]))
        >>> bool(np.allclose(run.estimate[-1], [np.sin(2.0), np.cos(2.0)], atol=1e-2))
        True
    """

    motion_std: Scalar = eqx.field(converter=as_gain)
    motion_time: Scalar = eqx.field(converter=as_gain)
    measurement_std: Scalar = eqx.field(converter=as_gain)
    circles: tuple[int, ...] = eqx.field(default=(), static=True)
    gate: Gate | None = Gate()

    def __check_init__(self):
        parameters = {"motion_std": self.motion_std, "motion_time": self.motion_time}
        check_positive("JointKalman", **parameters, measurement_std=self.measurement_std)

    @property
    def noise(self) -> Scalar:
        """Standard deviation of the noise of one sample in units of στ², `s/στ²`."""
        return self.measurement_std / (self.motion_std * self.motion_time**2)

    def init(self, y: Vector, t: Number = 0.0) -> JointState:
        """State at the start: at the measured positions, with zero velocity and acceleration.

        Args:
            y: Measured positions (n,) [rad or m].
            t: Time [s], without influence.

        Returns:
            The state, with the standard deviations s, στ and σ of position, velocity and acceleration.
        """
        rest = jnp.zeros_like(y)
        root = self._first_root(isotropic(self.motion_std * self.motion_time, y))
        return JointState(y, rest, rest, root, GateMemory.at_start(y))

    def estimate(self, state: JointState) -> Float[Array, "two_n"]:
        return jnp.concatenate([state.q, state.v])

    @property
    def _units(self) -> Float[Array, "3"]:
        """Units of position, velocity and acceleration, divided by σ: τ² [s²], τ [s] and 1."""
        time = jnp.asarray(self.motion_time)
        return jnp.stack([time**2, time, jnp.ones_like(time)])

    def _predicted(
        self, state: JointState, u: Float[Array, "m"], dt: Scalar, carry: bool
    ) -> tuple[JointState, Float[Array, "three_n three_n"] | None]:
        step, added = singer(dt / self.motion_time)
        units = self._units.astype(state.q.dtype)[:, None]
        q, v, a = units * (step @ (jnp.stack([state.q, state.v, state.a]) / units))
        noise = semidefinite_root(added)  # the covariance is nearly singular for a small θ
        root = jax.vmap(lambda each: triangular(jnp.concatenate([step @ each, noise], axis=1)))(state.root)
        new = state._replace(q=q, v=v, a=a, root=root, gate=state.gate.advanced(dt))
        return new, self._together(step @ state.root) if carry else None

    @property
    def _manifold(self) -> AbstractManifold:
        return Coordinates()

    def _expected(self, state: JointState, u: Float[Array, "m"], y: Vector) -> Expectation:
        present = ~jnp.isnan(y)
        innovation = wrap(self.circles, jnp.where(present, y - state.q, 0.0))
        unit = self._units[0].astype(y.dtype)
        # The root is in units of στ², so variances are in units of σ²τ⁴.
        cov = jnp.diag(jnp.sum(state.root[:, 0] ** 2, axis=1) + self.noise**2) * unit**2 * self.motion_std**2
        noise = self.measurement_std**2 * jnp.eye(len(y), dtype=y.dtype)
        return Expectation(y, innovation, cov, noise, present)

    def _velocity(self, state: JointState) -> Velocity:
        return Velocity(state.v, jnp.diag(self._velocity_std(state.root) ** 2))

    def _usual_velocity(self, state: JointState) -> Matrix:
        return isotropic(self.motion_std * self.motion_time, state.v)

    def _used(self, state: JointState, y: Vector, expected: Expectation, used: Bool[Array, "n"]) -> Used:
        noise = jnp.full((1, 1), self.noise**2)
        gain, root = jax.vmap(updated, (0, 0, None, 0))(state.root, state.root[:, :1], noise, used[:, None])
        units = self._units.astype(y.dtype)
        error = (units / units[0])[:, None] * gain[..., 0].T * expected.innovation[None]
        new, reset = self.moved(state, error.reshape(-1))
        return Used(new._replace(root=root), error.reshape(-1), reset)

    def moved(self, state: JointState, error: Float[Array, "three_n"]) -> Moved:
        q, v, a = jnp.split(error, 3)
        new = state._replace(q=state.q + q, v=state.v + v, a=state.a + a)
        return Moved(new, jnp.eye(len(error), dtype=error.dtype))

    def root(self, state: JointState) -> Float[Array, "three_n three_n"]:
        return self._together(state.root)

    def with_root(self, state: JointState, root: Float[Array, "three_n three_n"]) -> JointState:
        n, units = len(state.q), self.motion_std * self._units.astype(root.dtype)
        # Joints are independent, so the blocks between them are zero.
        apart = jax.vmap(lambda i: root.reshape(3, n, 3, n)[:, i, :, i])(jnp.arange(n))
        return state._replace(root=apart / units[None, :, None])

    def _together(self, root: Float[Array, "n 3 3"]) -> Float[Array, "three_n three_n"]:
        """Square root of the covariance of all positions, velocities and accelerations, in their units."""
        n, units = len(root), self.motion_std * self._units.astype(root.dtype)
        blocks = jnp.einsum("c,icd,ij->cidj", units, root, jnp.eye(n, dtype=root.dtype))
        return blocks.reshape(3 * n, 3 * n)

    def deviations(self, state: JointState) -> dict[str, Vector]:
        return {"velocity_std": self._velocity_std(state.root)}

    def _started_anew(
        self, state: JointState, corrected: JointState, y: Vector, expected: Expectation, velocity: Velocity
    ) -> JointState:
        # Coordinates that are not measured stay as predicted, since every coordinate has its own filter.
        root = jnp.where(expected.present[:, None, None], self._first_root(velocity.cov), state.root)
        return corrected._replace(q=state.q + expected.innovation, v=velocity.mean, a=state.a, root=root)

    def _result(self, state: JointState, new: JointState, y: Vector, expected: Expectation, verdict: Judged) -> Code:
        return verdict.result(outcome(new.q, new.v, y))

    def _info(self, state: JointState, new: JointState, expected: Expectation, result: Code) -> JointInfo:
        nis = jnp.sum(expected.innovation**2 / jnp.diag(expected.cov))
        return JointInfo(expected.innovation, nis, **self.deviations(new), result=result)

    def _velocity_std(self, root: Float[Array, "n 3 3"]) -> Vector:
        unit = self._units[1].astype(root.dtype)
        return self.motion_std * unit * jnp.sqrt(jnp.sum(root[:, 1] ** 2, axis=1))

    def _first_root(self, velocity_cov: Matrix) -> Float[Array, "n 3 3"]:
        velocity = jnp.sqrt(jnp.diag(velocity_cov)) / (self.motion_std * self.motion_time)
        one = jnp.ones_like(velocity)
        return jax.vmap(jnp.diag)(jnp.stack([self.noise * one, velocity, one], axis=1))

    def weights(self, rate: float) -> Float[np.ndarray, "k"]:
        """Weights of the measured positions in the velocity, with the stationary gain.

        Args:
            rate: Rate of even sampling [Hz].

        Returns:
            Weights (k,) [1/s], newest first.
        """
        time, noise = float(self.motion_time), float(self.noise)
        step, added = map(np.asarray, jax.jit(singer)(1 / (rate * time)))
        cov = _stationary(step, added, noise**2)
        gain = cov[:, 0] / (cov[0, 0] + noise**2)
        return response(step, gain) / time  # converts from velocities in στ and positions in στ²


TERMS = 25
"""Terms of the series for θ ≤ 1: the next is below 1e-17."""

_POSITION = [(-1) ** k / math.factorial(k) for k in range(2, TERMS)]
_VELOCITY_SQUARE = [(-1) ** k * (2**k - 2) / math.factorial(k) / (k + 1) for k in range(2, TERMS)]
_POSITION_SQUARE = [(-1) ** k * (2**k - 2 - 2 * k) / math.factorial(k) / (k + 1) for k in range(4, TERMS)]


def singer(theta: Scalar) -> tuple[Matrix, Matrix]:
    """Transition and noise of Singer's model over one step, in units of στ², στ and σ.

    An acceleration of 1 changes the velocity by `f(x) = 1 − e⁻ˣ` and the position by `g(x) = x − f(x)` in the time x;
    the covariance is twice the integral of the products of g, f and e⁻ˣ from 0 to θ, where `g' = f`, `f' = e⁻ˣ`.
    """
    large = theta > 1
    small = jnp.where(large, 1.0, theta)  # for small θ the closed forms would be differences of nearly equal numbers
    decay, f = jnp.exp(-theta), -jnp.expm1(-theta)
    g = jnp.where(large, theta - f, small**2 * _series(_POSITION, small))
    # Integration by parts: ∫f² = g − f²/2, 2∫gf = g², 2∫f e⁻ˣ = f² and ∫g e⁻ˣ = fg − ∫f².
    ff = jnp.where(large, g - f**2 / 2, small**3 * _series(_VELOCITY_SQUARE, small))  # ∫f²
    gg = theta**3 / 3 - theta**2 + 2 * (1 - (1 + theta) * decay) + ff
    gg = jnp.where(large, gg, small**5 * _series(_POSITION_SQUARE, small))  # ∫g²
    zero, one = jnp.zeros_like(theta), jnp.ones_like(theta)
    step = [[one, theta, g], [zero, one, f], [zero, zero, decay]]
    added = [[2 * gg, g**2, 2 * (f * g - ff)], [g**2, 2 * ff, f**2], [2 * (f * g - ff), f**2, -jnp.expm1(-2 * theta)]]
    return jnp.stack([jnp.stack(row) for row in step]), jnp.stack([jnp.stack(row) for row in added])


def _series(coefficients: list[float], x: Scalar) -> Scalar:
    return functools.reduce(lambda total, coefficient: total * x + coefficient, coefficients[::-1], jnp.zeros_like(x))


def _stationary(step: np.ndarray, added: np.ndarray, noise: float) -> np.ndarray:
    """Stationary covariance (3, 3) before a measurement of the first component, with the variance `noise`.

    It doubles the number of samples in each pass (Anderson & Moore 1979, Optimal Filtering, section 6.7).
    """
    a, cov = step.T, added
    information = np.zeros_like(cov)
    information[0, 0] = 1 / noise
    # After k passes 2ᵏ samples are included; 60 passes suffice for any filter with a finite memory.
    for _ in range(60):
        solved = np.linalg.solve(np.eye(3) + information @ cov, np.concatenate([a, information], axis=1))
        increment = a.T @ cov @ solved[:, :3]
        information = information + a @ solved[:, 3:] @ a.T
        cov, previous = cov + increment, cov
        a = a @ solved[:, :3]
        # The doubling converges quadratically, so changes below this are rounding.
        if np.abs(cov - previous).max() <= 1e-14 * np.abs(cov).max():
            break
    return cov
