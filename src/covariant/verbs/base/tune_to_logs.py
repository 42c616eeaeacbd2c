"""Computes the tuning of noise and gains to logs, and what it says of the model."""

from collections.abc import Mapping, Sequence
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from covariant import models
from covariant.calibration import DataSheet, ErrorRatio, Tuning, estimators, tune, tuned_estimators, usual_speeds
from covariant.engine import EngineName, run_logs
from covariant.observers import AbstractObserver
from covariant.report import EstimateReport
from covariant.signals import Record, Run
from covariant.verbs.base.aligned import aligned
from covariant.verbs.base.design import design
from covariant.verbs.base.inputs import Job, Loaded, coordinates, data_sheet, tells_noise, with_sensor_delays
from covariant.verbs.base.kinds import WITH_FORCE
from covariant.verbs.base.model_output import check_read_once
from covariant.verbs.base.model_text import advice
from covariant.verbs.base.outcome import Outcome, drive, rounded
from covariant.verbs.base.pages import estimate_report
from covariant.verbs.base.presliding import changed_keys, judge_innovations, likeliest_presliding, short
from covariant.verbs.base.progress import Progress
from covariant.verbs.base.trial import judging_reference
from covariant.verbs.base.without_model import WithoutModel, without_model
from scalargraph.errors import InputError

COARSER = 1.5
"""Readings whose noise is more than so many times that of their ticks are taken as noisy, not as ticks."""
SEARCHED = 60
"""Approximate number of runs of a search for gains."""
NOT_WHITE = 0.3
"""Correlation of neighbouring innovations from which a warning says that the model does not explain them."""
STAGES = ("gains", "noise", "held-out rows", "observers")
KALMAN = ("intrinsic-kalman", "ekf")
"""Filters that take the noise; the first one may become the default."""
FITTED, FEWEST = 2 / 3, 100
"""Part of a log that tunes, and the rows without holes that suffice to judge by."""
"""What a tuning does, in order."""


class Tuned(NamedTuple):
    """Tuning of a model to logs, with what it was computed from.

    Attributes:
        loaded: Model and log of each job.
        tuning: Gains and noise.
        before: The data sheet of the model file; None where that lacks noise.
        content: Content of the new model file; empty where the model has no file.
        details: All numbers and sentences as plain data.
    """

    loaded: list[Loaded]
    tuning: Tuning
    before: DataSheet | None
    content: dict[str, Any]
    details: dict[str, Any]


def tune_to_logs(jobs: list[Job], engine: EngineName, progress: Progress, sources: Mapping[Path, bytes]) -> Tuned:
    """Tune noise and gains on the first two thirds of each log, and judge them on the rest.

    `sources` are the files of the model as they were first read.
    """
    progress("reading", 0.0)
    has_file = isinstance(jobs[0].model, str | PathLike)
    content = models.document(jobs[0].model_name, jobs[0].overrides) if has_file else {}
    loaded, delay = [aligned(job).loaded for job in jobs], models.load(jobs[0].model, jobs[0].overrides).delay
    check_read_once(sources)  # from here on no file of the model is read
    loaded = [one._replace(reference=judging_reference(one)) for one in loaded]
    file = loaded[0].file
    before = data_sheet(file) if tells_noise(file) else None
    # No reading is better than the rounding to its ticks.
    known = None if file.quantum is None else np.broadcast_to(np.asarray(file.measurement_std), file.dimension)
    records, velocities = [one.record for one in loaded], [one.reference.v for one in loaded if one.reference]
    runs = _Runs(engine)

    def report(stage: str) -> None:
        progress(stage, (1 + STAGES.index(stage)) / (1 + len(STAGES)))

    try:
        names, model = [Path(job.log_name).name for job in jobs], loaded[0].model
        more = {"runs": runs, "names": names, "uncertain": file.family}
        tuning = tune(model, records, velocities, std=known, before=before, progress=report, **more)
    except InputError as error:
        raise InputError(f"{', '.join(job.log_name for job in jobs)}: {error}") from error
    report("observers")
    confirmed = confirm(loaded, tuning)
    progress("done", 1.0)
    details = _details(jobs, loaded, delay, confirmed) | {"engine": runs.description}
    return Tuned(loaded, confirmed.tuning, before, _with_tables(content, confirmed.tables) if has_file else {}, details)


def tuned_page(title: str, job: Job, tuned: Tuned, notes: tuple[str, ...], **more: Any) -> EstimateReport:
    """Collect a page of the constant-gain observer on the last log, before and after."""
    loaded, tuning = tuned.loaded[-1], tuned.tuning
    typical = float(np.sqrt(np.mean(np.asarray(tuning.noise.measurement) ** 2)))
    sheet = tuned.before or DataSheet(typical, float(tuning.noise.acceleration))
    # Behind the gate that `estimate` has: an outlier is drawn as what it does there.
    sheet = sheet._replace(speed=usual_speeds(loaded.model, loaded.record))
    chosen = {key: getattr(tuning, key) for key in ("natural_frequency", "damping", "force_rate")}
    sheets = {"after": sheet._replace(**chosen)}
    if tuned.before is not None:
        sheets = {"before": sheet, **sheets}
    name, n = "intrinsic-force", loaded.file.dimension
    tuned_to = {
        when: tuned_estimators(loaded.model, n, each, loaded.rate, names=(name,)) for when, each in sheets.items()
    }
    observers = with_sensor_delays({when: each[name] for when, each in tuned_to.items()}, loaded)
    runs = {when: drive(observer, loaded) for when, observer in observers.items()}
    return estimate_report(title, job, loaded, runs, notes, {"drawn": f"{name}, on {job.log_name}"}, **more)


class Confirmed(NamedTuple):
    """A tuning whose filters are no worse than before on held-out rows, and the lines to write.

    Attributes:
        tuning: The tuning, with the noise of the model file where a filter is worse with another one.
        tables: What is written into the model file, by table and key.
        beside: Judges the default observer beside the best filter without a model on held-out rows of the longest log,
            or says why that is impossible.
        in_holes: Judges the Kalman filter beside another default on held-out rows in holes and soon after them.
    """

    tuning: Tuning
    tables: dict[str, dict[str, Any]]
    beside: WithoutModel | str
    in_holes: ErrorRatio | None = None


def confirm(loaded: list[Loaded], tuning: Tuning) -> Confirmed:
    """Keep the old noise if the best filter is worse with the new one, and choose the default.

    That is the Kalman filter where it is clearly better on held-out rows than constant gains, which cost less.
    """
    file, rate = loaded[0].file, loaded[0].rate
    filters = [name for name in KALMAN if name in estimators(file.model)]
    rows, true = [_held_out(one) for one in loaded], [one.reference.v for one in loaded if one.reference]

    def outcomes(file: models.ModelFile, name: str) -> list[Outcome]:
        observers = [design(file, name, rate=one.rate, log=one._replace(file=file)).observer for one in loaded]
        return [drive(each, one._replace(file=file)) for each, one in zip(observers, loaded, strict=True)]

    def judge(new: list[Outcome], old: list[Outcome], among: list[np.ndarray] = rows) -> ErrorRatio:
        runs = ([each.velocity for each in both] for both in (new, old))
        parts = ([v[at] for v, at in zip(each, among, strict=True)] for each in (*runs, true))
        return ErrorRatio.of_velocities(*parts)

    def least(known: dict[str, list[Outcome]]) -> list[Outcome]:
        return min(known.values(), key=lambda each: judge(each, each).error)

    tables = _tables(file, tuning, rate)
    new = tuned_file(file, tables)
    known = {name: outcomes(new, name) for name in filters}
    if filters and tells_noise(file) and not tuning.noise_kept:
        old = {name: outcomes(file, name) for name in filters}
        if judge(least(known), least(old)).is_worse:
            before, after = tuning.before or tuning.after, tuning.after
            relative = np.array([after.relative[0], before.relative[1]])
            after = before._replace(one_step=after.one_step, gains_error=after.gains_error, relative=relative)
            tuning, known = tuning._replace(noise_kept="velocities", after=after), old
            tables = _tables(file, tuning, rate)
            new = tuned_file(file, tables)
    default, best = WITH_FORCE if tuning.force_rate else estimators(file.model)[0], KALMAN[0]
    of_default = outcomes(new, default)
    in_holes = None
    if best in filters:
        filtered = known[best]
        takes_default = judge(filtered, of_default).is_better
        turned = likeliest_presliding(new, lambda file: outcomes(file, best), FITTED)
        # A reference from smoothed positions is no judge of reversals, where it rounds the corners of velocities.
        predicts = partial(judge_innovations, rows=rows, std=new.measurement_std)
        if turned is not None and predicts(found := outcomes(turned, best), filtered).is_better:
            tables["uncertainty"] = tables.get("uncertainty", {}) | changed_keys(turned, new)
            new, filtered, takes_default = turned, found, not predicts(found, of_default).is_worse
        default, of_default = (best, filtered) if takes_default else (default, of_default)
        in_holes = judge(filtered, of_default, [_held_out(one, in_holes=True) for one in loaded])
    tables["design"]["observer"] = default
    longest = max(range(len(loaded)), key=lambda k: len(of_default[k].velocity))
    one = loaded[longest]._replace(file=new)
    return Confirmed(tuning, tables, without_model(one, of_default[longest].velocity, _held_out(one)), in_holes)


def _held_out(one: Loaded, in_holes: bool = False) -> np.ndarray:
    """Rows (T,) of a log that did not tune it: the last third, in holes alone or without them if enough are left."""
    t, reference = np.asarray(one.record.t), one.reference
    assert reference is not None
    late = reference.scored & (t >= t[0] + FITTED * (t[-1] - t[0])) & np.isfinite(reference.v).all(axis=1)
    concerned = np.zeros_like(late) if one.holes is None else one.holes.concerned
    clear = late & ~concerned
    return late & concerned if in_holes else clear if clear.sum() >= FEWEST else late


def tuned_file(file: models.ModelFile, tables: dict[str, dict[str, Any]]) -> models.ModelFile:
    """The model file with the tuned numbers."""
    pairs = {f"{table}.{key}": value for table, numbers in tables.items() for key, value in numbers.items()}
    if "correlation_time" in tables.get("uncertainty", {}):
        file = file._replace(torque_std=None, external_force=None, external_force_std=None, external_force_time=None)
    file = file._replace(force_rate=None, quantum=None if "measurement" in tables else file.quantum)
    return models.load(file, pairs)


class _Runs:
    """Runs of observers with constant gains; `description` is the engine, with the reason where it is JAX."""

    def __init__(self, engine: EngineName):
        self.engine: EngineName = engine
        self.description = ""
        self._first: Sequence[AbstractObserver] = ()

    def __call__(self, observers: Sequence[AbstractObserver], records: Sequence[Record]) -> list[Run]:
        self._first = self._first or observers
        runs, self.description = run_logs(observers, records, ("innovation",), self.engine, self._first, SEARCHED)
        return runs


def _tables(file: models.ModelFile, tuning: Tuning, rate: float) -> dict[str, dict[str, Any]]:
    """What is written into the model file, by table and key; no noise where that of the file is kept."""
    design = {"damping": short(tuning.damping), "natural_frequency": short(tuning.natural_frequency)}
    if tuning.force_rate:
        design["force_rate"] = short(tuning.force_rate)
    if tuning.noise_kept:
        return {"design": design}
    time = file.correlation_time or short(1 / (2 * rate))
    # A deviation σ that persists over the time τ acts as white noise of the density σ √(2τ).
    acceleration = float(tuning.noise.acceleration) / np.sqrt(2 * time)
    uncertainty = {"acceleration": short(acceleration), "correlation_time": time}
    uncertainty |= _force(file, tuning) | ({"parameters_drift": short(tuning.drift)} if tuning.drift else {})
    tables: dict[str, dict[str, Any]] = {"uncertainty": uncertainty, "design": design}
    # Rounding to ticks has a uniform error, of the standard deviation quantum/√12.
    ticks = np.inf if file.quantum is None else np.asarray(file.quantum) / np.sqrt(12)
    if file.quantum is None or np.any(np.asarray(tuning.noise.measurement) > COARSER * ticks):
        tables = {"measurement": {"std": short(np.asarray(tuning.noise.measurement))}, **tables}
    return tables


def _force(file: models.ModelFile, tuning: Tuning) -> dict[str, Any]:
    """The external force, as a random walk or one that is forgotten; nothing where there is none."""
    force, time = np.asarray(tuning.noise.force), float(tuning.noise.force_time)
    if not force.any():
        return {}
    if not np.isfinite(time):
        return {"external_force": short(force)}
    return {"external_force_std": short(np.broadcast_to(force, file.dimension)), "external_force_time": short(time)}


def _with_tables(content: dict[str, Any], tables: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The content of the model file with the tuned numbers; without an external force unless the tuning has one."""
    for table, numbers in tables.items():
        content.setdefault(table, {}).update(numbers)
    # The tuned acceleration holds what was torque; a distance alone changes none of the others.
    whole = {table for table in tables if table != "uncertainty" or "correlation_time" in tables[table]}
    optional = {"uncertainty": ("torque", "external_force", "external_force_std", "external_force_time")}
    for table, keys in (optional | {"design": ("force_rate",)}).items():
        for key in set(keys) - set(tables[table]) if table in whole else ():
            content[table].pop(key, None)
    # std stands in its place: a model file may not have both.
    if "measurement" in tables:
        content["measurement"].pop("quantum", None)
    return content


def _details(jobs: list[Job], loaded: list[Loaded], delay: Any, confirmed: Confirmed) -> dict[str, Any]:
    (names, units), (tuning, tables, beside, _) = coordinates(loaded[0].file), confirmed
    return {
        "model": jobs[0].model_name,
        "logs": [job.log_name for job in jobs],
        "rows": tuning.rows,
        "scored_against": loaded[0].reference.label if loaded[0].reference else None,
        "lines": tables,
        "coordinates": list(names),
        "velocities": list(loaded[0].model.sought.names or (f"d{name}/dt" for name in names)),
        "units": [unit.removesuffix("/s") for unit in units],
        "held_out": {
            when: None
            if judged is None
            else {key: rounded(np.atleast_1d(each)) for key, each in judged._asdict().items()}
            for when, judged in (("before", tuning.before), ("after", tuning.after))
        },
        "without_model": beside if isinstance(beside, str) else beside.data,
        "gains": {
            "from": tuning.source,
            "same": None if tuning.same is None else [short(each) for each in tuning.same],
            "candidates": [_round_numbers(each._asdict()) for each in tuning.candidates],
        },
        "notes": notes(confirmed),
        "warning": warning(
            confirmed,
            np.atleast_1d(np.equal(delay, np.max(delay))),
            advice(jobs[0].model, fit="run `covariant fit`") or "look for what it lacks by `covariant check`",
        ),
    }


def _round_numbers(numbers: dict[str, Any]) -> dict[str, Any]:
    return {key: value if isinstance(value, str) else short(value) for key, value in numbers.items()}


def notes(confirmed: Confirmed) -> list[str]:
    """Say where the gains are from, what was kept, which observer is the default, and whether the model helps."""
    found = confirmed.tuning
    said = []
    if found.candidates:
        named = ", ".join(f"{each.source} {short(each.smoothed):g}" for each in found.candidates)
        said.append(
            f"Gains: {found.source}. Distances of held-out velocities to those of a smoother, as fractions of the "
            f"velocity: {named}."
        )
        near = [each.source for each in found.candidates if each.ties]
        if len(near) > 1:
            said.append(f"By the rows after each alone these cannot be told apart: {', '.join(near)}.")
    if found.same is not None:
        low, high = (f"{short(each):g}" for each in found.same)
        said.append(f"Gains with a natural frequency between {low} and {high} rad/s are as good within 2 %, or better.")
    if found.gains_kept:
        said.append(
            "Other gains seemed better, but had a larger velocity error on held-out rows; those of the model file are "
            "kept."
        )
    elif found.source == "model file":
        said.append(
            "No other gains give clearly better held-out velocities than those of the model file, which are kept."
        )
    if found.noise_kept:
        why = "readings are likelier" if found.noise_kept == "likelihood" else "velocities are better"
        said.append(f"Held-out {why} with the noise of the model file, which is kept.")
    if "presliding" in confirmed.tables.get("uncertainty", {}):
        said.append("Held-out readings are predicted clearly better if Coulomb friction turns over a distance.")
    default, beside = confirmed.tables["design"]["observer"], confirmed.beside
    why = (
        "which is clearly better than constant gains" if default in KALMAN else "than which no filter is clearly better"
    )
    said.append(f"The default observer is {default}, {why}.")
    if confirmed.in_holes is not None and confirmed.in_holes.is_better:
        times = confirmed.in_holes.error / confirmed.in_holes.other
        said.append(f"After holes the error of {KALMAN[0]} is {times:.2g} times as large: take it for logs with holes.")
    if isinstance(beside, str) or not beside.verdict.is_worse:
        said.append(f"{beside if isinstance(beside, str) else beside.sentence(default)}.")
    return said


def warning(
    confirmed: Confirmed, as_logged: np.ndarray | bool = True, remedy: str = "run `covariant fit`"
) -> str | None:
    """Warn in one line of a model that is no better than none, or does not explain the innovations."""
    found, default, beside = confirmed.tuning, confirmed.tables["design"]["observer"], confirmed.beside
    if not isinstance(beside, str) and beside.verdict.is_worse:
        return f"the model does not help here: {beside.sentence(default)}; {remedy}"
    worst = float(np.max(np.abs(found.after.correlation) * as_logged))
    if worst > NOT_WHITE:
        return f"the innovations are not white (correlation {worst:.2f}), so the model is wrong somewhere; {remedy}"
    return None
