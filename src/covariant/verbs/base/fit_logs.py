"""The logs of a fit: which machine each is of, which are held out, how inputs may go between their stamps."""

from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant import models, scoring
from covariant.calibration import outliers
from covariant.calibration.identification import held_out_logs, horizon
from covariant.verbs.base.aligned import Aligned, aligned
from covariant.verbs.base.inputs import Job
from scalargraph.errors import InputError

BETWEEN = ("held", "linear")
"""How inputs may go between stamps; the first is what a model file means that does not say."""

NAMED = 8
"""Most logs that are named."""


class OwnNumbers(NamedTuple):
    """Numbers of which each machine has its own, and the machine of each log."""

    names: list[str]
    machines: list[str]

    @property
    def numbered(self) -> tuple[list[str], list[int]]:
        """The machines in order, and the index of that of each log."""
        machines = list(dict.fromkeys(self.machines))
        return machines, [machines.index(machine) for machine in self.machines]


class FitLogs(NamedTuple):
    """Logs of one model that a fit uses.

    Attributes:
        logs: The logs, their rows at the times at which positions were true; outliers are missing.
        references: Reference velocities (T, n) of the logs.
        length: Length of the predictions [s].
        stated: Whether the model file says how inputs go between stamps.
        tried: The ways that are tried.
        names: Names of the logs, by path.
        machines: Index of the machine of each log, of several with numbers of their own.
        judges: Number of the last logs that are held out, where it is known.
    """

    logs: list[Aligned]
    references: list[Float[np.ndarray, "_ n"]]
    length: float
    stated: bool
    tried: tuple[str, ...]
    names: list[str]
    machines: list[int]
    judges: int = 0

    @classmethod
    def read(cls, jobs: list[Job], machines: list[int] | None = None) -> "FitLogs":
        """Read the logs, the same model in each."""
        with models.loaded_once({}):
            logs = [_without_outliers(aligned(job)) for job in jobs]
        machines = [0] * len(jobs) if machines is None else machines
        file, references = logs[0].loaded.file, [_slopes(log) for log in logs]
        firsts = [machines.index(machine) for machine in sorted(set(machines))]
        length = float(np.median([horizon(np.asarray(logs[k].raw.t), references[k]) for k in firsts]))
        document = models.document(jobs[0].model_name, jobs[0].overrides)
        stated = file.input_between != BETWEEN[0] or "between" in document.get("inputs", {})
        # An input that is constant is the same held and linear.
        driven = any(bool((np.ptp(np.asarray(log.raw.u), axis=0) > 0).any()) for log in logs)
        tried = BETWEEN if driven and not stated else (file.input_between,)
        return cls(logs, references, length, stated, tried, [job.log_name for job in jobs], machines)

    @property
    def last(self) -> Bool[np.ndarray, "K"]:
        """Logs (K,) that are held out; if none is, the last part of each is."""
        if self.judges:
            return np.arange(len(self.logs)) >= len(self.logs) - self.judges
        return held_out_logs([np.asarray(log.raw.t) for log in self.logs], self.length, self.machines)

    @property
    def seen(self) -> int:
        """Number of logs, from the first one, that the fit of one machine sees; of a single log it sees the first
        part."""
        return len(self.logs) - int(np.sum(self.last))

    @property
    def fitted_to(self) -> str:
        """File names of the logs that the fit sees, separated by commas."""
        several = len(set(self.machines)) > 1
        seen = [Path(name) for name, last in zip(self.names, self.last, strict=True) if not last]
        if len(seen) > NAMED:
            return f"{len(seen)} logs, the first {seen[0].name}"
        return ", ".join("/".join(name.parts[-2:]) if several else name.name for name in seen)

    @property
    def held_out(self) -> str:
        """What is held out, in words."""
        last = np.flatnonzero(self.last)
        if not len(last):
            return f"the last third of {self.names[0] if len(self.names) == 1 else 'each log'}"
        machines = {self.machines[k] for k in last}
        if len(last) == 1:
            return self.names[last[0]]
        return f"the last {len(last)} logs" if len(machines) == 1 else f"the last logs of {len(machines)} machines"


def _slopes(log: Aligned) -> Float[np.ndarray, "T n"]:
    """Reference velocities of a log, or the rates of the outputs of a `StateSpace`."""
    if (reference := log.loaded.reference) is not None:
        return reference.v
    t, file = np.asarray(log.raw.t), log.loaded.file
    y = scoring.unwrap(np.asarray(log.raw.y), log.loaded.model.circles)
    return scoring.zero_phase_velocity(t, y, t, file.reference_half, int(file.reference_order))


def _without_outliers(log: Aligned) -> Aligned:
    """The log as the reference velocities have it: a prediction that starts from an outlier judges no model."""
    circles, t, y = log.loaded.model.circles, np.asarray(log.raw.t), np.asarray(log.raw.y)
    if not log.loaded.model.manifold.commuting:
        return log
    return log._replace(raw=log.raw._replace(y=np.where(outliers(t, y, circles)[0], np.nan, y)))


def refuse_other_parameters(jobs: list[Job], shared: Collection[str]) -> None:
    """Raise if the parameters of a log, or `shared` keys of its inputs, are others than those of the first, with which
    all logs are predicted; delays are those of each log."""
    if len(jobs) < 2 or all(job.overrides == jobs[0].overrides for job in jobs):
        return

    def of_all(job: Job) -> dict[str, Any]:
        document = models.document(job.model_name, job.overrides)
        inputs = document.get("inputs", {})
        return {"[parameters]": document.get("parameters"), **{f"inputs.{key}": inputs.get(key) for key in shared}}

    first, *others = map(of_all, jobs)
    for job, own in zip(jobs[1:], others, strict=True):
        for name, value in own.items():
            if value != first[name]:
                raise InputError(
                    f"{job.log_name}: its overrides make {name} others than those of {jobs[0].log_name}, with which "
                    "all logs are predicted; only robots with servos have known numbers of each log"
                )
