"""Linear model of the estimation error along a run, on which a Kalman filter costs microseconds a sample.

Along a run of an observer, with the estimate x̂ after each sample, the true state is `x = x̂ ⊕ δ` with

    δ⁺ = F δ + c + C ζ + G f + w,   r = Hδ + e,

where δ are positions and velocities along the retraction, followed by numbers of the model that walk, as the current in
which a ship sails, in units of ζ; or the states of a `StateSpace` in their usual sizes. c is
the model's prediction minus the next estimate, F and C its derivatives in the state and in unknown numbers of the
model, and r the reading minus the estimated one. f is a force that the model does not know, or an unknown rate of each
state, a random walk or a Gauss–Markov process; w is white acceleration, e the noise of a reading. F, C, G, c and r do
not depend on the noise: one run of the model serves for all noises, and the filter of this system is the extended
Kalman filter to first order in the error of the run. Any motion near the readings will do for the run: no step of the
model follows another, so that a model that is unstable or wrong is linearised as well as a good one.

Source: Schweppe 1965, Evaluation of likelihood functions for Gaussian signals, IEEE TIT 11(1); Anderson & Moore 1979,
Optimal Filtering, section 10.1, for the likelihood. Huber 1981, section 7.7, for the weight of an outlier.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from covariant._gauss_markov import gauss_markov
from covariant._typing import Flag, Scalar, Vector
from covariant.calibration.identification._predict import lagged
from covariant.calibration.identification._rows import Rows
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
        wiggle: Standard deviation (n,) of what readings are off together, as those of a joint on an elastic belt or of
            an encoder off its centre [rad or m]; 0 for none, by default.
        wiggle_time: Time constant [s] after which that is forgotten.

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
    wiggle: Scalar | Vector | float = 0.0
    wiggle_time: Scalar | float = jnp.inf


class Walk(NamedTuple):
    """A number of the model that changes along a log: which it is, its standard deviation where a stretch begins, and
    that of its change in a second, both relative."""

    number: int
    first: float
    drift: float


class ErrorModel(NamedTuple):
    """Linear system of the errors along a run of T rows.

    Attributes:
        transition: F (T, N, N) of the step to each row, N = 2n + k for a mechanical system with k numbers that walk.
        defect: c (T, N) of the step to each row.
        slopes: C (T, N, p) of the step to each row, for p unknown numbers.
        input_matrix: Rate (T, N, d) of the errors per unit of the unknown force, at the beginning of the step.
        driven: Errors (T, N) whose rates the force and white noise change; of the others readings tell where a stretch
            begins, or `first`.
        first: Standard deviations (T, N) where a stretch begins, of numbers that walk; else 0.
        walk: Square root (T, N) of the variance that these gain in a second; else 0.
        shows: H (T, n, N).
        shown_slopes: Derivatives (T, n, p) of what a reading shows in the unknown numbers, at the same state.
        residual: r (T, n), zero where nothing was measured.
        present: Whether each number (T, n) was measured.
        dt: Length (T,) of the step to each row [s].
        fresh: Rows (T,) at which the filter restarts.
    """

    transition: Float[Array, "T N N"]
    defect: Float[Array, "T N"]
    slopes: Float[Array, "T N p"]
    input_matrix: Float[Array, "T N d"]
    driven: Bool[Array, "T N"]
    first: Float[Array, "T N"]
    walk: Float[Array, "T N"]
    shows: Float[Array, "T n N"]
    shown_slopes: Float[Array, "T n p"]
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
        error: Estimate (T, N) of δ after the row.
        gain: Means (T, 2) of the diagonals of the gains from a reading to position [1] and velocity [1/s] of a
            mechanical system, which are the same in all frames.
        velocity_std: Standard deviations (T, n) of its velocity after the row.
        slope: Derivatives (T, n, p) of the innovations in the unknown numbers, with the gains as they are.
    """

    loss: Float[Array, "T n"]
    innovation: Float[Array, "T n"]
    spread: Float[Array, "T n"]
    error: Float[Array, "T N"]
    gain: Float[Array, "T 2"]
    velocity_std: Float[Array, "T n"]
    slope: Float[Array, "T n p"]


@eqx.filter_jit
def error_model(unknowns: Any, z: Array, run: Motion, rows: Rows, steps: Any) -> ErrorModel:
    """Linearise a model along a run, by forward differentiation of each step, in the state and in its unknown numbers.

    After a row at which a stretch begins, or a step that is not finite, the error model restarts.
    """
    n, p = run.v.shape[1], z.shape[0]
    t, u, change = jnp.asarray(rows.t), *acting(unknowns, z, rows)
    dt, machine = jnp.diff(t), jnp.asarray(rows.machine)[jnp.asarray(rows.block)]
    # Across the border of two stretches nothing is used: a step of no time is finite.
    dt = jnp.where(jnp.asarray(rows.fresh)[1:], 0.0, dt)
    several = len(unknowns.parts) > 1
    manifold = unknowns.manifold

    def step(t, now, u, change, machine, h, then):
        own, own_z, part = unknowns.of_machine(machine if several else 0, z)

        def ahead(x):
            model = own.make(own.values(own_z + x[2 * n :]))[0]
            start = Motion(manifold.retract(now.q, x[:n]), now.v + x[n : 2 * n])
            end = advance(model, t, start, u + change @ x[2 * n :], h, steps)
            return (jnp.concatenate([manifold.local(then.q, end.q), end.v - then.v]),) * 2

        slope, defect = jax.jacfwd(ahead, has_aux=True)(jnp.zeros(2 * n + change.shape[-1], now.v.dtype))
        pushes = input_matrix(own.make(own.values(own_z))[0], now.q)
        whose = jnp.zeros((2 * n, p), now.v.dtype).at[:, part].set(slope[:, 2 * n :])
        return slope[:, : 2 * n], defect, whose, pushes

    now, then = (jax.tree.map(lambda part, cut=cut: part[cut], run) for cut in (slice(-1), slice(1, None)))
    linear = jax.vmap(step)(t[:-1], now, u[:-1], change[:-1], machine[1:], dt, then)
    return of_motion(manifold, linear, dt, run, rows, unknowns.walks)


def of_motion(manifold: Any, linear: Any, dt: Array, run: Motion, rows: Rows, walks: Any = ()) -> ErrorModel:
    """The error model of a motion, of transitions, defects, slopes and accelerations per unit of a force, (T − 1, n,
    n), of the steps after each row but the last; with the `Walk` of numbers that change along it."""
    n, k = run.v.shape[1], len(walks)
    transition, defect, slopes, pushes = linear
    y = jnp.asarray(rows.y)
    read = jax.vmap(manifold.towards)(run.q, y), ~jax.vmap(manifold.missing)(y)
    shows = jnp.broadcast_to(jnp.eye(n, 2 * n + k), (len(y), n, 2 * n + k)), jnp.zeros((len(y), n, slopes.shape[2]))
    # A step changes the errors by a number that walks as by one that is unknown, and leaves the number.
    changes = slopes[:, :, jnp.array([walk.number for walk in walks], int)]
    transition = jnp.pad(transition, ((0, 0), (0, k), (0, k))).at[:, : 2 * n, 2 * n :].set(changes)
    transition = transition.at[:, 2 * n :, 2 * n :].set(jnp.eye(k))
    defect, slopes = (jnp.pad(each, [(0, 0), (0, k), (0, 0)][: each.ndim]) for each in (defect, slopes))
    pushes = jnp.pad(pushes, ((0, 0), (n, k), (0, 0)))
    sizes = jnp.zeros((2, 2 * n + k)).at[:, 2 * n :].set(jnp.array([walk[1:] for walk in walks]).reshape(k, 2).T)
    errors = jnp.arange(2 * n + k)
    processes = ((errors >= n) & (errors < 2 * n), *sizes)
    return assembled((transition, defect, slopes, pushes), dt, rows, processes, *shows, *read)


def assembled(linear: Any, dt: Array, rows: Rows, processes: tuple[Array, ...], *read: Array) -> ErrorModel:
    """The error model of transitions, defects, slopes and input matrices of the steps after each row but the last.

    `processes` are, of each error (N,), whether it is driven, and deviations `first` and `walk`; `read` is what
    readings show, its slopes, the residual, and whether each number is present.
    """
    # After an invalid step the filter restarts and its numbers are not used: zero is as good as any, and finite.
    valid = jnp.all(jnp.isfinite(linear[0]), axis=(1, 2)) & ~jnp.asarray(rows.fresh)[1:]
    linear = [jnp.where(valid.reshape(-1, *[1] * (each.ndim - 1)), each, 0.0) for each in linear]
    linear = [jnp.concatenate([jnp.zeros_like(each[:1]), each]) for each in linear]
    zero, fresh = jnp.zeros_like(dt[:1]), jnp.ones(1, bool)
    *shows, residual, present = read
    read = *shows, jnp.where(present, residual, 0.0), present
    found: Any = (
        *linear,
        *(jnp.tile(each, (len(present), 1)) for each in processes),
        *read,
        jnp.concatenate([zero, dt]),
        jnp.concatenate([fresh, ~valid]),
    )
    return ErrorModel(*found)


def input_matrix(model: MechanicalSystem, q: Array) -> Float[Array, "n n"]:
    """Acceleration per unit of a force in each component."""
    identity = jnp.eye(model.manifold.zero(q).shape[0], dtype=q.dtype)
    return jax.vmap(model.space.raise_, (None, 0))(q, identity).T


def acting(unknowns: Any, z: Array, rows: Rows) -> tuple[Float[Array, "T m"], Float[Array, "T m k"]]:
    """Inputs that act in the step after each row, behind its machine's lag, and their derivatives in its numbers."""
    inputs, at = jnp.asarray(rows.inputs), jnp.asarray(rows.rows)

    def behind(own_z, machine):
        own, _, _ = unknowns.of_machine(machine, z)
        return lagged(inputs, jnp.asarray(rows.steps), own.make(own.values(own_z))[1])[at]

    each = [unknowns.of_machine(m, z) for m in range(len(unknowns.parts))]
    first, own_z, _ = each[0]
    if not isinstance(first.make(first.values(own_z))[1], Tracer):
        u = behind(own_z, 0)
        return u, jnp.zeros((*u.shape, len(own_z)))
    machines = [(own_z, m) for m, (_, own_z, _) in enumerate(each)]
    u, change = (jnp.stack([of(*machine) for machine in machines]) for of in (behind, jax.jacfwd(behind)))
    machine, row = jnp.asarray(rows.machine)[jnp.asarray(rows.block)], jnp.arange(len(at))
    return u[machine, row], change[machine, row]


class _Past(NamedTuple):
    """What a smoother needs of a row: the transition to it, state and covariance after it, what readings show, and for
    each number the gain, the innovation and its variance (n,), in the order of the corrections."""

    transition: Array
    x: Array
    cov: Array
    shows: Array
    gain: Array
    innovation: Array
    variance: Array


def kalman(errors: ErrorModel, noise: NoiseLevels, speed: Scalar | float, doubt: float = 1.0) -> Filtered:
    """Run the Kalman filter on the linear error model; `speed` is the std of velocities at the start and restarts, and
    `doubt` that of positions there, in units of a reading's."""
    start, step = _recursion(errors, noise, speed, doubt)

    def row(state, now):
        after, result, _ = step(state, now)
        return after, result

    return jax.lax.scan(row, start, errors)[1]


def smoothed(errors: ErrorModel, noise: NoiseLevels, speed: Scalar | float, doubt: float = 1.0) -> Float[Array, "T Nd"]:
    """Estimate the errors and the unknown force at each row from all rows, by the smoother that belongs to `kalman`.

    Of the smoothed velocity v_s, the mean given all readings, `E(v̂ − v)² = E(v̂ − v_s)² + E(v_s − v)²` for any estimate
    v̂ from these readings: with the right noise the distance to it orders estimates as their errors do.

    Source: Bierman 1973, Fixed interval smoothing with discrete measurements, International Journal of Control 18(1),
    which inverts no covariance.
    """
    start, step = _recursion(errors, noise, speed, doubt)

    def forwards(state, now):
        after, _, past = step(state, now)
        return after, past

    def backwards(adjoint, row):
        past, present, fresh = row
        estimate = past.x - past.cov @ adjoint

        def correct(adjoint, number):
            shows, gain, innovation, variance, present = number
            # λ ← (I − K H)ᵀ λ − Hᵀ e/S of each correction, the last one first.
            change = adjoint @ gain + innovation / variance
            return adjoint - jnp.where(present, change, 0.0) * shows, None

        numbers = past.shows, past.gain, past.innovation, past.variance, present
        adjoint = jax.lax.scan(correct, adjoint, numbers, reverse=True)[0]
        return jnp.where(fresh, 0.0, past.transition.T @ adjoint), estimate

    pasts = jax.lax.scan(forwards, start, errors)[1]
    rows = pasts, errors.present, errors.fresh
    return jax.lax.scan(backwards, jnp.zeros_like(start[0]), rows, reverse=True)[1][:, : -errors.residual.shape[1]]


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
    many, size = errors.input_matrix.shape[1:]
    whole_size = many + size
    # Nothing is known: positions and velocities far beyond their size, and a force far beyond its own.
    first = VAGUE**2 * _first(errors, noise, speed)[:whole_size, :whole_size]
    later = jax.tree.map(lambda column: jnp.roll(column, -1, axis=0), (errors, inverse))

    def step(state, rows):
        row, (then, back), last = rows
        x: Any
        whole, defect, added = (each[tuple([slice(whole_size)] * each.ndim)] for each in _transition(then, noise))
        push, decay = whole[:many, many:], whole[many:, many:]
        remains = jnp.diag(1 / jnp.diag(decay))
        back = jnp.block([[back, -back @ push @ remains], [jnp.zeros((size, many)), remains]])
        x = jnp.where(last, 0.0, back @ (state[0] - defect))
        cov = jnp.where(last, first, _symmetric(back @ (state[1] + added) @ back.T))
        estimate = x[: 2 * n], jnp.sqrt(jnp.diag(cov)[n : 2 * n])
        numbers = jnp.eye(n, whole_size), row.residual, variance, row.present
        return jax.lax.scan(lambda both, number: (_reading(*both, *number)[:2], None), (x, cov), numbers)[0], estimate

    rows = errors, later, later[0].fresh.at[-1].set(True)
    return jax.lax.scan(step, (jnp.zeros(whole_size), first), rows, reverse=True)[1]


def _recursion(errors: ErrorModel, noise: NoiseLevels, speed: Scalar | float, doubt: float):
    """The start of the filter, and its step `(state, row) -> (state, Filtered, _Past)`."""
    n, (size, p) = errors.residual.shape[1], errors.slopes.shape[1:]
    variance = noise.measurement**2
    first = _first(errors, noise, speed, doubt)
    whole_size, start = len(first), jnp.zeros(len(first))

    def step(state, row):
        x, cov, slope = state
        whole, defect, added = _transition(row, noise)
        x = whole @ x + defect
        slope = whole @ slope + jnp.pad(row.slopes, ((0, whole_size - size), (0, 0)))
        cov = _symmetric(whole @ cov @ whole.T + added)
        current = jax.tree.map(lambda *both: jnp.where(row.fresh, *both), (start, first), (x, cov))

        def correct(current: Any, number: Any):
            *now, slope = current
            *after, results = _reading(*now, *number[:4])
            gain, felt = results[3], -number[0] @ slope - number[4]
            return (*after, slope + jnp.outer(gain, felt)), (*results, jnp.where(number[3], felt, 0.0))

        # Their noise is independent, so they correct one after the other.
        shows = jnp.concatenate([jnp.pad(row.shows, ((0, 0), (0, whole_size - size - n))), jnp.eye(n)], axis=1)
        numbers = shows, row.residual, variance, row.present, row.shown_slopes
        found: Any = jax.lax.scan(correct, (*current, jnp.where(row.fresh, 0.0, slope)), numbers)
        current, (loss, innovation, std, gains, used, felt) = found
        x, cov, _ = current
        # K = P Hᵀ R⁻¹ with the covariance P after the correction.
        gain = jnp.stack([jnp.mean(jnp.diag(cov[at : at + n, :n]) / variance) for at in (0, n)])
        velocity_std = jnp.sqrt(jnp.diag(cov)[n : 2 * n])
        result = Filtered(loss, innovation, std, x[:size], gain, velocity_std, felt)
        return current, result, _Past(whole, x, cov, shows, gains, innovation, used)

    return (start, first, jnp.zeros((whole_size, p))), step


def _symmetric(cov: Array) -> Array:
    """The symmetric part: rounding would otherwise grow, since a correction uses the columns of a covariance only."""
    return (cov + cov.T) / 2


def _first(errors: ErrorModel, noise: NoiseLevels, speed: Scalar | float, doubt: float = 1.0) -> Float[Array, "M M"]:
    """Covariance of the errors, the force and the wiggle before any measurement.

    A random walk then has its variance of one second, and a force with a time its usual one.
    """
    sizes = errors.input_matrix.shape[2], errors.residual.shape[1]
    processes = zip((noise.force, noise.wiggle), sizes, strict=True)
    force, wiggle = (jnp.broadcast_to(jnp.asarray(size) ** 2, count) for size, count in processes)
    errors_first = jnp.where(errors.driven[0], speed**2, (doubt * noise.measurement) ** 2 @ errors.shows[0])
    return jnp.diag(jnp.concatenate([errors_first + errors.first[0] ** 2, force, wiggle]))


def _transition(row: ErrorModel, noise: NoiseLevels) -> tuple[Array, Array, Array]:
    """Transition (M, M) of errors, force and wiggle to a row, its defect (M,), and the covariance that it adds."""
    size, count, n = *row.input_matrix.shape, row.residual.shape[0]
    # The force is constant over a step, at its mean; its effect is the mean of those at both ends (trapezoidal rule).
    mean, decay, added = forgotten(row.dt, noise.force_time)
    _, remains, moved = forgotten(row.dt, noise.wiggle_time)
    push = mean * row.dt / 2 * (row.input_matrix + row.transition @ row.input_matrix)
    rest = jnp.concatenate([jnp.full(count, decay), jnp.full(n, remains)])
    above = jnp.concatenate([row.transition, push, jnp.zeros((size, n))], axis=1)
    whole = jnp.concatenate([above, jnp.pad(jnp.diag(rest), ((0, 0), (size, 0)))])
    grown = [
        jnp.broadcast_to(share * jnp.asarray(each) ** 2, many)
        for share, each, many in ((added, noise.force, count), (moved, noise.wiggle, n))
    ]
    defect = jnp.pad(row.defect, (0, count + n))
    walk = jnp.diag(jnp.concatenate([row.dt * row.walk**2, *grown]))
    return whole, defect, walk + jnp.pad(noise.acceleration**2 * _white(row), (0, count + n))


def _white(row: ErrorModel) -> Float[Array, "N N"]:
    """Covariance of the errors that white noise of unit density adds in a step, by Simpson's rule."""
    size = len(row.driven)
    middle, driven = (jnp.eye(size) + row.transition) / 2, jnp.diag(row.driven.astype(row.dt.dtype))
    ends = driven + row.transition @ driven @ row.transition.T
    return row.dt / 6 * (ends + 4 * middle @ driven @ middle.T)


def forgotten(dt: Scalar, time: Scalar | float) -> tuple[Scalar, Scalar, Scalar]:
    """How a force changes in a step [s], with a time constant [s] that is infinite for a random walk.

    Its mean over the step and its value at the end, as fractions of the value before, `(1 − e)/(dt/τ)` and
    `e = exp(−dt/τ)`; and the variance that is added, as a fraction of that in the long run, `1 − e²`, or for a walk of
    that in one second, dt. As in `observers.SlowVariables`.
    """
    steps = dt / time
    mean, end, added = gauss_markov(steps)
    return mean, end, jnp.where(steps > 0, added, dt)


def _reading(x: Vector, cov: Array, shows: Vector, residual: Scalar, variance: Scalar, present: Flag):
    """Correct the state by one number, which shows so much of each entry; beyond `CREDIBLE` deviations its noise is
    that of an outlier of its size."""
    shown = cov @ shows
    innovation, total_variance = residual - shows @ x, shows @ shown + variance
    square = innovation**2 / total_variance
    limit = CREDIBLE**2
    # With the noise enlarged so, the corrected innovation has exactly `CREDIBLE` deviations.
    inflation = jnp.maximum(square / limit, 1.0)
    gain = jnp.where(present, shown / (total_variance * inflation), 0.0)
    # Joseph's form (I − KH) P (I − KH)ᵀ + K R Kᵀ, in which R is the enlarged variance of an outlier, multiplied out.
    cov = cov - total_variance * inflation * jnp.outer(gain, gain)
    # Beyond the limit the square grows as its logarithm only, continuously with its slope.
    loss = jnp.log(total_variance) + jnp.where(square > limit, limit * (1 + jnp.log(inflation)), square)
    results = (jnp.where(present, each, 0.0) for each in (loss, innovation, jnp.sqrt(total_variance)))
    return x + gain * innovation, cov, (*results, gain, total_variance * inflation)
