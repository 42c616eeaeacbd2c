"""The model and the log of a verb, read together: units, lags, delays, encoder ticks, and the reference for scoring."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from covariant import logs, models, scoring
from covariant.calibration import misfit
from covariant.models import Overrides
from covariant.observers import REGISTRY, AbstractObserver, ActingInputs, Delayed
from covariant.signals import LEAST_MISSING, MOST_MISSING, Record, acting_inputs, lag_inputs
from covariant.verbs.base.arguments import Amounts, ColumnNames as ColumnNames
from covariant.verbs.base.holes import Holes, holes_of
from covariant.verbs.base.kind import AbstractKind, Labels, numbered as numbered
from covariant.verbs.base.kinds import kind_of
from covariant.verbs.base.placeholders import placeholder_sentence, placeholders
from covariant.verbs.base.sensors import FileSensor, file_sensors, reading_delays, readings
from covariant.verbs.base.sheet import data_sheet as data_sheet, tells_noise as tells_noise
from scalargraph.errors import InputError

FEWEST_MOVES = 50
"""Fewest changes of positions that decide whether the log's ticks are coarser than those of the model file."""
MOST_REVERSALS, QUICK = 0.05, 5
"""Largest fraction of changes that undo one within so few samples, as noise makes them and a motion seldom does."""
OFF_TICK = 0.1
"""How far differences of positions may be from whole ticks, as a fraction of one: logs hold few digits."""


INFORMED = frozenset(entry.name for entry in REGISTRY if entry.knows_model)
"""Names of the observers that know the model."""


class Job(NamedTuple):
    """What a verb reads, and which part of it.

    Args:
        model: What `models.load` takes: a path, a name, `module:attribute`, a `ModelFile` or a system.
        log: What `logs.read` takes: a path, a `Record`, a DataFrame or an xarray Dataset.
        overrides: Values that replace those of the model file, as for `models.load`.
        every: Use each k-th row.
        until: Use the log up to this time [s], counted from its first row.
        columns: Names of columns that replace those of the model file.
        anyway: Go on with a log that does not fit the model at all.
        start: Use the log from this time [s] on, counted from its first row.
        fits: Numbers of the model are fitted, so that friction and rotors which it lacks are no reason to refuse a log.
    """

    model: Any
    log: Any
    overrides: Overrides = ()
    every: int = 1
    until: float | None = None
    columns: ColumnNames = MappingProxyType({})
    anyway: bool = False
    start: float | None = None
    fits: bool = False

    @property
    def model_name(self) -> str:
        """What messages and titles call the model."""
        return models.spec_name(self.model)

    @property
    def log_name(self) -> str:
        """What messages call the log: its path, or "table", "dataset" or "record"."""
        return logs.source_name(self.log)

    @property
    def title(self) -> str:
        """The model and the log in a headline."""
        return f"{Path(self.model_name).stem} from {Path(self.log_name).name}"


FITTED = {"friction", "rotor inertia", "added inertia", "model"}
"""Parts of findings on what a fit is for: the model may explain the log with other numbers."""


class MisfitError(InputError):
    """Error of a log that its model does not explain at all. The message is one line: log, evidence, and what to do.

    Example:
        >>> import covariant
        >>> log = covariant.simulate("oscillator", duration=10.0, rate=50.0, q0=1.0, noise=1e-3).record
        >>> try:
        ...     covariant.estimate("oscillator", log._replace(t=1e3 * log.t), alpha=40.0, beta=800.0)
        ... except covariant.verbs.MisfitError as error:
        ...     print('[units] t = "ms"' in str(error))
        True
    """

    exit_code = 1
    """Exit code of a command: the input is well formed, and its answer would be wrong."""


class ReferenceVelocity(NamedTuple):
    """Velocities that estimates are scored against.

    Attributes:
        v: Velocities (T, n), or states of a state-space model, in SI units; NaN where they are not known.
        label: Name of the reference, such as "zero-phase reference".
        scored: Which rows (T,) count.
    """

    v: np.ndarray
    label: str
    scored: np.ndarray


class Loaded(NamedTuple):
    """Model and log of a job.

    Attributes:
        file: The model file; without its quantum where positions are not such ticks.
        model: The model.
        log: The log, its inputs as they are logged.
        record: The record with the inputs that act in each step, after their lag and delay.
        rate: Sampling rate [Hz], from the median interval.
        reference: What velocities are scored against; None where nothing is.
        note: Sentences on what was assumed of the log, to append to a text; "" where nothing was.
        sensors: Sensors of the model file that the log has columns of, or none of them.
        readings: Their readings (T, K), NaN where there is none; None without sensors.
    """

    file: models.ModelFile
    model: Any
    log: logs.Log
    record: Record
    rate: float
    reference: ReferenceVelocity | None
    note: str = ""
    sensors: tuple[FileSensor, ...] = ()
    readings: np.ndarray | None = None

    @property
    def kind(self) -> AbstractKind:
        """The kind of the model."""
        return kind_of(self.file)

    @property
    def holes(self) -> Holes | None:
        """Where readings are missing for longer than usual; None where they never are."""
        return holes_of(*(np.asarray(part) for part in (self.record.t, self.record.u, self.record.y)))

    def record_for(self, observer: AbstractObserver) -> Record:
        """The record as an observer measures it: for one with sensors, their readings follow each configuration."""
        if not observer.sensors or self.readings is None:
            return self.record
        y = np.asarray(self.record.y)
        return self.record._replace(y=np.concatenate([y.reshape(len(y), -1), self.readings], axis=1))

    @property
    def origin(self) -> str | None:
        """Date in UTC from which the stamps count; None unless the log has dates or times since 1970."""
        ns = self.log.origin_ns
        return None if ns is None else f"{np.datetime64(ns, 'ns')}Z"


def load(job: Job, score: bool = True, why: str = "", missing_inputs: bool = False) -> Loaded:
    """Read a model and a log.

    Args:
        job: What to read.
        score: Whether a reference for the velocities is made from the positions where the log has no true ones.
        why: What mechanical models are needed for, where they are.
        missing_inputs: Whether inputs may be missing, which an estimate runs over.

    Returns:
        Model and log, with the acting inputs.

    Raises:
        MisfitError: Where the log does not fit the model at all.
        ValueError: With one line for whoever gave the model or the log; `OSError` where one cannot be read.
    """
    file = models.load(job.model, job.overrides)
    model: Any = file.need_mechanical(job.model_name, why) if why else file.model
    columns = columns_of(job, file)
    _check_columns(job, file, columns)
    file = file._replace(columns=columns)
    # Columns that the model file names may be absent from this log; those that the caller names may not.
    optional = [field for field in logs.OPTIONAL if not job.columns.get(field)]
    parts = file_sensors(file)
    sensors = [(part.columns, part.unit) for part in parts]
    kind = kind_of(file)
    part, periods = (job.every, job.until, job.start), periods_of(job, file)
    # In a closed loop a few encoders tell all positions.
    absent = columns.q if file.mechanical and model.manifold.redundant else ()
    log = kind.with_inputs(logs.read(job.log, columns, *part, optional, sensors, periods, missing_inputs, absent))
    # Lag, delay and means are those of the whole log: what was cut off or left out between two rows acts in them too.
    lagging = _around_missing(lambda whole: lag_inputs(whole, file.input_lag), log.all_rows, MOST_MISSING)

    def acting(whole: Record) -> Record:
        return acting_inputs(whole, file.input_between, file.input_delay, log.record, file.input_lead)

    record = _around_missing(acting, lagging)
    if not job.anyway:
        whole = kind.complete(np.asarray(record.y))
        known = log._replace(record=_with_inputs_only(log.record._replace(y=whole)))
        try:
            _refuse_misfit(job, file, known, _with_inputs_only(record._replace(y=whole)))
        except MisfitError as error:
            raise _at_dead_centre(job, kind, file.columns.q, record, whole, error) or error from None
    t, y = np.asarray(record.t), np.asarray(record.y)
    try:
        kind.check(y)
    except InputError as error:
        raise InputError(f"{job.model_name} on {job.log_name}: {error}") from error
    file, note = _in_ticks(file, y)
    known = None if log.truth is None else (log.truth, f"true {kind.what}")
    if known is None and score:
        known = kind.slopes(log)
    reference = None if known is None else ReferenceVelocity(*known, scoring.scored_window(t))
    sensed, lacking = readings(parts, log) if parts else (None, "")
    guessed = placeholder_sentence(placeholders(job.model, job.overrides))
    note += _delay_note(file) + lacking + f" {guessed}" * bool(guessed)
    # The median interval, so that a gap does not change the rate; with sensors that of the rows with positions.
    measured = np.isfinite(y.reshape(len(y), -1)).any(1)
    rate = 1 / float(np.median(np.diff(t[measured] if parts and measured.sum() > 1 else t)))
    return Loaded(file, model, log, record, rate, reference, note, () if sensed is None else parts, sensed)


def _with_inputs_only(record: Record) -> Record:
    """The rows of a record whose inputs are known."""
    known = np.isfinite(np.asarray(record.u)).all(1)
    if known.all():
        return record
    if known.sum() < 2:
        raise InputError("fewer than two rows have all inputs; name other columns of u")
    rows = (None if part is None else np.asarray(part)[known] for part in (record.t, record.u, record.y))
    return Record(*rows)


def _around_missing(change: Callable[[Record], Record], record: Record, share: float = LEAST_MISSING) -> Record:
    """A record with changed inputs, NaN where more than a share of one depends on inputs that are missing."""
    u = np.asarray(record.u, float)
    absent = ~np.isfinite(u)
    if not absent.any():
        return change(record)
    held = last_known(u)
    held = np.where(np.isfinite(held), held, 0.0)
    changed, part = (change(record._replace(u=each)) for each in (held, absent.astype(float)))
    return changed._replace(u=np.where(np.abs(np.asarray(part.u)) > share, np.nan, np.asarray(changed.u)))


def last_known(u: np.ndarray) -> np.ndarray:
    """Inputs (T, m) with the last known one in place of one that is missing; NaN before the first."""
    at = np.maximum.accumulate(np.where(np.isfinite(u), np.arange(len(u))[:, None], 0), axis=0)
    return np.take_along_axis(u, at, axis=0)


def periods_of(job: Job, file: models.ModelFile) -> tuple[float, ...]:
    """The period of each position of a log, 0 for none; empty where none has one."""
    if not np.any(file.period):
        return ()
    if not file.model.manifold.commuting:
        raise InputError(f"{job.model_name}: measurement.period is for coordinates, and this model is on a group")
    return tuple(np.broadcast_to(file.period, len(file.columns.q)).tolist())


def columns_of(job: Job, file: models.ModelFile) -> logs.Columns:
    """The columns of a model file, with those that are named otherwise."""
    named = {key: names for key, names in job.columns.items() if names is not None}
    return file.columns._replace(**{k: str(n).strip() if k == "t" else column_names(n) for k, n in named.items()})


def column_names(columns: str | Sequence[str]) -> tuple[str, ...]:
    """Convert names of columns to a tuple."""
    return tuple(name.strip() for name in columns.split(",") if name) if isinstance(columns, str) else tuple(columns)


def with_sensor_delays(observers: Mapping[str, AbstractObserver], loaded: Loaded) -> dict[str, AbstractObserver]:
    """Make observers account for the delay of the log's positions.

    Filters without a model take a reading as current: as in a drive, their velocities are late by the same time.
    """
    sensors = max((part.delay for part in loaded.sensors), default=0.0)
    longest = max(float(np.max(loaded.file.delay)), sensors)
    if longest == 0:
        return dict(observers)
    if not loaded.kind.makes_up_for_delays:
        only = "mechanical models and bases on legs only"
        raise InputError(f"{loaded.file.name}: readings that are late are made up for in {only}")
    rate = densest_rate(np.asarray(loaded.record.t), longest)
    wrapped = dict(observers)
    for name, observer in observers.items():
        y = np.asarray(loaded.record_for(observer).y)[0]
        delay = reading_delays(observer, loaded.file.delay, loaded.sensors, y)
        if name in INFORMED and np.any(delay):
            wrapped[name] = Delayed(observer, delay, rate)
    return wrapped


def densest_rate(t: np.ndarray, time: float) -> float:
    """The rate [Hz] of the most samples in any interval of a time [s], so that all of them fit a memory of it."""
    within = np.searchsorted(t, t + time, side="right") - np.arange(len(t))
    return float(within.max()) / time


def refuse_delays(job: Job, loaded: Loaded, observer: AbstractObserver, why: str) -> None:
    """Refuse a log whose positions, or readings of the sensors of an observer, are late."""
    delays = {"measurement.delay": loaded.file.delay}
    if observer.sensors:
        delays |= {f"sensors.{part.sensor.name}.delay": part.delay for part in loaded.sensors}
    late = {key: delay for key, delay in delays.items() if np.any(delay)}
    if late:
        named = ", ".join(f"{key} = {delay}" for key, delay in late.items())
        settings = [f"{key}=0" for key in late]
        raise InputError(
            f"{job.model_name}: {why} ({named}); shift the positions, or what the sensors read, in the log to when "
            f"they were true, and give `overrides={settings}`"
        )


def with_acting_inputs(
    observer: AbstractObserver, file: models.ModelFile, rate: float, log: Loaded | None = None
) -> AbstractObserver:
    """Make an observer take inputs as they are sent, and hold those that act later, as `load` does in a log.

    It is for samples at a rate [Hz], or for those of a log as well.
    """
    stated: Any = {"delay": file.input_delay, "lag": file.input_lag, "lead": file.input_lead}
    count = len(file.columns.u)
    if not count or (file.input_between == "held" and not any(map(np.any, stated.values()))):
        return observer
    longest = float(np.max(file.input_delay))
    if log is not None and longest:
        rate = max(rate, densest_rate(np.asarray(log.record.t), longest))
    return ActingInputs(observer, rate, between=file.input_between, inputs=count, **stated)


def describe_inputs(file: models.ModelFile) -> str:
    """Say how inputs are passed to a step, and when they act."""
    stated = {"delay": file.input_delay, "lag": file.input_lag, "lead": file.input_lead}
    times = [f"{name} {_in_ms(value)} ms" for name, value in stated.items() if np.any(value)]
    linear = file.input_between == "linear"
    when = "ends at its stamp, and linear in between" if linear else "begins at its stamp"
    held = f"; the step has their {', '.join(times)}" if times else ""
    return f"Inputs are passed as they are sent, each to the step that {when}{held}."


def _delay_note(file: models.ModelFile) -> str:
    """A sentence that says how late positions are, where they are."""
    return f" Positions are read {_in_ms(file.delay)} ms late." if np.any(file.delay) else ""


def _in_ms(times: Amounts) -> str:
    return ", ".join(f"{1e3 * each:g}" for each in np.atleast_1d(np.asarray(times, float)))


def _refuse_misfit(job: Job, file: models.ModelFile, log: logs.Log, record: Record) -> None:
    """Raise `MisfitError` where the model explains nothing of the motion, or another unit of the log explains it."""
    if file.model.feet is not None:  # the ground's forces explain it, and are not in the log
        return
    if log.whole is None:
        finding = misfit(file, log.record)
    else:  # the inputs that act in the rows of a part of a log are known from the whole of it
        finding = misfit(file._replace(input_lag=0.0, input_delay=0.0, input_lead=0.0, input_between="held"), record)
    if finding is not None and not (job.fits and FITTED.issuperset(finding.what.split(" and "))):
        how = f"`covariant check {job.model_name} {job.log_name}` looks closer, and `anyway=True` goes on"
        guessed = placeholder_sentence(placeholders(job.model, job.overrides))
        raise MisfitError(f"{job.log_name}: {finding.evidence}. {finding.line}; {how}{guessed and '. '}{guessed}")


def _at_dead_centre(
    job: Job, kind: Any, columns: Sequence[str], record: Record, whole: np.ndarray, error: MisfitError
) -> MisfitError | None:
    """The error where the joints with an encoder run into a dead centre, so that the others are not known after it."""
    y = np.asarray(record.y)
    row = kind.dead_centre(y, whole)
    if row is None:
        return None
    lacking, names = np.isnan(y).all(axis=0), np.array(columns)
    measured, others = (", ".join(names[mask]) for mask in (~lacking, lacking))
    at = float(record.t[row] - record.t[0]) + (job.start or 0.0)
    return MisfitError(
        f"{job.log_name}: {at:.3g} s after its start the linkage is at a dead centre of {measured}, where they say "
        f"nothing about {others}, and the motion can go on in two ways; measure another joint too, or end the log "
        f"before, as by `until={0.98 * at:.3g}`. Otherwise: {str(error).removeprefix(f'{job.log_name}: ')}"
    )


def _in_ticks(file: models.ModelFile, y: np.ndarray) -> tuple[models.ModelFile, str]:
    """The model file without its quantum where positions (T, n) are no whole ticks apart, and a sentence saying so."""
    if file.quantum is None or not kind_of(file).has_ticks:
        return file, ""
    quantum = np.broadcast_to(file.quantum, y.shape[1])
    steps = np.diff(y, axis=0) / quantum
    names = file.columns.q if len(file.columns.q) > 1 else ("",)
    for name, tick, column in zip(names, quantum, steps.T, strict=True):
        fault = _off_ticks(tick, column[np.isfinite(column)])
        if fault:
            return _as_noisy(file, f"Positions{' of ' * bool(name)}{name} {fault}")
    count = np.count_nonzero(np.round(np.nan_to_num(steps)))
    if count >= FEWEST_MOVES and _reversals(steps) > MOST_REVERSALS:
        shown = ", ".join(f"{tick:.4g}" for tick in dict.fromkeys(quantum))
        return _as_noisy(file, f"Positions go back and forth between ticks of {shown} as noise does")
    return file, ""


def _off_ticks(quantum: float, steps: np.ndarray) -> str:
    """How the changes of one position, in ticks, differ from whole ticks of an encoder; "" where they do not."""
    ticks = np.abs(np.round(steps))
    ticks = ticks[ticks > 0]
    if ticks.size == 0:
        return ""
    least = np.quantile(ticks, 0.01, method="lower")  # not the minimum, which a single outlier decides
    # A quantile: single wrong cells are off by anything.
    if np.quantile(np.abs(steps - np.round(steps)), 0.95) >= OFF_TICK:
        return f"are not whole ticks of {quantum:.4g} apart"
    # All changes are multiples of several ticks: the encoder's tick is that multiple, and `quantum` is too fine.
    if least > 1 and ticks.size >= FEWEST_MOVES and np.mean(ticks % least == 0) > 0.95:
        return f"are multiples of {least:.0f} ticks of {quantum:.4g} apart"
    return ""


def _as_noisy(file: models.ModelFile, fault: str) -> tuple[models.ModelFile, str]:
    """The model file without its quantum, and a sentence that says why."""
    return file._replace(quantum=None), f" {fault}: they are taken as noisy, not as ticks."


def _reversals(steps: np.ndarray) -> float:
    """How many of the changes of positions, in ticks (T, n), undo one at most `QUICK` samples before, as a fraction."""
    count = undone = 0
    for column in np.nan_to_num(np.round(steps)).T:
        at = np.flatnonzero(column)
        turned = (np.sign(column[at[1:]]) != np.sign(column[at[:-1]])) & (np.diff(at) <= QUICK)
        count, undone = count + len(at), undone + int(turned.sum())
    return undone / max(count, 1)


def _check_columns(job: Job, file: models.ModelFile, columns: logs.Columns) -> None:
    """Check the number of columns, that the representation of an attitude is given, and that names are unique."""
    if columns.q and not file.columns.q:
        raise InputError(
            f'`columns["q"]` names coordinates, and {job.model_name} is on a group; name its columns in [columns] '
            "or by `overrides`"
        )
    if len(columns.q) != len(file.columns.q) or len(columns.u) != len(file.columns.u):
        raise InputError(
            f"{job.model_name} has {len(file.columns.q)} positions and {len(file.columns.u)} inputs; "
            f"`columns` name {len(columns.q)} and {len(columns.u)}"
        )
    if file.model.manifold.commuting:
        return
    if file.unnamed_attitudes:
        raise InputError(
            f"{job.model_name}: no columns of the attitude are named, and their order is never guessed; give one of "
            f"{', '.join(logs.ATTITUDES)} in [columns], or "
            """`overrides=['columns.quaternion_wxyz=["qw","qx","qy","qz"]']`"""
        )
    shared = {"t", *file.model.velocities} & set(columns.measured)
    if shared:
        raise InputError(
            f"{job.model_name}: the estimate would have two columns named {min(shared)!r}; rename the one in the log"
        )


def coordinates(file: models.ModelFile) -> Labels:
    """Names and units for headings: of coordinates; on a group of velocities; of states."""
    return kind_of(file).axes
