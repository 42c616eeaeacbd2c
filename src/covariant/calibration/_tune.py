"""Noise and gains from logs: those with the likeliest innovations, confirmed on held-out rows.

The gains of a constant-gain observer are those whose innovations have the least size, which is the likelihood of an
innovation model with these gains. The noise of Kalman filters is that of the greatest likelihood of their innovations,
computed on the errors of one run as in `_error_model`. Velocities are compared with a reference on the later rows only.

Source: Ljung 1999, System Identification, section 7.4, for prediction errors and likelihood; Schweppe 1965; Mehra 1970,
On the identification of variances and adaptive Kalman filtering, IEEE TAC 15(2), for whiteness.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration import outliers
from covariant.calibration._data_sheet import DataSheet, Trial
from covariant.calibration._error_model import ErrorModel, Filtered, NoiseLevels, error_model, kalman
from covariant.calibration._estimators import estimators, observer_gains, tuned_estimators
from covariant.calibration._filters import relative_error
from covariant.models import MechanicalSystem
from covariant.observers import REGISTRY, Intrinsic, run, with_fixed_substeps
from covariant.scoring import scored_window, unwrap
from covariant.signals import Record, Run

TUNED = 2 / 3
"""Fraction of each log, its first part, on which gains and noise are tuned."""
MOST_ROWS = 8000
"""Largest number of rows of each log for tuning: the search runs an observer over them dozens of times."""
FEWEST_ROWS = 100
"""Least number of rows in each part of a log."""
FREQUENCIES, DAMPINGS = (2e-3, 3.0), (0.5**0.5, 3.0)
"""Bounds of the search for natural frequencies, in radians a sample, and damping ratios: √½ is the best for white
disturbances and a larger one for others; a smaller one only follows the chance of a short log."""
LEAST = 0.01
"""Least noise of a reading, as a fraction of the innovations: with less of it no estimate changes."""
FAR = 16.0
"""Cap on squared innovations, as a multiple of their 90 % quantile: an outlier decides nothing."""
NumpyArray = np.ndarray
Runs = Callable[[Sequence[Intrinsic], Sequence[Record]], Sequence[Run]]
"""Runs each of several observers over each of several records, and returns estimates and innovations."""


class HeldOut(NamedTuple):
    """Errors of the tuned estimators on the held-out rows, for n velocities.

    Attributes:
        one_step: Root mean square (n,) of the innovations of the constant-gain observer [rad or m].
        gains_error: Velocity RMSE (n,) of this observer [rad/s or m/s].
        kalman_error: Velocity RMSE (n,) of the Kalman filter [rad/s or m/s].
        relative: The same two errors (2,) as fractions of the velocities, root mean square over the coordinates.
        likelihood: Mean log-likelihood of a measured number under the Kalman filter [nats].
        nis: Mean normalised innovation squared; 1 is expected.
        correlation: Correlation (n,) of neighbouring innovations of the Kalman filter; 0 where they are white.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import HeldOut
        >>> one = np.array([0.01])
        >>> errors = HeldOut(one, 3 * one, 2 * one, np.array([0.03, 0.02]), likelihood=4.8, nis=1.1, correlation=one)
        >>> ("constant gains", "Kalman filter")[errors.relative.argmin()]
        'Kalman filter'
    """

    one_step: Float[NumpyArray, "n"]
    gains_error: Float[NumpyArray, "n"]
    kalman_error: Float[NumpyArray, "n"]
    relative: Float[NumpyArray, "2"]
    likelihood: float
    nis: float
    correlation: Float[NumpyArray, "n"]


class Tuning(NamedTuple):
    """Gains and noise estimated from logs, and their errors on the held-out rows.

    Attributes:
        natural_frequency: ω [rad/s] of a constant-gain observer, α = 2ζω and β = ω².
        damping: Its damping ratio ζ.
        noise: Noise levels of a Kalman filter.
        before: Held-out errors with the gains and noise of a data sheet; None where none was given.
        after: Held-out errors with the tuned gains and noise.
        model_free: Name of the best filter without a model, and its velocity RMSE on the held-out rows as a fraction of
            the velocities; None where there is none for this kind of system.
        rows: Number of rows for tuning.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import DataSheet, HeldOut, Tuning, given_noise
        >>> one = np.array([0.01])
        >>> errors = HeldOut(one, 3 * one, 2 * one, np.array([0.03, 0.02]), likelihood=4.8, nis=1.1, correlation=one)
        >>> noise = given_noise(DataSheet(1e-3, 0.5), rate=100.0, n=1)
        >>> Tuning(5.0, 0.7, noise, None, errors, ("savitzky-golay", 0.05), rows=1000).model_helps
        True
    """

    natural_frequency: float
    damping: float
    noise: NoiseLevels
    before: HeldOut | None
    after: HeldOut
    model_free: tuple[str, float] | None
    rows: int

    @property
    def model_helps(self) -> bool:
        """Whether an estimator with the model has a smaller error than the best filter without one."""
        return self.model_free is None or bool(min(self.after.relative) < self.model_free[1])


class _Log(NamedTuple):
    """A record without outliers, its reference velocities (T, n), the rows for tuning and the held-out rows."""

    record: Record
    velocity: Float[NumpyArray, "T n"]
    tuned: Bool[NumpyArray, "T"]
    held_out: Bool[NumpyArray, "T"]

    @property
    def first_part(self) -> Record:
        """The rows up to the last one for tuning, in which the observer settles too."""
        end = int(np.flatnonzero(self.tuned)[-1]) + 1
        return Record(self.record.t[:end], self.record.u[:end], self.record.y[:end])

    @property
    def rate(self) -> float:
        return 1 / float(np.median(np.diff(np.asarray(self.record.t))))


def tune(
    model: MechanicalSystem,
    records: Sequence[Record],
    velocities: Sequence[Float[np.ndarray, "_ n"]],
    *,
    std: Float[np.ndarray, "n"] | None = None,
    before: DataSheet | None = None,
    progress: Callable[[str], object] = lambda stage: None,
    runs: Runs | None = None,
) -> Tuning:
    """Tune gains and noise of a model on the first two thirds of each record, and confirm them on the rest.

    Args:
        model: The mechanical system.
        records: The logs.
        velocities: Reference velocities (T, n) of each, as from `scoring.zero_phase_velocity`; only the filters without
            a model are tuned to them.
        std: Least standard deviation (n,) of a reading, such as that of one tick of an encoder; by default a small
            fraction of the innovations.
        before: Data sheet whose gains and noise are judged as well, for comparison.
        progress: Called with the name of each of the four stages when it begins.
        runs: Runs the observers with constant gains, of which there are dozens; by default JAX, one by one.

    Returns:
        Gains, noise, and their errors on the held-out rows.

    Raises:
        ValueError: A record is too short, or no gains give a finite estimate.
    """
    logs = [_prepared(model, record, velocity) for record, velocity in zip(records, velocities, strict=True)]
    progress("gains")
    runner = runs or _by_jax
    frequency, damping, size = _best_gains(model, logs, runner)
    progress("noise")
    estimates = _followed(model, logs, frequency, damping, runner)
    systems = [_system(model, log, estimate) for log, estimate in zip(logs, estimates, strict=True)]
    noise = _best_noise(logs, systems, frequency, size, std)
    progress("held-out rows")
    baseline = None
    if before is not None:
        gains = observer_gains(before, logs[0].rate)
        ratio = gains.alpha / (2 * gains.beta**0.5)
        earlier = _followed(model, logs, gains.beta**0.5, ratio, runner)
        baseline = _judged(logs, systems, estimates, earlier, given_noise(before, logs[0].rate, size.shape[0]))
    after = _judged(logs, systems, estimates, estimates, noise)
    progress("filters without a model")
    free = _best_model_free(model, logs, noise, before)
    return Tuning(frequency, damping, noise, baseline, after, free, sum(int(log.tuned.sum()) for log in logs))


def given_noise(sheet: DataSheet, rate: float, n: int) -> NoiseLevels:
    """Noise levels of a Kalman filter from a data sheet.

    Args:
        sheet: The data sheet.
        rate: Sampling rate [Hz].
        n: Number of velocities.

    Returns:
        The noise levels; the force is 0 where the sheet has none.

    Example:
        >>> from covariant.calibration import DataSheet, given_noise
        >>> given_noise(DataSheet(measurement_std=1e-3, acceleration_std=0.5), rate=100.0, n=2).measurement.tolist()
        [0.001, 0.001]
    """
    time = 1 / (2 * rate) if sheet.correlation_time is None else sheet.correlation_time
    std = np.broadcast_to(np.asarray(sheet.coordinate_stds or sheet.measurement_std, float), n)
    acceleration = float(np.sqrt(2 * time) * sheet.acceleration_std)
    return NoiseLevels(jnp.asarray(acceleration), jnp.asarray(std), jnp.asarray(sheet.external_force or 0.0))


def _prepared(model: MechanicalSystem, record: Record, velocity: np.ndarray) -> _Log:
    t, y = np.asarray(record.t), np.asarray(record.y)
    if model.manifold.commuting:
        wrong = outliers(t, y, model.circles)[0]
        wrong[0] = False  # a record begins with a whole measurement
        y = np.where(wrong, np.nan, y)
    border = t[0] + TUNED * (t[-1] - t[0])
    valid = scored_window(t) & np.isfinite(velocity).all(axis=1)
    tuned, held_out = valid & (t < border), valid & (t >= border)
    tuned[np.flatnonzero(tuned)[MOST_ROWS:]] = False
    if min(tuned.sum(), held_out.sum()) < FEWEST_ROWS:
        raise ValueError(
            f"a log of {len(t)} rows over {t[-1] - t[0]:.3g} s is too short to tune on: of its first two thirds "
            f"{tuned.sum()} rows count, of the rest {held_out.sum()}, and {FEWEST_ROWS} of each are needed"
        )
    return _Log(Record(t, np.asarray(record.u), y), velocity, tuned, held_out)


def _intrinsic(model: MechanicalSystem, frequency: float, damping: float) -> Intrinsic:
    return Intrinsic(model, 2 * damping * frequency, frequency**2)


def _by_jax(observers: Sequence[Intrinsic], records: Sequence[Record]) -> list[Run]:
    pairs = [(observer, record) for observer in observers for record in records]
    return [run(observer, record, ("innovation",)) for observer, record in pairs]


def _best_gains(model: MechanicalSystem, logs: list[_Log], runs: Runs) -> tuple[float, float, Float[np.ndarray, "n"]]:
    """Natural frequency [rad/s] and damping ratio with the least innovations, and the size (n,) of these."""
    from scipy.optimize import minimize

    rate = logs[0].rate
    parts = [log.first_part for log in logs]
    measured = np.concatenate(
        [_usable(model, log)[: len(part.t)][log.tuned[: len(part.t)]] for log, part in zip(logs, parts, strict=True)]
    )

    def observer(z):
        return _intrinsic(model, float(np.exp(z[0])) * rate, float(np.exp(z[1])))

    def usable(results):
        residuals = [np.asarray(done.info.innovation) for done in results]
        return np.concatenate([r[log.tuned[: len(r)]] for r, log in zip(residuals, logs, strict=True)])

    def innovations(z):
        return usable(runs([observer(z)], parts))

    def size(r):
        with np.errstate(all="ignore"):
            mean = [_mean_square(column[mask]) for column, mask in zip(r.T, measured.T, strict=True)]
            total = float(np.sum(np.log(mean)))
        # A finite number larger than any other: the simplex computes with what it compares.
        return total if np.isfinite(total) else 1e6

    bounds = [np.log(FREQUENCIES), np.log(DAMPINGS)]
    # A grid by factors of two, since the simplex descends to the nearest minimum only.
    starts = [np.array([w, np.log(DAMPINGS[0])]) for w in np.linspace(np.log(0.02), np.log(2.0), 8)]
    tried = [runs([observer(z) for z in starts], [part]) for part in parts]  # by part, then by start
    start = starts[int(np.argmin([size(usable(results)) for results in zip(*tried, strict=True)]))]
    simplex = start + np.array([[0.0, 0.0], [0.4, 0.0], [0.0, 0.4]])
    options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-4, "maxfev": 60}
    best = minimize(lambda z: size(innovations(z)), start, method="Nelder-Mead", bounds=bounds, options=options)
    if best.fun >= 1e6:
        raise ValueError("no gains give a finite estimate; check units and signs by `covariant check`")
    r = innovations(best.x)
    sizes = [np.sqrt(_mean_square(column[mask])) for column, mask in zip(r.T, measured.T, strict=True)]
    return float(np.exp(best.x[0])) * rate, float(np.exp(best.x[1])), np.array(sizes)


def _usable(model: MechanicalSystem, log: _Log) -> Bool[np.ndarray, "T n"]:
    return ~np.asarray(jax.vmap(model.manifold.missing)(jnp.asarray(log.record.y)))


def _mean_square(r: np.ndarray) -> float:
    """Mean square of innovations, robust to outliers."""
    square = r**2
    # Of normal innovations the 90 % quantile is 2.7 variances, and the cap 6.6 deviations.
    return float(np.mean(np.minimum(square, FAR * np.quantile(square, 0.9))))


def _followed(model: MechanicalSystem, logs: list[_Log], frequency: float, damping: float, runs: Runs) -> list[Any]:
    """Configurations, velocities (T, n) and innovations (T, n) of the observer over each of the whole logs."""
    estimates = []
    for done in runs([_intrinsic(model, frequency, damping)], [log.record for log in logs]):
        motion = model.motion(done.estimate)
        estimates.append((motion.q, motion.v, np.asarray(done.info.innovation)))
    return estimates


def _system(model: MechanicalSystem, log: _Log, estimate) -> ErrorModel:
    q, v, _ = estimate
    t, u, y = (jnp.asarray(each) for each in log.record[:3])
    sampled = np.linspace(0, len(t) - 2, min(200, len(t) - 1)).astype(int)
    fixed = with_fixed_substeps(_intrinsic(model, 1.0, 1.0), log.rate, q[sampled], v[sampled], u[sampled])
    return error_model(model, q, v, t, u, y, fixed.substeps or 1)


def _best_noise(
    logs: list[_Log], systems: list[ErrorModel], frequency: float, size: np.ndarray, std: np.ndarray | None
) -> NoiseLevels:
    """Noise of the greatest likelihood; with an unknown force where that gains more than its parameter costs."""
    least = LEAST * size if std is None else np.asarray(std, float)
    # At first one half of the variance of the innovations is noise of the reading.
    first = np.maximum(size / np.sqrt(2), least)
    # Inverse of ω⁴ = S_a/S_m, with S_m = std²/rate.
    acceleration = frequency**2 * float(np.sqrt(np.mean(first**2))) / np.sqrt(logs[0].rate)
    force = (
        acceleration * np.sqrt(frequency) / float(np.mean([np.abs(np.asarray(s.input_matrix)).max() for s in systems]))
    )
    ends = [len(log.first_part.t) for log in logs]
    parts = [jax.tree.map(lambda a, end=end: a[:end], system) for system, end in zip(systems, ends, strict=True)]
    masks = [np.asarray(part.present) & log.tuned[:end, None] for log, part, end in zip(logs, parts, ends, strict=True)]
    speed = _speed(logs)

    def noise(z):
        """Of the logarithms of the noise of acceleration, force and readings."""
        measured = np.maximum(np.exp(z[2:]), least)
        return NoiseLevels(*(jnp.asarray(x) for x in (np.exp(z[0]), measured, np.exp(z[1]))))

    def cost(z):
        total = sum(
            float(np.sum(np.where(mask, _filtered(part, noise(z), speed).loss, 0.0)))
            for part, mask in zip(parts, masks, strict=True)
        )
        return total if np.isfinite(total) else np.inf

    start = np.log([acceleration, force, *first])
    plain = start.copy()
    # The logarithm of no force.
    plain[1] = -np.inf
    plain, without = _descend(cost, plain)
    forced, lower = _descend(cost, np.where(np.isfinite(plain), plain, start))
    count = sum(int(mask.sum()) for mask in masks)
    # Schwarz's criterion: one parameter more has to lower twice the negative log-likelihood by log N.
    return noise(forced if without - lower > np.log(count) else plain)


def _descend(cost: Callable, start: np.ndarray) -> tuple[np.ndarray, float]:
    """Minimise the cost from a start whose infinite entries stay; returns the minimiser and the cost."""
    from scipy.optimize import minimize

    moving = np.isfinite(start)
    simplex = np.concatenate([np.zeros((1, moving.sum())), np.eye(int(moving.sum()))])

    def at(z):
        full = start.copy()
        full[moving] += z
        return full

    # 0.1 in twice the log-likelihood is small beside the log N that decides on a force.
    options = {"initial_simplex": simplex, "xatol": 0.03, "fatol": 0.1, "maxfev": 60 * int(moving.sum())}
    minimum = minimize(lambda z: cost(at(z)), simplex[0], method="Nelder-Mead", options=options)
    return at(minimum.x), float(minimum.fun)


def _speed(logs: list[_Log]) -> jax.Array:
    """Largest velocity of the reference: the standard deviation of velocities before anything is measured."""
    return jnp.asarray(max(float(np.abs(log.velocity[log.tuned]).max()) for log in logs))


@eqx.filter_jit
def _filtered(system: ErrorModel, noise: NoiseLevels, speed: jax.Array) -> Filtered:
    return kalman(system, noise, speed)


def _judged(logs, systems, runs, earlier, noise: NoiseLevels) -> HeldOut:
    """Errors on the held-out rows: of the gains of the runs `earlier`, and of a noise for the errors of `runs`."""
    n = logs[0].velocity.shape[1]
    parts = []
    for log, system, (_, v, _), (_, gains_v, r) in zip(logs, systems, runs, earlier, strict=True):
        result = _filtered(system, noise, _speed(logs))
        rows, present = log.held_out, np.asarray(system.present)
        white = np.asarray(result.innovation) / np.where(present, result.spread, 1.0)
        # The filter estimates the error of the run: the run plus this is its estimate.
        off = np.asarray(v) + np.asarray(result.error)[:, n:] - log.velocity
        parts.append(
            (
                r[rows],
                np.asarray(gains_v)[rows] - log.velocity[rows],
                off[rows],
                log.velocity[rows],
                np.asarray(result.loss)[rows],
                white[rows],
                present[rows],
                _neighbours(white[rows], present[rows]),
            )
        )
    r, gains, filtered, v, loss, white, present = (np.concatenate(each) for each in list(zip(*parts, strict=True))[:7])
    count = present.sum()

    def rms(x):
        return np.sqrt(np.mean(x**2, axis=0))

    relative = np.array([relative_error(v + off, v) for off in (gains, filtered)])
    products = np.sum([each[-1] for each in parts], axis=0)
    return HeldOut(
        np.sqrt(np.sum(r**2, axis=0) / present.sum(axis=0)),
        rms(gains),
        rms(filtered),
        relative,
        # `loss` lacks the constant log 2π of each measured number.
        float(-0.5 * (loss.sum() / count + np.log(2 * np.pi))),
        float(np.sum(white**2) / count),
        products[0] / products[1],
    )


def _neighbours(white: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Sums (2, n) of the products of neighbouring innovations, and of their squares."""
    both = present[1:] & present[:-1]
    return np.stack([np.sum(both * white[1:] * white[:-1], axis=0), np.sum(both * white[1:] ** 2, axis=0)])


def _best_model_free(model, logs: list[_Log], noise: NoiseLevels, sheet: DataSheet | None) -> tuple[str, float] | None:
    """Name and velocity error of the best filter without a model, each tuned on the first part of the first log."""
    names = [entry.name for entry in REGISTRY if not entry.knows_model and entry.name in estimators(model)]
    if not names:
        return None
    first, n = logs[0], logs[0].velocity.shape[1]
    end = len(first.first_part.t)
    valid = np.isfinite(first.velocity[:end]).all(axis=1)
    t, y = np.asarray(first.record.t)[:end], unwrap(np.asarray(first.record.y), model.circles)[:end]
    trial = Trial(t[valid], y[valid], first.velocity[:end][valid])
    typical = float(np.sqrt(np.mean(np.asarray(noise.measurement) ** 2)))
    sheet = (sheet or DataSheet(typical, float(noise.acceleration)))._replace(speed=None, quantum=None)
    filters = tuned_estimators(model, n, sheet, first.rate, trial, names)
    v = np.concatenate([log.velocity[log.held_out] for log in logs])
    errors = {}
    for name, observer in filters.items():
        estimates = [
            np.asarray(model.motion(run(observer, log.record, ("result",)).estimate).v)[log.held_out] for log in logs
        ]
        errors[name] = relative_error(np.concatenate(estimates), v)
    best = min(errors, key=errors.__getitem__)
    return best, errors[best]
