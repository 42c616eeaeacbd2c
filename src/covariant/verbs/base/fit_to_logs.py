"""Computes a fit to logs: reads them, solves with held and with linear inputs, and judges on what is held out."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant import models, scoring
from covariant._linalg import known_rms
from covariant._names import refuse_unknown
from covariant.calibration import Fit, PredictionErrors, RobotFit, fit_robot, relations
from covariant.calibration.identification import (
    FITTED,
    Rows,
    Solved,
    Unknowns,
    again,
    better_reading,
    block_losses,
    error_growth,
    fit_servos,
    gather,
    held_out_rows,
    predict_servos,
    predicts_worse,
    profile,
    robot_misfit,
    search,
    standing_still,
    window_errors,
)
from covariant.signals import Record
from covariant.verbs.base.aligned import Aligned
from covariant.verbs.base.fit_logs import BETWEEN, FitLogs, OwnNumbers, refuse_other_parameters
from covariant.verbs.base.fit_sentences import (
    number_rows,
    rival_sentence,
    robot_details,
    servo_details,
    start_sentence,
    unlike_servos,
)
from covariant.verbs.base.inputs import Job, MisfitError, coordinates
from covariant.verbs.base.model_output import check_read_once
from covariant.verbs.base.outcome import rounded
from covariant.verbs.base.placeholders import placeholders
from covariant.verbs.base.progress import Progress
from scalargraph.errors import InputError

DIGITS = 7
"""Significant digits of fitted numbers in a model file."""
CLEAR = 2.0
"""Standard errors by which held or linear inputs must explain a log better than the other ones to be preferred."""
ROUNDS, STEPS, ROBOT_ROUNDS = 8, 25, 12
"""Rounds of a search and the most steps in one, and the usual number of rounds for a robot, for the progress."""


def fit_to_logs(
    jobs: list[Job],
    names: Sequence[str],
    length: float | None,
    progress: Progress,
    sources: Mapping[Path, bytes],
    own: OwnNumbers | None = None,
) -> tuple[list[Job], dict[str, dict[str, Any]], dict[str, Any]]:
    """Fit parameters of a model, or numbers of a robot, to logs, and judge the fit on what is held out.

    `sources` are the files of the model as they were first read. The contents of model files are by the machine whose
    own numbers they have, or by "".
    """
    progress("reading")
    kind = _kind_of(jobs[0], names)
    problem = kind.read(jobs, names, length, own)
    logs, guessed = problem.logs, placeholders(jobs[0].model, jobs[0].overrides)
    check_read_once(sources)  # from here on no file of the model is read
    try:
        parts = {word: _Part.of(problem, word) for word in logs.tried}
        fits = _solve(problem, parts, progress)
    except InputError as error:
        raise InputError(f"{', '.join(logs.names)}: {error}") from error
    progress("errors on what is held out", 1.0)
    gain = problem.gain(fits) if len(fits) > 1 else None
    used = "linear" if gain is not None and gain.clear and gain.of_linear > 0 else logs.tried[0]
    best, part = fits[used], parts[used]
    # Before the fit no way between stamps was chosen: the first is the one that the model file would use.
    before = problem.errors(None, parts[logs.tried[0]])
    after = problem.errors(best, part)
    progress("other readings of the log", 1.0)
    suspicion = problem.suspicion(best, part)
    better = not predicts_worse(before, after) and not suspicion
    found: Any = problem.ended(best, part if better else None)
    values = np.array([float(f"{value:.{DIGITS}g}") for value in found.values])[problem.family.parts]
    contents = {
        machine: problem.family.with_values(part) for machine, part in zip(problem.machines, values, strict=True)
    }
    for content in contents.values():
        source = content.get("parameters", {}).get("source")
        if isinstance(source, str):  # a text that says where the numbers are from says where they are from now
            content["parameters"]["source"] = f"fitted to {logs.fitted_to} from first values of: {source}"
        if gain is not None and gain.clear:
            content.setdefault("inputs", {})["between"] = used
    details = _details(jobs[0], logs, guessed, found, before, after, suspicion) | {
        "inputs": _input_details(used, logs.stated, gain)
    }
    details |= problem.details(found)
    if (origin := logs.logs[0].loaded.origin) is not None:
        details["t_counts_from"] = origin
    # A log that is misread says nothing of what it determines.
    return jobs, contents, details | ({"undetermined": [], "unlike": []} if suspicion else {})


class _Part(NamedTuple):
    """All rows of the logs with one way of inputs between stamps, and which (T,) are held out."""

    rows: Rows
    judged: Bool[np.ndarray, "T"]

    @classmethod
    def of(cls, problem: "_Problem", word: str) -> "_Part":
        logs = problem.logs
        records = [problem.acting(log, word) for log in logs.logs]
        rows = gather(logs.logs[0].loaded.model.manifold, records, logs.references, logs.machines)
        stamps = [np.asarray(record.t) for record in records]
        return cls(rows, held_out_rows(rows, stamps, logs.length, logs.machines))


def _solve(problem: "_Problem", parts: dict[str, _Part], progress: Progress) -> dict[str, Any]:
    """The fit for each way of inputs between stamps, each search from where the one before ended."""
    tried = problem.logs.tried
    fits: dict[str, Any] = {}
    start: Any = None
    for k, word in enumerate(tried):

        def report(done: int, fraction: float, k: int = k, word: str = word) -> None:
            which = f" with {word} inputs" if len(tried) > 1 else ""
            progress(f"round {done + 1}{which}", (k + fraction) / len(tried))

        start = fits[word] = problem.fit(word, parts[word], start, report)
    return fits


class Gain(NamedTuple):
    """Log-likelihood with linear inputs minus that with held ones, and its standard error."""

    of_linear: float
    standard_error: float

    @classmethod
    def of(cls, less: Float[np.ndarray, "B"]) -> "Gain":
        """The gain from what linear inputs lower the negative log-likelihood by in each of B independent parts."""
        # The variance of a sum of independent terms is their number times that of one; errors may be correlated within.
        return cls(float(np.sum(less)), float(np.sqrt(len(less)) * np.std(less, ddof=1)))

    @property
    def clear(self) -> bool:
        """Whether the gain exceeds `CLEAR` standard errors."""
        return abs(self.of_linear) > CLEAR * self.standard_error


class _PredictionProblem(NamedTuple):
    """Parameters of a model, fitted by the likelihood of logs."""

    family: models.Family
    logs: FitLogs
    machines: list[str]

    @classmethod
    def read(
        cls, jobs: list[Job], names: Sequence[str], length: float | None, own: OwnNumbers | None = None
    ) -> "_PredictionProblem":
        refuse_other_parameters(jobs, ("between", "lag"))
        family, machines, of_log = models.family(jobs[0].model_name, names, jobs[0].overrides), [""], None
        if own is not None:
            machines, of_log = own.numbered
            try:
                family = family.of_machines(machines, own.names)
            except InputError as error:
                raise InputError(f"each: {error}") from error
        return cls(family, FitLogs.read([job._replace(fits=True) for job in jobs], length, of_log), machines)

    def acting(self, log: Aligned, between: str) -> Record:
        """The record with the inputs that act in each step, without their lag, which may be fitted."""
        return log.acting(between)

    def fit(self, word: str, part: _Part, start: Solved | None, report: Callable[[int, float], None]) -> Solved:
        del word

        def progress(done: int, step: int) -> None:
            report(done, min((done + step / STEPS) / ROUNDS, 1.0))

        begin = None if start is None else start.fit.values
        quantum = self.logs.logs[0].loaded.file.quantum
        # The noise of a reading is at least that of rounding.
        least = None if quantum is None else np.asarray(quantum, float) / np.sqrt(12)
        found = search(self.family, part.rows.only(~part.judged), progress, begin, least)
        # Which place won is known from the first search; a later one begins where that ended.
        return found if start is None else found._replace(fit=found.fit._replace(starts=start.fit.starts))

    def ended(self, best: Solved, part: _Part | None) -> Fit:
        """The fit after profiles of the likelihood: once more to all rows of a part, where it was found good there."""
        return profile(best if part is None else again(best, part.rows)).fit

    def suspicion(self, best: Solved, part: _Part) -> str:
        """A sentence on a reversed input or late positions, where they explain the logs better than the fit; or ""."""
        rival = better_reading(best, part.rows, part.judged, self.logs.length)
        if rival is None:
            return ""
        misread = max(rival.machine, 0)
        log = self.logs.logs[self.logs.machines.index(misread)]
        step = float(np.median(np.diff(np.asarray(log.raw.t))))
        machine = self.machines[misread] if rival.machine >= 0 else ""
        return rival_sentence(rival, log.loaded.file, self.logs.held_out, step, machine)

    def gain(self, fits: dict[str, Solved]) -> Gain:
        """Errors are weighed as in both fits, by turns, so that none is ahead."""
        held, linear = (
            np.mean([block_losses(fits[word], other) for other in fits.values()], axis=0) for word in BETWEEN
        )
        return Gain.of(held - linear)

    def errors(self, best: Solved | None, part: _Part) -> PredictionErrors:
        """Errors on what is held out, of the first values where there is no fit."""
        unknowns, values = Unknowns.of(self.family), self.family.first if best is None else best.fit.values
        return window_errors(unknowns, unknowns.relative(values), part.rows, self.logs.length, part.judged)

    def details(self, best: Fit) -> dict[str, Any]:
        return {"start": start_sentence(best), "undetermined": list(relations(best)), "unlike": list(best.unlike)}


class _RobotProblem(NamedTuple):
    """Numbers of a robot's joints and links, fitted by residual torques."""

    family: models.RobotFamily
    logs: FitLogs
    machines: list[str]

    @classmethod
    def read(
        cls, jobs: list[Job], names: Sequence[str], length: float | None, own: OwnNumbers | None = None
    ) -> "_RobotProblem":
        refuse_other_parameters(jobs, ("between",))
        family, machines, of_log = models.robot_family(jobs[0].model_name, names, jobs[0].overrides), [""], None
        if own is not None:
            machines, of_log = own.numbered
            try:
                family = family.of_machines(machines, _own_robot_numbers(jobs[0], own.names, family.names))
            except InputError as error:
                raise InputError(f"each: {error}") from error
        # A robot without its friction may explain little of a log, as the fit is for that; so its check is another one.
        logs = FitLogs.read([job._replace(anyway=True) for job in jobs], length, of_log)
        for name, log in zip(logs.names, logs.logs, strict=True):
            finding = None if jobs[0].anyway else robot_misfit(family.one, log.loaded.file, log.raw)
            if finding is not None:
                raise MisfitError(f"{name}: {finding.evidence}. {finding.line}; `anyway=True` goes on")
        return cls(family, logs, machines)

    def acting(self, log: Aligned, between: str) -> Record:
        """The record with the inputs that act in each step."""
        return log.acting(between, log.loaded.file.input_lag)

    def fit(self, word: str, part: _Part, start: RobotFit | None, report: Callable[[int, float], None]) -> RobotFit:
        last = self.logs.last
        records = [self.acting(log, word) for log, held_out in zip(self.logs.logs, last, strict=True) if not held_out]
        machines = [machine for machine, held_out in zip(self.logs.machines, last, strict=True) if not held_out]
        if not last.any():
            records = [_first_part(record) for record in records]
        half = self.logs.logs[0].loaded.file.reference_half

        def progress(done: int) -> None:
            report(done, min(done / ROBOT_ROUNDS, 1.0))

        return fit_robot(self.family, records, half, progress, start, machines)

    def ended(self, best: RobotFit, part: _Part | None) -> RobotFit:
        del part
        return best

    def suspicion(self, best: RobotFit, part: _Part) -> str:
        del best, part
        return ""

    def gain(self, fits: dict[str, RobotFit]) -> Gain:
        return Gain.of(fits["held"].losses - fits["linear"].losses)

    def errors(self, best: RobotFit | None, part: _Part) -> PredictionErrors:
        """Root mean squares over the machines, of the first values where there is no fit."""
        # At the first values the family has the program of the fitted model; but a load that it adds was not there.
        added = any(number.group == "payload" for number in self.family.numbers)
        x = np.zeros(len(self.family.names)) if best is None else best.coordinates
        old = best is None and added
        each: list[Any] = [self.family.file.model if old else self.family.make(own) for own in x[self.family.parts]]
        machine, found = part.rows.of_machine, []
        for k, model in enumerate(each):
            rows = part.rows._replace(machine=np.zeros_like(part.rows.machine))
            judged = part.judged & (machine == k)
            if judged.any():
                found.append(window_errors(Unknowns.none(model), np.zeros(0), rows, self.logs.length, judged))
        return PredictionErrors(*(np.sqrt(np.mean(np.square(kind), axis=0)) for kind in zip(*found, strict=True)))

    def details(self, best: RobotFit) -> dict[str, Any]:
        return robot_details(best)


class _ServoProblem(NamedTuple):
    """Numbers of a robot with servos, fitted by predictions from its commands."""

    family: models.RobotFamily
    logs: FitLogs
    families: list[models.RobotFamily]
    window: float | None
    machines: tuple[str, ...] = ("",)

    @classmethod
    def read(
        cls, jobs: list[Job], names: Sequence[str], length: float | None, own: OwnNumbers | None = None
    ) -> "_ServoProblem":
        if own is not None:
            raise InputError(
                "each: numbers of a robot with servos are those of one robot; fit the logs of each robot by itself, "
                "`covariant fit MODEL LOG... -o FOLDER`"
            )
        families = [models.robot_family(job.model_name, names, job.overrides) for job in jobs]
        for job, family in zip(jobs, families, strict=True):
            differing = [
                name for name, a, b in zip(family.names, family.first, families[0].first, strict=True) if a != b
            ]
            if differing:
                raise InputError(
                    f"{job.log_name}: {', '.join(differing)} is fitted, and so is one number for all logs; "
                    "overrides of a log are for what is known, such as a gain or a payload"
                )
        # What holds for one log alone is not written to the file.
        same = all(job.overrides == jobs[0].overrides for job in jobs)
        family = families[0] if same else models.robot_family(jobs[0].model_name, names)
        # A servo whose numbers are first values explains little of a log, as the fit is for that.
        logs = FitLogs.read([job._replace(anyway=True) for job in jobs], None)
        for name, log in zip(logs.names, logs.logs, strict=True):
            finding = None if jobs[0].anyway else standing_still(log.loaded.file, log.raw)
            if finding is not None:
                raise MisfitError(f"{name}: {finding.evidence}. {finding.line}; `anyway=True` goes on")
        file = logs.logs[0].loaded.file
        return cls(family, logs._replace(tried=(file.input_between,)), families, length)

    def acting(self, log: Aligned, between: str) -> Record:
        """The record with the inputs that act in each step."""
        return log.acting(between, log.loaded.file.input_lag)

    def fit(self, word: str, part: _Part, start: RobotFit | None, report: Callable[[int, float], None]) -> RobotFit:
        seen = self.logs.seen
        records = [log.raw for log in self.logs.logs[:seen]]
        if len(self.logs.logs) == 1:
            records = [_first_part(records[0])]
        return fit_servos(
            self.families[:seen],
            records,
            word,
            lambda done: report(done, min(done / ROBOT_ROUNDS, 1.0)),
            self.window,
            late=_late(self.logs.logs[0]),
        )

    def ended(self, best: RobotFit, part: _Part | None) -> RobotFit:
        del part
        return best

    def suspicion(self, best: RobotFit, part: _Part) -> str:
        """A sentence on joints that do not follow their commands, whatever the numbers of their servos; or ""."""
        del part
        return unlike_servos(self.family, best, self.logs.logs[-1], self.errors(best).position)

    def gain(self, fits: dict[str, RobotFit]) -> Gain:
        return Gain.of(fits["held"].losses - fits["linear"].losses)

    def errors(self, best: RobotFit | None, part: _Part | None = None) -> PredictionErrors:
        """Errors of the motion predicted from the first row and the commands of what is held out."""
        del part
        x = np.zeros(len(self.family.names)) if best is None else best.coordinates
        several = len(self.logs.logs) > 1
        chosen = range(self.logs.seen, len(self.logs.logs)) if several else range(1)
        errors = []
        for i in chosen:
            log, reference = self.logs.logs[i], self.logs.references[i]
            t, u, y = (np.asarray(column, float) for column in log.raw[:3])
            late = np.flatnonzero((several or t >= t[0] + FITTED * (t[-1] - t[0])) & np.isfinite(y).all(axis=1))
            rows = slice(int(late[0]), None)
            record = Record(t[rows], u[rows], y[rows])
            q = predict_servos(self.families[i], x, record, log.loaded.file.input_between, _late(log))
            off = scoring.unwrap(y[rows], log.loaded.model.circles) - q
            speed = np.gradient(q, t[rows], axis=0)
            errors.append((off, reference[rows] - speed))
        position, velocity = (np.concatenate(parts) for parts in zip(*errors, strict=True))
        return PredictionErrors(known_rms(position), known_rms(velocity))

    def details(self, best: RobotFit) -> dict[str, Any]:
        return servo_details(best, self.family)


_Problem = _PredictionProblem | _RobotProblem | _ServoProblem


def _kind_of(job: Job, names: Sequence[str]) -> "type[_Problem]":
    """The kind of problem that the names of the numbers, and the inputs of the model, make it."""
    if not _is_robot_fit(job, names):
        return _PredictionProblem
    model = models.load(job.model, job.overrides).model
    return _RobotProblem if models.robots.servos_in(model) is None else _ServoProblem


def _own_robot_numbers(job: Job, names: Sequence[str], fitted: tuple[str, ...]) -> list[str]:
    """Those of the fitted numbers that names stand for, each for one at least, as `friction` for all that is fitted of
    it."""
    own = []
    for name in names:
        stated = models.robot_family(job.model_name, [name], job.overrides).names
        if not set(stated) & set(fitted):
            refuse_unknown("number in `parameters`", name.strip(), fitted)
        own += [number for number in stated if number in fitted]
    return own


def _first_part(record: Record) -> Record:
    """The rows of a log that a fit to its first part sees."""
    t, u, y = (np.asarray(column) for column in record[:3])
    seen = t < t[0] + FITTED * (t[-1] - t[0])
    return Record(t[seen], u[seen], y[seen])


def _late(log: Aligned) -> float:
    """Time [s] by which positions are late, which their stamps no longer say."""
    return float(np.max(np.asarray(log.late) - np.asarray(log.loaded.file.input_delay)))


def _is_robot_fit(job: Job, names: Sequence[str]) -> bool:
    """Whether numbers are those of a robot's joints and links, and not plain entries of [parameters]."""
    try:
        system = models.document(job.model_name, job.overrides).get("system")
    except InputError:  # whoever makes the family says what is wrong, with the name of the file
        return False
    if system != "robot":
        return False
    return not names or any("[" not in name and not name.strip().startswith("inputs.") for name in names)


def _details(
    job: Job,
    logs: FitLogs,
    guessed: dict[str, float],
    best: Fit | RobotFit,
    before: PredictionErrors,
    after: PredictionErrors,
    suspicion: str,
) -> dict[str, Any]:
    """Numbers before and after a fit, those that are still placeholders, and its errors on what is held out."""
    names, units = coordinates(logs.logs[0].loaded.file)
    reference = logs.logs[-1].loaded.reference
    ratio = error_growth(before, after)
    # The number of a machine, viscous@arm1, is no longer the placeholder of the file if one machine shows it.
    known = {
        name.partition("@")[0]
        for name, first, value, _, determined in number_rows(best)
        if determined or value != first
    }
    return {
        "model": job.model_name,
        "logs": logs.names,
        "fitted_to": logs.fitted_to,
        "held_out": logs.held_out,
        "horizon": float(f"{logs.length:.4g}"),
        "scored_against": reference.label if reference else None,
        "parameters": [
            {
                "name": name,
                "before": float(first),
                "after": float(f"{value:.{DIGITS}g}"),
                "standard_error": float(f"{error:.3g}") if np.isfinite(error) else None,
                "determined": bool(determined) and not suspicion,
            }
            for name, first, value, error, determined in number_rows(best)
        ],
        "placeholders": {k: value for k, value in guessed.items() if k not in known},
        "coordinates": list(names),
        "units": [unit.removesuffix("/s") for unit in units],
        "held_out_errors": {
            when: {kind: rounded(np.asarray(values)) for kind, values in errors._asdict().items()}
            for when, errors in (("before", before), ("after", after))
        },
        "growth": float(f"{ratio:.4g}") if np.isfinite(ratio) else None,
        "better": not predicts_worse(before, after) and not suspicion,
        "suspicion": suspicion,
    }


def _input_details(used: str, stated: bool, gain: Gain | None) -> dict[str, Any]:
    """How inputs were taken to go between stamps, whether the model file says so, and how well the logs show it."""
    return {
        "between": used,
        "stated": stated,
        "log_likelihood_gain": None if gain is None else float(f"{abs(gain.of_linear):.4g}"),
        "gain_standard_error": None if gain is None else float(f"{gain.standard_error:.3g}"),
        "sentence": "" if gain is None else _input_sentence(used, gain),
    }


def _input_sentence(used: str, gain: Gain) -> str:
    other = next(word for word in BETWEEN if word != used)
    size = f"{abs(gain.of_linear):.3g} ± {gain.standard_error:.2g}"
    if not gain.clear:
        return (
            f"Inputs are taken as {used} from one stamp to the next; the log hardly tells that from {other} (the "
            f"log-likelihoods differ by {size})."
        )
    phrase = {"held": "held from one stamp to the next", "linear": "linear between stamps"}[used]
    return f"Inputs {phrase} explain the log better than {other} ones, by {size} in log-likelihood; they are used."
