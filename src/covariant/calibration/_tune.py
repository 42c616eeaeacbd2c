"""Noise and gains from logs: those for which the innovations are most likely, confirmed on rows that were not used.

The gains of a constant-gain observer are those whose innovations have the least size, which is the likelihood of an
innovation model with these gains. The noise of Kalman filters is that of the greatest likelihood of their innovations,
found on the errors of one run as in `_error_model`. Velocities are compared with a reference on the later rows only.

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
"""Fraction of each log, its first part, that is tuned on."""
MOST_ROWS = 8000
"""Largest number of rows of each log that are tuned on: the search runs an observer over them dozens of times."""
FEWEST_ROWS = 100
"""Rows that both parts of a log need."""
FREQUENCIES, DAMPINGS = (2e-3, 3.0), (0.5**0.5, 3.0)
"""Natural frequencies that are searched, in radians a sample, and damping ratios: √½ is the best for white disturbances
and a larger one for others; a smaller one only follows the chance of a short log."""
LEAST = 0.01
"""Least noise of a reading, as a fraction of the innovations: with less of it no estimate changes."""
FAR = 16.0
"""Squares of innovations count up to so many times that of the 90 % quantile: an outlier decides nothing."""
NumpyArray = np.ndarray
Runs = Callable[[Sequence[Intrinsic], Sequence[Record]], Sequence[Run]]
"""What runs one observer over several records, or several over one, and keeps estimates and innovations."""


class HeldOut(NamedTuple):
    """How good estimators are on the rows that were not tuned on, for n velocities.

    - `one_step` (n,): root mean square of the innovations of the constant-gain observer [rad or m].
    - `gains_error`, `kalman_error` (n,): velocity RMSE of this observer and of the Kalman filter [rad/s or m/s].
    - `relative` (2,): the same two errors as parts of the velocities, root mean square over the coordinates.
    - `likelihood`: mean logarithm of the likelihood of a measured number under the Kalman filter [nats].
    - `nis`: mean normalised innovation squared; 1 is expected.
    - `correlation` (n,): correlation of neighbouring innovations of the Kalman filter; 0 where they are white.
    """

    one_step: Float[NumpyArray, "n"]
    gains_error: Float[NumpyArray, "n"]
    kalman_error: Float[NumpyArray, "n"]
    relative: Float[NumpyArray, "2"]
    likelihood: float
    nis: float
    correlation: Float[NumpyArray, "n"]


class Tuning(NamedTuple):
    """Gains and noise that were found, and how good they are on rows that were not used.

    - `natural_frequency` [rad/s], `damping`: of a constant-gain observer, α = 2ζω and β = ω².
    - `noise`: of a Kalman filter.
    - `before`, `after`: on the held-out rows; `before` is None where no noise was given.
    - `model_free`: the best filter without a model there, and its velocity RMSE as a part of the velocities; None where
      there is none for this kind of system.
    - `rows`: number of rows that were tuned on.
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
        """Whether an estimator with the model is better than the best filter without one."""
        return self.model_free is None or bool(min(self.after.relative) < self.model_free[1])


class _Log(NamedTuple):
    """A record without outliers, its reference velocities (T, n), and which rows are tuned on and held out."""

    record: Record
    velocity: Float[NumpyArray, "T n"]
    tuned: Bool[NumpyArray, "T"]
    held_out: Bool[NumpyArray, "T"]

    @property
    def first_part(self) -> Record:
        """The rows up to the last that is tuned on, in which the observer settles too."""
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
    """Gains and noise for a model, from the first two thirds of each record and confirmed on the rest.

    - `velocities`: a reference (T, n) for each record, such as `scoring.zero_phase_velocity` gives; nothing but the
      choice of the filters without a model is tuned to it.
    - `std` (n,): least standard deviation of a reading, such as that of one tick of an encoder.
    - `before`: a data sheet whose gains and noise are judged beside those that are found.
    - `progress`: called with the name of each of the four stages when it begins.
    - `runs`: what runs the observers with constant gains, of which there are dozens; by default JAX, one by one.

    Raises `ValueError` where a record is too short, and where no gains give a finite estimate.
    """
    logs = [_prepared(model, record, velocity) for record, velocity in zip(records, velocities, strict=True)]
    progress("gains")
    by = runs or _by_jax
    frequency, damping, size = _best_gains(model, logs, by)
    progress("noise")
    found = _followed(model, logs, frequency, damping, by)
    systems = [_system(model, log, estimate) for log, estimate in zip(logs, found, strict=True)]
    noise = _best_noise(logs, systems, frequency, size, std)
    progress("held-out rows")
    was = None
    if before is not None:
        gains = observer_gains(before, logs[0].rate)
        ratio = gains.alpha / (2 * gains.beta**0.5)
        earlier = _followed(model, logs, gains.beta**0.5, ratio, by)
        was = _judged(logs, systems, found, earlier, given_noise(before, logs[0].rate, size.shape[0]))
    after = _judged(logs, systems, found, found, noise)
    progress("filters without a model")
    free = _best_model_free(model, logs, noise, before)
    return Tuning(frequency, damping, noise, was, after, free, sum(int(log.tuned.sum()) for log in logs))


def given_noise(sheet: DataSheet, rate: float, n: int) -> NoiseLevels:
    """The noise that Kalman filters take from a data sheet, for n velocities at a rate [Hz]."""
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
    known = scored_window(t) & np.isfinite(velocity).all(axis=1)
    tuned, held_out = known & (t < border), known & (t >= border)
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
    """Natural frequency [rad/s] and damping ratio with the least innovations, and these (n,)."""
    from scipy.optimize import minimize

    rate = logs[0].rate
    parts = [log.first_part for log in logs]
    measured = np.concatenate(
        [_usable(model, log)[: len(part.t)][log.tuned[: len(part.t)]] for log, part in zip(logs, parts, strict=True)]
    )

    def observer(z):
        return _intrinsic(model, float(np.exp(z[0])) * rate, float(np.exp(z[1])))

    def usable(found):
        told = [np.asarray(done.info.innovation) for done in found]
        return np.concatenate([r[log.tuned[: len(r)]] for r, log in zip(told, logs, strict=True)])

    def innovations(z):
        return usable(runs([observer(z)], parts))

    def size(r):
        with np.errstate(all="ignore"):
            mean = [_mean_square(column[here]) for column, here in zip(r.T, measured.T, strict=True)]
            total = float(np.sum(np.log(mean)))
        return total if np.isfinite(total) else 1e6

    bounds = [np.log(FREQUENCIES), np.log(DAMPINGS)]
    starts = [np.array([w, np.log(DAMPINGS[0])]) for w in np.linspace(np.log(0.02), np.log(2.0), 8)]
    tried = [runs([observer(z) for z in starts], [part]) for part in parts]  # by part, then by start
    start = starts[int(np.argmin([size(usable(found)) for found in zip(*tried, strict=True)]))]
    simplex = start + np.array([[0.0, 0.0], [0.4, 0.0], [0.0, 0.4]])
    options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-4, "maxfev": 60}
    best = minimize(lambda z: size(innovations(z)), start, method="Nelder-Mead", bounds=bounds, options=options)
    if best.fun >= 1e6:
        raise ValueError("no gains give a finite estimate; check units and signs by `covariant check`")
    r = innovations(best.x)
    sizes = [np.sqrt(_mean_square(column[here])) for column, here in zip(r.T, measured.T, strict=True)]
    return float(np.exp(best.x[0])) * rate, float(np.exp(best.x[1])), np.array(sizes)


def _usable(model: MechanicalSystem, log: _Log) -> Bool[np.ndarray, "T n"]:
    return ~np.asarray(jax.vmap(model.manifold.missing)(jnp.asarray(log.record.y)))


def _mean_square(r: np.ndarray) -> float:
    """Mean square of innovations, in which outliers count no more than a few usual ones."""
    square = r**2
    return float(np.mean(np.minimum(square, FAR * np.quantile(square, 0.9))))


def _followed(model: MechanicalSystem, logs: list[_Log], frequency: float, damping: float, runs: Runs) -> list[Any]:
    """Configurations, velocities (T, n) and innovations (T, n) of the observer over each of the whole logs."""
    told = []
    for done in runs([_intrinsic(model, frequency, damping)], [log.record for log in logs]):
        motion = model.motion(done.estimate)
        told.append((motion.q, motion.v, np.asarray(done.info.innovation)))
    return told


def _system(model: MechanicalSystem, log: _Log, estimate) -> ErrorModel:
    q, v, _ = estimate
    t, u, y = (jnp.asarray(each) for each in log.record[:3])
    some = np.linspace(0, len(t) - 2, min(200, len(t) - 1)).astype(int)
    fixed = with_fixed_substeps(_intrinsic(model, 1.0, 1.0), log.rate, q[some], v[some], u[some])
    return error_model(model, q, v, t, u, y, fixed.substeps or 1)


def _best_noise(
    logs: list[_Log], systems: list[ErrorModel], frequency: float, size: np.ndarray, std: np.ndarray | None
) -> NoiseLevels:
    """The noise of the greatest likelihood; with an unknown force where that tells more than it costs."""
    least = LEAST * size if std is None else np.asarray(std, float)
    first = np.maximum(size / np.sqrt(2), least)
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
    plain[1] = -np.inf
    plain, without = _descend(cost, plain)
    forced, lower = _descend(cost, np.where(np.isfinite(plain), plain, start))
    count = sum(int(mask.sum()) for mask in masks)
    return noise(forced if without - lower > np.log(count) else plain)


def _descend(cost: Callable, start: np.ndarray) -> tuple[np.ndarray, float]:
    """Where the cost is least, from a start whose infinite entries stay; and the cost there."""
    from scipy.optimize import minimize

    moving = np.isfinite(start)
    simplex = np.concatenate([np.zeros((1, moving.sum())), np.eye(int(moving.sum()))])

    def at(z):
        full = start.copy()
        full[moving] += z
        return full

    options = {"initial_simplex": simplex, "xatol": 0.03, "fatol": 0.1, "maxfev": 60 * int(moving.sum())}
    found = minimize(lambda z: cost(at(z)), simplex[0], method="Nelder-Mead", options=options)
    return at(found.x), float(found.fun)


def _speed(logs: list[_Log]) -> jax.Array:
    """The largest velocity of the reference: what is known of velocities before anything is measured."""
    return jnp.asarray(max(float(np.abs(log.velocity[log.tuned]).max()) for log in logs))


@eqx.filter_jit
def _filtered(system: ErrorModel, noise: NoiseLevels, speed: jax.Array) -> Filtered:
    return kalman(system, noise, speed)


def _judged(logs, systems, runs, earlier, noise: NoiseLevels) -> HeldOut:
    """The gains of the runs `earlier`, and a noise for the errors of `runs`, on the rows that are held out."""
    n = logs[0].velocity.shape[1]
    parts = []
    for log, system, (_, v, _), (_, own, r) in zip(logs, systems, runs, earlier, strict=True):
        found = _filtered(system, noise, _speed(logs))
        here, present = log.held_out, np.asarray(system.present)
        white = np.asarray(found.innovation) / np.where(present, found.spread, 1.0)
        off = np.asarray(v) + np.asarray(found.error)[:, n:] - log.velocity
        parts.append(
            (
                r[here],
                np.asarray(own)[here] - log.velocity[here],
                off[here],
                log.velocity[here],
                np.asarray(found.loss)[here],
                white[here],
                present[here],
                _neighbours(white[here], present[here]),
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
    known = np.isfinite(first.velocity[:end]).all(axis=1)
    t, y = np.asarray(first.record.t)[:end], unwrap(np.asarray(first.record.y), model.circles)[:end]
    trial = Trial(t[known], y[known], first.velocity[:end][known])
    typical = float(np.sqrt(np.mean(np.asarray(noise.measurement) ** 2)))
    sheet = (sheet or DataSheet(typical, float(noise.acceleration)))._replace(speed=None, quantum=None)
    made = tuned_estimators(model, n, sheet, first.rate, trial, names)
    v = np.concatenate([log.velocity[log.held_out] for log in logs])
    errors = {}
    for name, observer in made.items():
        found = [
            np.asarray(model.motion(run(observer, log.record, ("result",)).estimate).v)[log.held_out] for log in logs
        ]
        errors[name] = relative_error(np.concatenate(found), v)
    best = min(errors, key=errors.__getitem__)
    return best, errors[best]
