"""What sensors beside the positions should read along a log, from its positions alone, and what they read.

Positions are smoothed by local cubics, which gives q, v and a; the output of the sensor at these is its prediction. The
readings pass the same filter: those of a velocity are integrated, and the slopes of the cubics through the integral are
taken. A velocity then is smoothed in the same way on both sides, so that wide windows leave no difference.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from covariant import scoring
from covariant.calibration.diagnosis._case import Case, acting, long_enough
from covariant.calibration.diagnosis._finding import Names
from covariant.calibration.diagnosis._readings import outliers, prediction_errors
from covariant.calibration.diagnosis._smooth import FEWEST, FULL, ORDER, Smooth, gain, smooth
from covariant.logs import Columns
from covariant.observers import Instant, Sensor, tachometer
from covariant.observers.sensors import AbstractSensorKind, Checks

WIDER = (1.0, 2.0, 4.0, 8.0)
"""Half windows to try, in those of the reference of the model file."""
CLEAR = 25.0
"""Ratio of the variance of a signal to that of its noise from which it is judged: it leaves a scale 4 % wrong."""
SAMPLES = 40
"""Number of points at which the derivatives of an output are averaged."""
PIECE = 256
"""Points at which an output is computed at once."""
ROUNDING = 1e-12
"""Ratio to the largest variance up to which one is zero but for rounding."""
FEWEST_ROWS = 60
"""Least number of readings, and of grid points, that are judged."""


class Beside(NamedTuple):
    """A sensor beside the positions, and what it read in the rows of a log.

    Attributes:
        sensor: The sensor.
        columns: Its columns in the log, with their units.
        delay: Delay [s] of its readings that the model file states.
        unit: SI unit of its readings, of a pose of its position; "" where it is not known.
        readings: Readings (T, k) in SI units in the rows of the log; NaN where there is none.
        compared: Whether estimates are only compared with it, as with logged velocities.

    Example:
        >>> import numpy as np
        >>> from covariant import logs, observers
        >>> from covariant.calibration import Beside
        >>> speed = observers.tachometer([0], 0.01, name="speed")
        >>> Beside(speed, logs.Columns(q=("w",)), 0.0, "rad/s", np.zeros((3, 1))).names
        ('w',)
    """

    sensor: Sensor
    columns: Columns
    delay: float
    unit: str
    readings: Float[np.ndarray, "T k"]
    compared: bool = False

    @classmethod
    def of_velocities(cls, names: Names, columns: tuple[str, ...], v: Float[np.ndarray, "T n"]) -> "Beside":
        """The logged velocities, as of a sensor of them."""
        units = {"q": names.stated["v"]} if "v" in names.stated else {}
        unit = "rad/s" if names.angles.all() else "m/s" if not names.angles.any() else ""
        sensor = tachometer(range(len(columns)), 1e-9, name="v")  # hardly any noise, since none is stated
        return cls(sensor, Columns(q=columns, units=units), 0.0, unit, v, compared=True)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its columns."""
        return self.columns.measured

    @property
    def checks(self) -> Checks:
        """What its kind is known by; of a function of the user, nothing but its numbers."""
        return self.sensor.h.checks if isinstance(self.sensor.h, AbstractSensorKind) else Checks()

    @property
    def pose(self) -> bool:
        """Whether its readings are positions (3,) with rotations (3, 3)."""
        return bool(self.columns.position)


class Pair(NamedTuple):
    """Predicted and measured readings of a sensor, both smoothed, on one grid of K even times.

    Attributes:
        t: Times (K,) [s].
        predicted: Predicted readings (K, k), without a bias.
        read: Measured readings (K, k), each at the time at which it was true according to the model file.
        used: Which times (K,) have full windows.
        predicted_noise: Standard deviation (k,) of `read - predicted` of a right sensor: from the noise of the
            positions, and that which the table of the sensor states.
        read_noise: Standard deviation (k,) of `read`.
        noise: Standard deviation (k,) of one reading, before it is smoothed; NaN for few.
        half: Half width of the windows [s].
    """

    t: Float[np.ndarray, "K"]
    predicted: Float[np.ndarray, "K k"]
    read: Float[np.ndarray, "K k"]
    used: Bool[np.ndarray, "K"]
    predicted_noise: Float[np.ndarray, "k"]
    read_noise: Float[np.ndarray, "k"]
    noise: Float[np.ndarray, "k"]
    half: float

    @property
    def shown(self) -> Bool[np.ndarray, "k"]:
        """Which numbers (k,) the motion changes by clearly more than noise."""
        return _clear(self.predicted[self.used], self.predicted_noise)

    @property
    def moving(self) -> Bool[np.ndarray, "k"]:
        """Which readings (k,) change by clearly more than noise."""
        return _clear(self.read[self.used], self.read_noise)


def _clear(values: np.ndarray, noise: np.ndarray) -> np.ndarray:
    # The floor is for numbers that are constant but for rounding, such as a gyro's across the axis of a hinge.
    size = np.var(values, axis=0)
    return size > np.maximum(CLEAR * noise**2, 1e-12 * max(size.max(initial=0.0), 1e-300))


def pair(case: Case, t: Float[np.ndarray, "T"], beside: Beside, late: Any = 0.0) -> Pair | None:
    """Predict the readings of a sensor from the positions of a log, and smooth both."""
    readings, at = _without_outliers(beside, t), t - beside.delay
    spacings = [np.median(np.diff(at[np.isfinite(c)])) for c in readings.T if np.isfinite(c).sum() > FEWEST_ROWS]
    if len(spacings) < readings.shape[1]:
        return None
    least, best = FEWEST * float(max(spacings)), None
    output = _Output.of(beside.sensor)
    for half in (w * case.file.reference_half for w in WIDER):
        wide = max(half, least)
        if not long_enough(case, wide):
            break
        stated = late + np.asarray(case.file.delay, float)
        log = smooth(acting(case), wide, case.model.circles, stated, case.ticks)
        found, never = _at(log, output, readings, at, beside)
        if found.used.sum() < FEWEST_ROWS:
            break
        if best is None or found.shown.sum() > best.shown.sum():
            best = found
        if (best.shown | never).all():
            break
    return best


def _without_outliers(beside: Beside, t: np.ndarray) -> np.ndarray:
    """Readings (T, k) without outliers, angles within a turn unwrapped."""
    readings = np.array(beside.readings, float)
    if beside.sensor.period is not None:
        for i, period in enumerate(beside.sensor.period):
            if period > 0:
                seen = np.isfinite(readings[:, i])
                readings[seen, i] = np.unwrap(readings[seen, i], period=period)
    wrong, _ = outliers(t, readings, ())
    return np.where(wrong, np.nan, readings)


class _Output(NamedTuple):
    """Output of a sensor of q, v, a, u and t, without its slow states, and its derivatives in q, v and a."""

    values: Callable[..., Any]
    slopes: Callable[..., Any]

    @classmethod
    def of(cls, sensor: Sensor) -> "_Output":
        none = jnp.zeros(0 if sensor.slow is None else len(sensor.slow.names))

        def output(q, v, a, u, t):
            return sensor.h(Instant(q, v, lambda: a, u, t), none)

        return cls(jax.jit(jax.vmap(output)), jax.jit(jax.vmap(jax.jacfwd(output, (0, 1, 2)))))

    def along(self, log: Smooth, size: int) -> np.ndarray:
        """Values (K, k) along a smoothed log, computed in pieces of one size, so that they are compiled once."""
        count = len(log.t)
        rows = np.minimum(np.arange(-(-count // size) * size), count - 1)
        arrays = [np.asarray(each)[rows] for each in (log.q, log.v, log.a, log.u, log.t)]
        pieces = zip(*(each.reshape(len(each) // size, size, *each.shape[1:]) for each in arrays), strict=True)
        return np.concatenate([np.asarray(self.values(*map(jnp.asarray, piece))) for piece in pieces])[:count]

    def at(self, log: Smooth, points: np.ndarray) -> tuple[np.ndarray, ...]:
        """Derivatives (P, k, n) in q, v and a at some points."""
        slopes = self.slopes(*(jnp.asarray(np.asarray(each)[points]) for each in (log.q, log.v, log.a, log.u, log.t)))
        return tuple(np.asarray(each) for each in slopes)


def _at(
    log: Smooth, output: _Output, readings: np.ndarray, at: np.ndarray, beside: Beside
) -> tuple[Pair, Bool[np.ndarray, "k"]]:
    """The pair at one width of the windows, and which numbers no motion changes there."""
    predicted = output.along(log, PIECE)
    read, used, noise = _smooth_readings(log, readings, at, beside.checks.derivative)
    spacing, mean = float(np.median(np.diff(at))), gain(log.half, float(np.median(np.diff(at))), 0)
    points = np.flatnonzero(log.used)
    if not len(points):
        points = np.arange(len(log.t))
    slopes = output.at(log, points[np.linspace(0, len(points) - 1, SAMPLES).astype(int)])
    variance = np.zeros(predicted.shape[1])
    for derivative, slope in enumerate(slopes):
        std = gain(log.half, spacing, derivative) * log.noise
        variance += np.mean(np.sum((slope * std) ** 2, axis=2), axis=0)
    stated = np.sqrt(np.diag(np.asarray(beside.sensor.cov)))
    if len(stated) < len(variance):  # of a pose: three numbers of its rotation for nine
        stated = np.append(stated[:3], np.full(len(variance) - 3, stated[3:].max()))
    never = variance <= ROUNDING * variance.max(initial=0.0)
    # A mean over a window: of a filter of a number of its own kind the gain is that of a fitted value.
    whole = np.sqrt(variance + (mean * stated) ** 2)
    return Pair(log.t, predicted, read, used, whole, np.nan_to_num(noise) * mean, noise, log.half), never


def _smooth_readings(
    log: Smooth, readings: np.ndarray, at: np.ndarray, order: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Readings (K, k) on the grid of a smoothed log, the times with full windows, and the noise (k,) of a reading."""
    read, used = np.empty((len(log.t), readings.shape[1])), log.used.copy()
    noise = np.full(readings.shape[1], np.nan)
    for i, column in enumerate(readings.T):
        seen = np.isfinite(column)
        when, summed = at[seen], column[seen]
        error = prediction_errors(when, summed)
        # The factor makes the median size of normal errors their standard deviation.
        noise[i] = 1.4826 * np.median(np.abs(error))
        for _ in range(order):
            steps = np.diff(when) * (summed[1:] + summed[:-1]) / 2
            summed = np.concatenate([[0.0], np.cumsum(steps)])
        c = scoring.local_polynomials(when, summed[:, None], log.t, log.half, ORDER)[:, order, 0]
        read[:, i] = c * (2.0 if order == 2 else 1.0)  # coefficient c is the c-th derivative divided by c!
        held = np.searchsorted(when, log.t + log.half) - np.searchsorted(when, log.t - log.half)
        used &= held >= FULL * 2 * log.half / float(np.median(np.diff(when)))
        used &= (log.t > when[0] + log.half) & (log.t < when[-1] - log.half)
    return read, used, noise
