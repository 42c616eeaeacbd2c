"""Comparison of a log with its model: smoothed accelerations, those of the model along the log, and their residuals."""

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.diagnosis._finding import Finding, Names, Rows
from covariant.calibration.diagnosis._readings import known_ticks, outlier_findings, outliers, readings
from covariant.calibration.diagnosis._smooth import FEWEST, NARROWEST, ORDER, Smooth, slowest, smooth
from covariant.calibration.diagnosis._thresholds import CLEAR
from covariant.models import MechanicalSystem, ModelFile, acceleration
from covariant.scoring import unwrap
from covariant.signals import Record, acting_inputs, lag_inputs
from scalargraph import on_batches

POINTS = 2048
"""Grid points per batch. With a fixed number, one compiled program serves all logs of a model without a graph."""
POINTS_OF_A_BLOCK = 30
SHORTEST = 6.0
"""Shortest log that is compared with the model, in half windows."""
WINDOWS = (1.0, 2.0, 3.0)
"""Half windows to try, in multiples of the model file's reference one; the one with the least misfit is used."""
WIDER = (2.0, 4.0, 8.0, 16.0)
"""Half windows to try, in the same multiples, until accelerations exceed the noise; slow motions need wide windows."""
DOUBLED = 10
"""How often the widest of them is doubled for motions that are slower still."""
LOST = 0.05
"""Fraction of a motion that smoothing may remove; a faster motion is smoothed in narrower windows."""
LOST_NOISE = 3.0
"""The same as a multiple of the noise of the readings, which smoothing is to remove."""


class Residual(NamedTuple):
    """Accelerations on the grid of a smoothed log: measured ones, and those of the model averaged in the same way.

    Attributes:
        measured: Measured accelerations (K, n).
        modelled: Accelerations (K, n) of the model.
        used: Points (K,) at which both are known.
        noise: Standard deviation (n,) of the measured ones.
    """

    measured: Float[np.ndarray, "K n"]
    modelled: Float[np.ndarray, "K n"]
    used: Bool[np.ndarray, "K"]
    noise: Float[np.ndarray, "n"]

    @property
    def left(self) -> Float[np.ndarray, "J n"]:
        """Residual accelerations (J, n), measured minus modelled, at the J points that are used."""
        return (self.measured - self.modelled)[self.used]

    @property
    def enough(self) -> bool:
        """Whether there are two blocks of points."""
        return bool(self.used.sum() >= 2 * POINTS_OF_A_BLOCK)

    @property
    def told(self) -> Bool[np.ndarray, "n"]:
        """Coordinates (n,) whose accelerations exceed the noise; none with fewer than two blocks of points."""
        if not self.enough:
            return np.zeros(self.measured.shape[1], bool)
        return np.mean(self.measured[self.used] ** 2, axis=0) > CLEAR * self.noise**2

    @property
    def scale(self) -> Float[np.ndarray, "n"]:
        """Mean square of both accelerations together, so that a wrong unit of either cannot hide the residuals."""
        size = np.mean((self.measured**2 + self.modelled**2)[self.used] / 2, axis=0)
        return np.where(size > 0, size, 1.0)

    def misfits(self, blocks: int = 1) -> Float[np.ndarray, "b n"]:
        """Mean squares of the residuals minus those of the noise, relative to `scale`, in blocks of equal length: 0 for
        a right model, 1 or more for an unrelated one."""
        # The expected square of a residual is that of the model's error plus that of the noise.
        parts = np.array_split(self.left**2 - self.noise**2, blocks)
        return np.array([part.mean(axis=0) for part in parts]) / self.scale

    @property
    def squares(self) -> Float[np.ndarray, "n"]:
        """Mean squares (n,) of what the model leaves beyond the noise; by chance they may be negative."""
        # Noise is independent of the model's error, so the variances subtract.
        return np.mean(self.left**2, axis=0) - self.noise**2

    @property
    def misfit(self) -> float:
        """Mean of `misfits` over the coordinates whose accelerations exceed the noise; NaN if there are none."""
        told = self.told
        return float(np.maximum(self.misfits()[0, told], 0.0).mean()) if told.any() else float("nan")


def residual(model: MechanicalSystem, log: Smooth) -> Residual:
    """Compare the accelerations of a model with those of a smoothed log."""
    modelled = averaged(log, accelerations(model, log))
    used = log.used & np.isfinite(modelled).all(axis=1) & np.isfinite(log.a).all(axis=1)
    return Residual(log.a, modelled, used, log.a_noise)


def input_effects(model: MechanicalSystem, log: Smooth, now: Residual) -> Iterator[Float[np.ndarray, "K n"]]:
    """Accelerations (K, n) on the grid that each input causes in the model."""
    for j in range(log.u.shape[1]):
        without = residual(model, log._replace(u=np.where(np.arange(log.u.shape[1]) == j, 0.0, log.u)))
        yield now.modelled - without.modelled


def averaged(log: Smooth, values: Float[np.ndarray, "K n"]) -> Float[np.ndarray, "K n"]:
    """Average values on the grid with the weights that smoothing applies to the true accelerations."""
    # Smoothing then distorts measured and modelled accelerations alike, and the distortion cancels in the residual.
    return np.stack([np.convolve(column, log.kernel, "same") for column in values.T], axis=1)


def accelerations(model: MechanicalSystem, log: Smooth) -> Float[np.ndarray, "K n"]:
    """Accelerations of the model on the grid."""
    data = (log.t, log.q, log.v, log.u)
    chunks = []
    for start in range(0, len(log.t), POINTS):
        part = [array[start : start + POINTS] for array in data]
        count = len(part[0])
        padded = [np.concatenate([array, np.repeat(array[-1:], POINTS - count, axis=0)]) for array in part]
        chunks.append(_accelerations(model, log.q.shape[1], log.u.shape[1])(*padded)[:count])
    return np.concatenate(chunks)


@functools.lru_cache(maxsize=4)  # a check compares one model with many logs
def _accelerations(model: MechanicalSystem, n: int, m: int) -> Callable:
    def at(t, q, v, u):
        return acceleration(model, t, q, v, u)

    return on_batches(at, np.zeros(()), np.zeros(n), np.zeros(n), np.zeros(m))


class Case(NamedTuple):
    """A record in coordinates, without outliers, and what it is compared with.

    Attributes:
        file, model: The model, and its data sheet.
        names: Columns and units.
        record: The record.
        ticks: Ticks (n,) of its encoders.
        effects: Function from a smoothed log to the accelerations (K, n) by each number of the model that may be wrong;
            None where they are not known.
    """

    file: ModelFile
    model: MechanicalSystem
    names: Names
    record: Record
    ticks: np.ndarray
    effects: Callable[[Smooth], list[np.ndarray]] | None = None

    @property
    def spacing(self) -> float:
        return float(np.median(np.diff(np.asarray(self.record.t))))

    def with_readings(self, y: Float[np.ndarray, "T n"]) -> "Case":
        """The case with other readings of its positions."""
        return self._replace(record=self.record._replace(y=y))

    def with_inputs(self, u: Float[np.ndarray, "T m"]) -> "Case":
        """The case with other inputs."""
        return self._replace(record=self.record._replace(u=u))


def in_coordinates(file: ModelFile) -> bool:
    """Whether a model file has a mechanical system in coordinates, whose accelerations can be compared with a log."""
    return file.mechanical and file.model.manifold.commuting  # pyright: ignore[reportAttributeAccessIssue]


def busiest(record: Record, rows: int) -> Record:
    """Return the stretch of a record, of at most `rows` rows, in which the positions move most."""
    if len(record.t) <= rows:
        return record
    travel = np.nan_to_num(np.abs(np.diff(np.asarray(record.y), axis=0)))
    # Scale each coordinate by its fast steps; the floor avoids a division by zero if one stands still.
    travel = np.sum(travel / np.maximum(np.quantile(travel, 0.95, axis=0), 1e-300), axis=1)
    reached = np.append(0.0, np.cumsum(travel))  # from the first row to each
    start = int(np.argmax(reached[rows - 1 :] - reached[: len(reached) - rows + 1]))
    return Record(*(np.asarray(a)[start : start + rows] for a in record[:3]))


def names_of(file: ModelFile) -> Names:
    n = len(file.columns.q)
    units = file.model.units or ("",) * n
    angles = np.array([unit == "rad" or i in file.model.circles for i, unit in enumerate(units)])
    commands = file.model.logged_units.get("u", ())
    return Names(file.columns.t, file.columns.q, file.columns.u, units, angles, file.columns.units, commands)


def case_without_outliers(
    file: ModelFile,
    record: Record,
    rows: Rows | None = None,
    quantum: float | tuple[float, ...] | None = None,
) -> tuple[Case, list[Finding]]:
    """Prepare a record for the comparison: set its outliers to NaN, and report them as findings."""
    model, names = file.need_mechanical(file.name, "accelerations are compared with those of"), names_of(file)
    t, y = np.asarray(record.t), np.asarray(record.y)
    ticks = known_ticks(record, model.circles, file.quantum if quantum is None else quantum)
    is_outlier, sizes = outliers(t, y, model.circles, ticks)
    case = Case(file, model, names, Record(t, np.asarray(record.u), np.where(is_outlier, np.nan, y)), ticks)
    return case, outlier_findings(is_outlier, sizes, names.q, names.units, rows or Rows(t))


def without_rows(columns: Sequence[int], begin: float, end: float) -> Callable[[Case], Case]:
    """Function from a case to the case without the readings of some columns from one time to another [s]."""

    def apply(case: Case) -> Case:
        t, y = np.asarray(case.record.t), np.array(case.record.y, float)
        for i in columns:
            y[(t >= begin) & (t <= end), i] = np.nan
        return case.with_readings(y)

    return apply


def smoothed(case: Case, half: float) -> Smooth:
    """Smooth the record over windows of ±`half` [s], with the sensor delays of the model file removed."""
    delay = np.asarray(case.file.delay, float)
    return smooth(acting(case), half, case.model.circles, delay, case.ticks, NARROWEST)


def smoothed_residual(case: Case, half: float) -> Residual:
    """Residual accelerations of the record in windows of ±`half` [s]."""
    return residual(case.model, smoothed(case, half))


def acting(case: Case) -> Record:
    """The record with the inputs that act in each step."""
    file = case.file
    lagging = lag_inputs(case.record, file.input_lag)
    return acting_inputs(lagging, file.input_between, file.input_delay, lead=file.input_lead)


def long_enough(case: Case, half: float) -> bool:
    """Whether the record can be smoothed over windows of ±`half` [s]."""
    t, y = np.asarray(case.record.t), np.asarray(case.record.y)
    enough = np.isfinite(y).sum(axis=0).min() > 10 * (ORDER + 1)
    return bool(enough and t[-1] - t[0] >= SHORTEST * max(half, FEWEST * case.spacing))


def windows(case: Case, multiples: Sequence[float]) -> tuple[float, ...]:
    """Half windows [s], in multiples of that of the model file, or of a narrower one for a motion that is faster."""
    t, y = np.asarray(case.record.t), unwrap(np.asarray(case.record.y), case.model.circles)
    half = min(case.file.reference_half, (t[-1] - t[0]) / SHORTEST)
    if not long_enough(case, half):
        return ()
    spacing = slowest(t, y)
    narrowest, noise = FEWEST * spacing, readings(case.record, case.model.circles).std
    allowed = np.maximum(LOST * np.nanstd(y, axis=0), LOST_NOISE * np.where(np.isfinite(noise), noise, np.inf))
    narrow = max(half, narrowest)
    while (smoothed(case, narrow).removed > allowed).any() and narrow > NARROWEST * spacing:
        half, narrowest = narrow, NARROWEST * spacing
        half = narrow = max(narrow / 2, narrowest)
    fast = narrowest < FEWEST * spacing
    # A log of a slow motion that is shorter than the windows of the model file is too short.
    usual = half if fast else case.file.reference_half
    halves = (max(w * usual, narrowest) for w in ((1.0, *multiples) if fast else multiples))
    return tuple(each for each in dict.fromkeys(halves) if long_enough(case, each))


def clearly(case: Case) -> Smooth | None:
    """Smooth a record by the narrowest window whose accelerations exceed the noise, or else by the widest one."""
    log, halves = None, windows(case, WIDER)
    for half in (*halves, *(max(halves) * 2.0**k for k in range(1, DOUBLED + 1) if halves)):
        if not long_enough(case, half):
            break
        log = smoothed(case, half)
        if np.any(np.mean(log.a[log.used] ** 2, axis=0) > CLEAR * log.a_noise**2) if log.used.any() else False:
            break
    return log


def compared(case: Case) -> Residual | None:
    """Residual accelerations of the record; None where it is too short to be smoothed."""
    log = clearly(case)
    return None if log is None else residual(case.model, log)


def best_window(case: Case) -> tuple[float, Residual] | None:
    """Half window with the least misfit, and its residuals; None if no window has accelerations above the noise."""
    tried = [(half, residual(case.model, smoothed(case, half))) for half in windows(case, WINDOWS)]
    if not any(left.told.any() for _, left in tried) and (log := clearly(case)) is not None:
        tried = [(log.half, residual(case.model, log))]
    known = [(half, left) for half, left in tried if left.told.any()]
    return min(known, key=lambda entry: entry[1].misfit) if known else None
