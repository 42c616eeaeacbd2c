"""The kinds of problems that a fit to logs solves: numbers of any model, of a robot, and of a robot with servos."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from covariant import models, scoring
from covariant._linalg import known_rms
from covariant._names import refuse_unknown
from covariant.calibration import Fit, PredictionErrors, RobotFit, fit_robot, relations
from covariant.calibration.diagnosis import misread_input, names_of
from covariant.calibration.identification import (
    FITTED,
    MOST_ROWS,
    RobotUnknowns,
    Rows,
    Solved,
    Unknowns,
    again,
    block_losses,
    error_growth,
    fit_servos,
    held_out_rows,
    likeliest_robot,
    predict_servos,
    profile,
    robot_misfit,
    rows_of,
    search,
    standing_still,
    stick_bands,
    unknowns_of,
    window_errors,
)
from covariant.observers import on_legs
from covariant.signals import Record
from covariant.verbs.base.aligned import Aligned
from covariant.verbs.base.fit_logs import BETWEEN, FitLogs, OwnNumbers, refuse_other_parameters
from covariant.verbs.base.fit_sentences import Gain, misread_sentence, robot_details, servo_details, unlike_servos
from covariant.verbs.base.inputs import Job, MisfitError
from covariant.verbs.base.outcome import rounded
from covariant.verbs.base.progress import Progress
from scalargraph.errors import InputError

CLEARLY_WORSE, LESS = 1.05, 0.8
"""Growth of held-out errors that is no chance, and by which another reading is believed."""
ROWS_OF_WINDOW = 100
"""Rows of a window of which the errors of a servo count as one."""
ROUNDS, STEPS, ROBOT_ROUNDS = 8, 25, 12
"""Rounds of a search and the most steps in one, and the usual number of rounds for a robot, for the progress."""


class Part(NamedTuple):
    """All rows of the logs with one way of inputs between stamps, and which (T,) are held out."""

    rows: Rows
    judged: Bool[np.ndarray, "T"]

    @classmethod
    def of(cls, problem: "Problem", word: str) -> "Part":
        logs = problem.logs
        records = [problem.acting(log, word) for log in logs.logs]
        model = logs.logs[0].loaded.model
        # A step of a robot with many joints costs as the square of their number.
        cost = 1 if isinstance(problem.family, models.Family) else max(1, len(model.coordinates) // 2) ** 2
        rows = rows_of(problem.family, records, logs.references, logs.machines, MOST_ROWS // cost)
        stamps = [np.asarray(record.t) for record in records]
        return cls(rows, held_out_rows(rows, stamps, logs.last))


@dataclass(frozen=True)
class Problem:
    """What is fitted to logs: a family of models, the logs, and the machines that they are of."""

    family: Any
    logs: FitLogs
    machines: Sequence[str]

    def acting(self, log: Aligned, between: str) -> Record:
        """The record with the inputs that act in each step."""
        return log.acting(between, log.loaded.file.input_lag)

    def refined(self, best: Any, part: Part, progress: Progress) -> Any:
        """The fit after what need not be done for each way of inputs."""
        del part, progress
        return best

    def ended(self, best: Any, part: Part | None) -> Any:
        """The fit in the end: once more to all rows of a part, where it was found good there."""
        del part
        return best

    def lasting(self, values: np.ndarray) -> np.ndarray:
        """Fitted values (p,), with the first ones of numbers that drift: those of a log are not those of the next."""
        return values

    def suspicion(self, best: Any, part: Part) -> str:
        """A sentence on another reading of the logs that explains them better than the fit; or ""."""
        del part
        for log, name, machine in zip(self.logs.logs, self.logs.names, self.logs.machines, strict=True):
            # Of these logs the inputs are late in place of the positions.
            file = log.loaded.file._replace(input_delay=log.late)
            alone = len(self.machines) == 1 and file.input_kind != "command"
            fitted = self.fitted(best, machine, file)
            finding = misread_input(file, fitted, log.raw, self.family if alone else None)
            if finding is not None:
                return misread_sentence(finding, name, self.machines[machine])
        return ""

    def fitted(self, best: Any, machine: int, file: models.ModelFile) -> models.ModelFile:
        """The model file with the fitted numbers of a machine."""
        raise NotImplementedError

    def gain(self, fits: dict[str, Any]) -> Gain:
        """What linear inputs explain better than held ones."""
        return Gain.of(fits["held"].losses - fits["linear"].losses)


class PredictionProblem(Problem):
    """Parameters of a model, fitted by the likelihood of logs."""

    @classmethod
    def read(cls, jobs: list[Job], names: Sequence[str], own: OwnNumbers | None = None) -> "PredictionProblem":
        refuse_other_parameters(jobs, ("between", "lag"))
        if on_legs((file := models.load(jobs[0].model, jobs[0].overrides)).model):
            file.need_mechanical(jobs[0].model_name, "numbers are fitted for")
        # A number that drifts has a value in each log, which the other numbers depend on.
        drifting = [name for name in file.uncertain if file.parameters_drift and name not in names]
        family = models.family(jobs[0].model_name, [*names, *drifting], jobs[0].overrides)
        family, machines, of_log = _of_machines(family, own, lambda own: own)
        return cls(family, FitLogs.read([job._replace(fits=True) for job in jobs], of_log), machines)

    def acting(self, log: Aligned, between: str) -> Record:
        """The record with the inputs that act in each step, without their lag, which may be fitted."""
        return log.acting(between)

    def fit(self, word: str, part: Part, start: Solved | None, report: Callable[[int, float], None]) -> Solved:
        begin = None if start is None else start.fit.values
        quantum = self.logs.logs[0].loaded.file.quantum
        # The noise of a reading is at least that of rounding.
        least = None if quantum is None else np.asarray(quantum, float) / np.sqrt(12)
        return search(self.family, part.rows.only(~part.judged), _reported(report), begin, least)

    def ended(self, best: Solved, part: Part | None) -> Fit:
        """The fit after profiles of the likelihood: once more to all rows of a part, where it was found good there."""
        return profile(best if part is None else again(best, part.rows)).fit

    def suspicion(self, best: Solved, part: Part) -> str:
        """A sentence on inputs that are misread; where no accelerations are compared, on one of the other sign."""
        file, inputs = self.logs.logs[0].loaded.file, np.asarray(part.rows.inputs)
        if file.mechanical and file.model.manifold.commuting:
            return super().suspicion(best, part)
        # A fit that needs no force has read its inputs right.
        for signs in () if best.quiet else 1.0 - 2.0 * np.eye(inputs.shape[1]):
            read = part._replace(rows=part.rows._replace(inputs=inputs * signs))
            other = again(best, read.rows.only(~read.judged), noise=False)
            if error_growth(self.errors(best, part), self.errors(other, read)) < LESS:
                return f"An input seems to be logged with the other sign. Mend it: {names_of(file).line('u', signs)}"
        return ""

    def fitted(self, best: Solved, machine: int, file: models.ModelFile) -> models.ModelFile:
        model, lag = self.family.make(best.fit.values[self.family.parts[machine]])
        return file._replace(model=model, input_lag=float(lag))

    def lasting(self, values: np.ndarray) -> np.ndarray:
        drifts = [self.family.file.uncertain_std(name) is not None for name in self.family.names]
        return np.where(drifts, self.family.first, values) if self.family.file.parameters_drift else values

    def gain(self, fits: dict[str, Solved]) -> Gain:
        """Errors are weighed as in both fits, by turns, so that none is ahead."""
        losses = [[block_losses(fits[word], other) for other in fits.values()] for word in BETWEEN]
        held, linear = np.mean(losses, axis=1)
        return Gain.of(held - linear)

    def errors(self, best: Solved | None, part: Part) -> PredictionErrors:
        """Errors on what is held out, of the first values where there is no fit."""
        unknowns, values = unknowns_of(self.family, part.rows), self.family.first if best is None else best.fit.values
        return window_errors(unknowns, unknowns.relative(values), part.rows, self.logs.length, part.judged)

    def details(self, best: Fit) -> dict[str, Any]:
        return {"undetermined": list(relations(best)), "unlike": list(best.unlike)}


class RobotProblem(Problem):
    """Numbers of a robot's joints and links, fitted by residual torques, and from these by the likelihood of logs."""

    @functools.cached_property
    def unknowns(self) -> RobotUnknowns:
        """The numbers of one machine, whose graphs are made once."""
        return RobotUnknowns.of(self.family.one, Part.of(self, self.logs.tried[0]).rows)

    @classmethod
    def read(cls, jobs: list[Job], names: Sequence[str], own: OwnNumbers | None = None) -> "RobotProblem":
        refuse_other_parameters(jobs, ("between",))
        family = models.robot_family(jobs[0].model_name, names, jobs[0].overrides)
        all_names = family.names
        family, machines, of_log = _of_machines(family, own, lambda own: _own_robot_numbers(jobs[0], own, all_names))
        # A robot without its friction may explain little of a log, as the fit is for that; so its check is another one.
        logs = FitLogs.read([job._replace(anyway=True) for job in jobs], of_log)
        _refuse_misfits(jobs[0], logs, lambda log: robot_misfit(family.one, log.loaded.file, log.raw))
        return cls(family, logs, machines)

    def fit(self, word: str, part: Part, start: RobotFit | None, report: Callable[[int, float], None]) -> RobotFit:
        last = self.logs.last
        records = [self.acting(log, word) for log, held_out in zip(self.logs.logs, last, strict=True) if not held_out]
        machines = [machine for machine, held_out in zip(self.logs.machines, last, strict=True) if not held_out]
        if not last.any():
            records = [_first_part(record) for record in records]
        half = self.logs.logs[0].loaded.file.reference_half

        return fit_robot(self.family, records, half, lambda done: report(done, done / ROBOT_ROUNDS), start, machines)

    def refined(self, best: RobotFit, part: Part, progress: Progress) -> RobotFit:
        """The fit of greatest likelihood, where it knows more and predicts no worse than that by residual torques."""
        if len(self.machines) > 1:
            return best
        report = _reported(lambda done, fraction: progress(f"all rows, round {done + 1}", fraction))
        other = likeliest_robot(self.unknowns, best, part.rows.only(~part.judged), report)
        # Of a long log not all rows are used.
        if not np.nanmedian(other.standard_errors / best.standard_errors) < 1:
            return best
        return best if error_growth(self.errors(best, part), self.errors(other, part)) > CLEARLY_WORSE else other

    def ended(self, best: RobotFit, part: Part | None) -> RobotFit:
        """The fit, once more to all rows of a part where it was found good there."""
        known = best.likeliest and not best.kept
        return likeliest_robot(self.unknowns, best, part.rows) if part is not None and known else best

    def fitted(self, best: RobotFit, machine: int, file: models.ModelFile) -> models.ModelFile:
        return file._replace(model=self.family.make(best.coordinates[self.family.parts[machine]]))

    def errors(self, best: RobotFit | None, part: Part) -> PredictionErrors:
        """Root mean squares over the machines, of the first values where there is no fit."""
        x = np.zeros(len(self.family.names)) if best is None else best.coordinates
        machine, found = part.rows.of_machine, []
        for k, own in enumerate(x[self.family.parts]):
            rows, judged = part.rows._replace(machine=np.zeros_like(part.rows.machine)), part.judged & (machine == k)
            of: Any = self.unknowns, own / self.unknowns.sizes
            # A load that the family adds was not there before.
            if best is None and any(number.group == "payload" for number in self.family.numbers):
                of = Unknowns.none(self.family.file.model), np.zeros(0)
            if judged.any():
                found.append(window_errors(of[0], of[1], rows, self.logs.length, judged))
        sizes = (each.position for each in found), (each.velocity for each in found)
        position, velocity = (np.sqrt(np.mean(np.square(list(kind)), axis=0)) for kind in sizes)
        return PredictionErrors(position, velocity, np.concatenate([each.windows for each in found]))

    def details(self, best: RobotFit) -> dict[str, Any]:
        return robot_details(best)


@dataclass(frozen=True)
class ServoProblem(Problem):
    """Numbers of a robot with servos, fitted by predictions from its commands; with a family for each log."""

    families: Sequence[models.RobotFamily]

    @classmethod
    def read(cls, jobs: list[Job], names: Sequence[str], own: OwnNumbers | None = None) -> "ServoProblem":
        if own is not None:
            raise InputError(
                "each: numbers of a robot with servos are those of one robot; fit the logs of each robot by itself, "
                "`covariant fit MODEL LOG... -o FOLDER`"
            )
        made: list[tuple[Any, models.RobotFamily]] = []  # what logs override is often the same
        families = []
        for job in jobs:
            same = [family for overrides, family in made if overrides == job.overrides]
            families.append(same[0] if same else models.robot_family(job.model_name, names, job.overrides))
            made += [] if same else [(job.overrides, families[-1])]
        for job, family in zip(jobs, families, strict=True):
            pairs = zip(family.names, family.first, families[0].first, strict=True)
            if differing := [name for name, a, b in pairs if a != b]:
                raise InputError(
                    f"{job.log_name}: {', '.join(differing)} is fitted, and so is one number for all logs; "
                    "overrides of a log are for what is known, such as a gain or a payload"
                )
        # What holds for one log alone is not written to the file.
        same = all(job.overrides == jobs[0].overrides for job in jobs)
        family = families[0] if same else models.robot_family(jobs[0].model_name, names)
        # A servo whose numbers are first values explains little of a log, as the fit is for that.
        logs = FitLogs.read([job._replace(anyway=True) for job in jobs])
        _refuse_misfits(jobs[0], logs, lambda log: standing_still(log.loaded.file, log.raw))
        file = logs.logs[0].loaded.file
        return cls(family, logs._replace(tried=(file.input_between,)), [""], families)

    def fit(self, word: str, part: Part, start: RobotFit | None, report: Callable[[int, float], None]) -> RobotFit:
        seen = self.logs.seen
        records = [log.raw for log in self.logs.logs[:seen]]
        if len(self.logs.logs) == 1:
            records = [_first_part(records[0])]

        del part, start
        late = _late(self.logs.logs[0])
        return fit_servos(self.families[:seen], records, word, lambda k: report(k, k / ROBOT_ROUNDS), late)

    def suspicion(self, best: RobotFit, part: Part) -> str:
        """A sentence on joints that do not follow their commands, whatever the numbers of their servos; or ""."""
        del part
        return unlike_servos(self.family, best, self.logs.logs, self._judging, self.errors(best).position)

    def errors(self, best: RobotFit | None, part: Part | None = None) -> PredictionErrors:
        """Errors of the motion predicted from the first row and the commands of what is held out."""
        del part
        x = np.zeros(len(self.family.names)) if best is None else best.coordinates
        several, errors = len(self.logs.logs) > 1, []
        for i in self._judging:
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
        parts = [part for off, _ in errors for part in np.array_split(off, max(1, len(off) // ROWS_OF_WINDOW))]
        windows = np.array([known_rms(part) ** 2 for part in parts])
        tick = self.family.file.quantum  # also where a log is noisier than that
        return PredictionErrors(known_rms(position), known_rms(velocity), windows, np.asarray(tick or 0.0))

    @property
    def _judging(self) -> range:
        """Indices of the logs by which the fit is judged."""
        return range(self.logs.seen, len(self.logs.logs)) if len(self.logs.logs) > 1 else range(1)

    def details(self, best: RobotFit) -> dict[str, Any]:
        records = ((self.families[i], self.logs.logs[i].raw) for i in self._judging)
        bands = np.concatenate([stick_bands(family, best.coordinates, record) for family, record in records])
        return {**servo_details(best, self.family), "stick_band": rounded(np.nanmedian(bands, axis=0))}


def kind_of(job: Job, names: Sequence[str]) -> type[Any]:
    """The kind of problem that the names of the numbers, and the inputs of the model, make it."""
    if not _is_robot_fit(job, names):
        return PredictionProblem
    model = models.load(job.model, job.overrides).model
    return RobotProblem if models.robots.servos_in(model) is None else ServoProblem


def _reported(report: Callable[[int, float], None]) -> Callable[[int, int], None]:
    """Report of a round and of the part that is done, at a step of a round."""
    return lambda done, step: report(done, min((done + step / STEPS) / ROUNDS, 1.0))


def _of_machines(family: Any, own: OwnNumbers | None, named: Callable[[list[str]], list[str]]) -> Any:
    """The family of all machines, their names, and the machine of each log."""
    if own is None:
        return family, [""], None
    machines, of_log = own.numbered
    try:
        return family.of_machines(machines, named(own.names)), machines, of_log
    except InputError as error:
        raise InputError(f"each: {error}") from error


def _refuse_misfits(job: Job, logs: FitLogs, find: Callable[[Aligned], Any]) -> None:
    """Raise if something is found that makes a log useless for a fit, unless it is fitted anyway."""
    for name, log in zip(logs.names, logs.logs, strict=True):
        if not job.anyway and (finding := find(log)) is not None:
            raise MisfitError(f"{name}: {finding.evidence}. {finding.line}; `anyway=True` goes on")


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
    seen = np.asarray(record.t) < record.t[0] + FITTED * (record.t[-1] - record.t[0])
    return Record(*(np.asarray(column)[seen] for column in record[:3]))


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
