"""Linear model of the estimation error along a run, on which a Kalman filter costs microseconds a sample.

Along a run of an observer, with the estimate x̂ after each sample, the true state is `x = x̂ ⊕ δ` with

    δ⁺ = F δ + c + G f + w,   r = Hδ + e,

where `x̂ ⊕ δ` moves along the retraction, c is the model's prediction minus the next estimate, F its derivative, and r
the reading minus the estimated position. f is a force that the model does not know, a random walk or a Gauss–Markov
process; w is white acceleration, e the noise of a reading. F, G, c and r do not depend on the noise: one run of the
model serves for all noises, and the filter of this system is the extended Kalman filter to first order in the error of
the run.

Source: Schweppe 1965, Evaluation of likelihood functions for Gaussian signals, IEEE TIT 11(1); Anderson & Moore 1979,
Optimal Filtering, section 10.1, for the likelihood. Huber 1981, section 7.7, for the weight of an outlier.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from covariant._gauss_markov import gauss_markov
from covariant._typing import Flag, Scalar, Vector
from covariant.calibration.identification._windows import LONGEST_GAP
from covariant.models import MechanicalSystem, Motion, advance

CREDIBLE = 5.0
"""Standard deviations beyond which an innovation is an outlier: it corrects no more than one of this size."""
VAGUE = 100.0
"""Standard deviations before anything is measured, of a filter that must know nothing, in usual ones."""


class NoiseLevels(NamedTuple):
    """Noise of sensor and model that a Kalman filter assumes.

    Attributes:
        acceleration: Square root of the spectral density of the white acceleration noise, in every coordinate
            [rad/s² √s, or m/s² √s].
        measurement: Standard deviation (n,) of one reading [rad or m].
        force: Standard deviation of the change of an unknown force in one second [N or N m], one for all components or
            one for each (n,); 0 for no such force. With a `force_time` it is that of the force itself.
        force_time: Time constant [s] after which the force is forgotten; infinite for a random walk, by default.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.calibration.identification import NoiseLevels
        >>> NoiseLevels(jnp.array(0.07), jnp.array([1e-3, 1e-3]), jnp.array(0.0)).measurement.tolist()
        [0.001, 0.001]
    """

    acceleration: Scalar
    measurement: Vector
    force: Scalar | Vector
    force_time: Scalar | float = jnp.inf


class ErrorModel(NamedTuple):
    """Linear system of the errors along a run of T rows.

    Attributes:
        transition: F (T, 2n, 2n) of the step to each row.
        defect: c (T, 2n) of the step to each row.
        input_matrix: Acceleration (T, n, n) per unit of the unknown force.
        residual: r (T, n), zero where nothing was measured.
        present: Whether each number (T, n) was measured.
        dt: Length (T,) of the step to each row [s].
        fresh: Rows (T,) at which the filter restarts.
    """

    transition: Float[Array, "T n2 n2"]
    defect: Float[Array, "T n2"]
    input_matrix: Float[Array, "T n n"]
    residual: Float[Array, "T n"]
    present: Bool[Array, "T n"]
    dt: Float[Array, "T"]
    fresh: Bool[Array, "T"]


class Filtered(NamedTuple):
    """Result of the Kalman filter at each row.

    Attributes:
        loss: Twice the negative log-likelihood (T, n) of each number, without the constant.
        innovation: Innovations (T, n), each given those before it in the row, so that they are independent.
        spread: Their standard deviations (T, n).
        error: Estimate (T, 2n) of δ after the row.
        gain: Means (T, 2) of the diagonals of the gains from a reading to position [1] and velocity [1/s], which are
            the same in all frames.
        velocity_std: Standard deviations (T, n) of the velocity after the row.
    """

    loss: Float[Array, "T n"]
    innovation: Float[Array, "T n"]
    spread: Float[Array, "T n"]
    error: Float[Array, "T n2"]
    gain: Float[Array, "T 2"]
    velocity_std: Float[Array, "T n"]


@eqx.filter_jit
def error_model(
    model: MechanicalSystem, q: Array, v: Float[Array, "T n"], t: Array, u: Array, y: Array, steps: int
) -> ErrorModel:
    """Linearise the model along the estimates of a run, by forward differentiation of each step.

    After a step longer than `LONGEST_GAP` usual ones, or one that is not finite, the error model restarts.
    """
    manifold, n = model.manifold, v.shape[1]
    dt = jnp.diff(t)

    def step(t, q, v, u, h, next_q, next_v):
        def ahead(error):
            start = Motion(manifold.retract(q, error[:n]), v + error[n:])
            end = advance(model, t, start, u, h, steps)
            return jnp.concatenate([manifold.local(next_q, end.q), end.v - next_v])

        nothing = jnp.zeros(2 * n, v.dtype)
        slope, defect = jax.jacfwd(lambda error: (ahead(error),) * 2, has_aux=True)(nothing)
        input_matrix = jax.vmap(model.space.raise_, (None, 0))(q, jnp.eye(n, dtype=v.dtype)).T
        return slope, defect, input_matrix

    linear = jax.vmap(step)(t[:-1], q[:-1], v[:-1], u[:-1], dt, q[1:], v[1:])
    # After an invalid step the filter restarts and its numbers are not used: zero is as good as any, and finite.
    valid = jnp.all(jnp.isfinite(linear[0]), axis=(1, 2)) & (dt <= LONGEST_GAP * jnp.median(dt))
    linear = [jnp.where(valid.reshape(-1, *[1] * (each.ndim - 1)), each, 0.0) for each in linear]
    transition, defect, input_matrix = (jnp.concatenate([jnp.zeros_like(each[:1]), each]) for each in linear)
    present = ~jax.vmap(manifold.missing)(y)
    residual = jnp.where(present, jax.vmap(manifold.towards)(q, y), 0.0)
    zero, fresh = jnp.zeros_like(dt[:1]), jnp.ones(1, bool)
    return ErrorModel(
        transition,
        defect,
        input_matrix,
        residual,
        present,
        jnp.concatenate([zero, dt]),
        jnp.concatenate([fresh, ~valid]),
    )


class _Past(NamedTuple):
    """What a smoother needs of a row: the transition (3n, 3n) to it, state and covariance after it, and for each number
    the gain (n, 3n), the innovation and its variance (n,), in the order of the corrections."""

    transition: Array
    x: Array
    cov: Array
    gain: Array
    innovation: Array
    variance: Array


def kalman(errors: ErrorModel, noise: NoiseLevels, speed: Scalar | float) -> Filtered:
    """Run the Kalman filter on the linear error model; `speed` is the std of velocities at the start and restarts."""
    start, step = _recursion(errors, noise, speed)

    def row(state, now):
        after, result, _ = step(state, now)
        return after, result

    return jax.lax.scan(row, start, errors)[1]


def smoothed(errors: ErrorModel, noise: NoiseLevels, speed: Scalar | float) -> Float[Array, "T n3"]:
    """Estimate the errors and the unknown force at each row from all rows, by the smoother that belongs to `kalman`.

    Of the smoothed velocity v_s, the mean given all readings, `E(v̂ − v)² = E(v̂ − v_s)² + E(v_s − v)²` for any estimate
    v̂ from these readings: with the right noise the distance to it orders estimates as their errors do.

    Source: Bierman 1973, Fixed interval smoothing with discrete measurements, International Journal of Control 18(1),
    which inverts no covariance.
    """
    n = errors.residual.shape[1]
    start, step = _recursion(errors, noise, speed)

    def forwards(state, now):
        after, _, past = step(state, now)
        return after, past

    def backwards(adjoint, row):
        past, present, fresh = row
        estimate = past.x - past.cov @ adjoint
        for i in reversed(range(n)):
            # λ ← (I − K H)ᵀ λ − Hᵀ e/S of each correction, the last one first.
            change = adjoint @ past.gain[i] + past.innovation[i] / past.variance[i]
            adjoint = adjoint.at[i].add(jnp.where(present[i], -change, 0.0))
        return jnp.where(fresh, 0.0, past.transition.T @ adjoint), estimate

    pasts = jax.lax.scan(forwards, start, errors)[1]
    rows = pasts, errors.present, errors.fresh
    return jax.lax.scan(backwards, jnp.zeros(3 * n), rows, reverse=True)[1]


def from_later(
    errors: ErrorModel, noise: NoiseLevels, speed: Scalar | float
) -> tuple[Float[Array, "T n2"], Float[Array, "T n"]]:
    """Estimate the errors at each row from the rows after it only, by the Kalman filter in reversed time.

    The second result are the standard deviations of the velocities.

    It knows nothing before the last row. Given the state x at a row, so also the force, the rows before and after it
    are independent, and the mean of this estimate v_l is v. An estimate v̂ from the rows before thus has
    `E(v̂ − v_l)² = E(v̂ − v)² + E(v_l − v)²`, whatever the sizes of the noise: the distance to v_l orders estimates as
    their errors do. Of predictions over single times this does not hold: after a time h the error is
    `ξ + hζ + h²/2 a`, where a lasting acceleration a that the model lacks has the sign of the lag ζ that it causes, so
    that too fast an estimate predicts best. Here all times after a row count, and a is estimated from them too.

    Source: Fraser & Potter 1969, The optimum linear smoother as a combination of two optimum linear filters, IEEE TAC
    14(4), for the filter in reversed time.
    """
    # Without LAPACK's inverse of each step the reversed filter would have to be compiled with solves of every size.
    steps = np.where(np.asarray(errors.fresh)[:, None, None], np.eye(errors.defect.shape[1]), errors.transition)
    return _from_later(errors, jnp.asarray(np.linalg.inv(steps)), noise, speed)


@eqx.filter_jit
def _from_later(errors: ErrorModel, inverse: Array, noise: NoiseLevels, speed: Scalar | float) -> Any:
    n, variance = errors.residual.shape[1], noise.measurement**2
    # Nothing is known: positions and velocities far beyond their size, and a force far beyond its own.
    first = VAGUE**2 * _first(noise, speed, n)
    later = jax.tree.map(lambda column: jnp.roll(column, -1, axis=0), (errors, inverse))

    def step(state, rows):
        row, (then, back), last = rows
        x: Any
        whole, defect, added = _transition(then, noise)
        push, decay = whole[: 2 * n, 2 * n :], whole[2 * n :, 2 * n :]
        remains = jnp.diag(1 / jnp.diag(decay))
        back = jnp.block([[back, -back @ push @ remains], [jnp.zeros((n, 2 * n)), remains]])
        x = jnp.where(last, 0.0, back @ (state[0] - defect))
        cov = jnp.where(last, first, _symmetric(back @ (state[1] + added) @ back.T))
        estimate = x[: 2 * n], jnp.sqrt(jnp.diag(cov)[n : 2 * n])
        for i in range(n):
            x, cov, _ = _reading(x, cov, i, row.residual[i], variance[i], row.present[i])
        return (x, cov), estimate

    rows = errors, later, later[0].fresh.at[-1].set(True)
    return jax.lax.scan(step, (jnp.zeros(3 * n), first), rows, reverse=True)[1]


def _recursion(errors: ErrorModel, noise: NoiseLevels, speed: Scalar | float):
    """The start of the filter, and its step `(state, row) -> (state, Filtered, _Past)`."""
    n = errors.residual.shape[1]
    variance = noise.measurement**2
    first = _first(noise, speed, n)

    def step(state, row):
        x, cov = state
        whole, defect, added = _transition(row, noise)
        x = whole @ x + defect
        cov = _symmetric(whole @ cov @ whole.T + added)
        current: Any = jnp.where(row.fresh, 0.0, x), jnp.where(row.fresh, first, cov)
        corrections: list[Any] = []
        for i in range(n):  # their noise is independent, so they correct one after the other
            *current, correction = _reading(current[0], current[1], i, row.residual[i], variance[i], row.present[i])
            corrections.append(correction)
        loss, innovation, std, gains, used = (jnp.stack(each) for each in zip(*corrections, strict=True))
        x, cov = current
        # K = P Hᵀ R⁻¹ with the covariance P after the correction.
        gain = jnp.stack([jnp.mean(jnp.diag(cov[at : at + n, :n]) / variance) for at in (0, n)])
        velocity_std = jnp.sqrt(jnp.diag(cov)[n : 2 * n])
        result = Filtered(loss, innovation, std, x[: 2 * n], gain, velocity_std)
        return tuple(current), result, _Past(whole, x, cov, gains, innovation, used)

    return (jnp.zeros(3 * n), first), step


def _symmetric(cov: Array) -> Array:
    """The symmetric part: rounding would otherwise grow, since a correction uses the columns of a covariance only."""
    return (cov + cov.T) / 2


def _first(noise: NoiseLevels, speed: Scalar | float, n: int) -> Float[Array, "n3 n3"]:
    """Covariance of the errors and the force before any measurement.

    A random walk then has its variance of one second, and a force with a time its usual one.
    """
    force = jnp.broadcast_to(jnp.asarray(noise.force) ** 2, n)
    return jnp.diag(jnp.concatenate([noise.measurement**2, jnp.full(n, speed**2), force]))


def _transition(row: ErrorModel, noise: NoiseLevels) -> tuple[Array, Array, Array]:
    """Transition (3n, 3n) of errors and force to a row, its defect (3n,), and the covariance that it adds."""
    n = row.residual.shape[0]
    # The force is constant over a step, at its mean.
    mean, decay, added = forgotten(row.dt, noise.force_time)
    push = mean * jnp.concatenate([row.dt**2 / 2 * row.input_matrix, row.dt * row.input_matrix])
    whole = jnp.block([[row.transition, push], [jnp.zeros((n, 2 * n)), decay * jnp.eye(n)]])
    force = added * jnp.broadcast_to(jnp.asarray(noise.force) ** 2, n)
    walk = jnp.zeros((3 * n, 3 * n)).at[2 * n :, 2 * n :].set(jnp.diag(force))
    return whole, jnp.concatenate([row.defect, jnp.zeros(n)]), walk + _white(noise.acceleration, row.dt, n)


def forgotten(dt: Scalar, time: Scalar | float) -> tuple[Scalar, Scalar, Scalar]:
    """How a force changes in a step [s], with a time constant [s] that is infinite for a random walk.

    Its mean over the step and its value at the end, as fractions of the value before, `(1 − e)/(dt/τ)` and
    `e = exp(−dt/τ)`; and the variance that is added, as a fraction of that in the long run, `1 − e²`, or for a walk of
    that in one second, dt. As in `observers.SlowVariables`.
    """
    steps = dt / time
    mean, end, added = gauss_markov(steps)
    return mean, end, jnp.where(steps > 0, added, dt)


def _white(acceleration: Scalar, dt: Scalar, n: int) -> Float[Array, "m m"]:
    """Covariance (3n, 3n) that white acceleration adds to position, velocity and force in a step."""
    # The integral of [s, 1]ᵀ [s, 1] over the step, times the spectral density.
    block = acceleration**2 * jnp.stack([jnp.stack([dt**3 / 3, dt**2 / 2]), jnp.stack([dt**2 / 2, dt])])
    return jnp.zeros((3 * n, 3 * n)).at[: 2 * n, : 2 * n].set(jnp.kron(block, jnp.eye(n)))


def _reading(x: Vector, cov: Array, i: int, residual: Scalar, variance: Scalar, present: Flag):
    """Correct the state by one number; beyond `CREDIBLE` deviations its noise is that of an outlier of its size."""
    innovation, total_variance = residual - x[i], cov[i, i] + variance
    square = innovation**2 / total_variance
    limit = CREDIBLE**2
    # With the noise enlarged so, the corrected innovation has exactly `CREDIBLE` deviations.
    inflation = jnp.maximum(square / limit, 1.0)
    gain = jnp.where(present, cov[:, i] / (total_variance * inflation), 0.0)
    # Joseph's form (I − KH) P (I − KH)ᵀ + K R Kᵀ, in which R is the enlarged variance of an outlier, multiplied out.
    cov = cov - total_variance * inflation * jnp.outer(gain, gain)
    # Beyond the limit the square grows as its logarithm only, continuously with its slope.
    loss = jnp.log(total_variance) + jnp.where(square > limit, limit * (1 + jnp.log(inflation)), square)
    results = (jnp.where(present, each, 0.0) for each in (loss, innovation, jnp.sqrt(total_variance)))
    return x + gain * innovation, cov, (*results, gain, total_variance * inflation)
