"""The logs of a fit: read, with the part that is held out, and the ways of inputs between stamps that are tried."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant import models
from covariant.calibration import FITTED, held_out_logs, horizon, outliers
from covariant.workflow._aligned import Aligned, aligned
from covariant.workflow._inputs import Job

BETWEEN = ("held", "linear")
"""How inputs may go between stamps; the first is what a model file means that does not say."""


class FitLogs(NamedTuple):
    """Logs of one model that a fit uses.

    Attributes:
        logs: The logs, their rows at the times at which positions were true; outliers are missing.
        references: Reference velocities (T, n) of the logs.
        length: Length of the predictions [s].
        stated: Whether the model file says how inputs go between stamps.
        tried: The ways that are tried.
        names: Names of the logs, by path.
    """

    logs: list[Aligned]
    references: list[Float[np.ndarray, "_ n"]]
    length: float
    stated: bool
    tried: tuple[str, ...]
    names: list[str]

    @classmethod
    def read(cls, jobs: list[Job], length: float | None) -> "FitLogs":
        """Read the logs.

        Args:
            jobs: The model and the logs, the same model in each.
            length: Length of the predictions [s]; None chooses it by the motion.

        Raises:
            MisfitError: Where the model explains nothing of the motion in a log.
            ValueError: For a model or a log that cannot be used.
        """
        logs = [_without_outliers(aligned(job)) for job in jobs]
        file, references = logs[0].loaded.file, [log.loaded.reference.v for log in logs if log.loaded.reference]
        # Of a single log the held-out third must hold enough windows too.
        part = 1 - FITTED if len(jobs) == 1 else 1.0
        length = horizon(logs[0].raw, references[0], part, len(logs)) if length is None else length
        document = models.document(jobs[0].model_name, jobs[0].overrides)
        stated = file.input_between != BETWEEN[0] or "between" in document.get("inputs", {})
        tried = BETWEEN if not stated and _driven(logs) else (file.input_between,)
        return cls(logs, references, length, stated, tried, [job.log_name for job in jobs])

    @property
    def file(self) -> models.ModelFile:
        """The model file."""
        return self.logs[0].loaded.file

    @property
    def seen(self) -> int:
        """Number of logs, from the first one, that the fit sees; of a single log it sees the first part."""
        several = len(self.logs) > 1
        return len(self.logs) - several * held_out_logs([np.asarray(log.raw.t) for log in self.logs], self.length)

    @property
    def fitted_to(self) -> str:
        """File names of the logs that the fit sees, separated by commas."""
        return ", ".join(Path(name).name for name in self.names[: self.seen])

    @property
    def held_out(self) -> str:
        """What is held out, in words."""
        if len(self.names) == 1:
            return f"the last third of {self.names[0]}"
        count = len(self.names) - self.seen
        return self.names[-1] if count == 1 else f"the last {count} logs"

    @property
    def title(self) -> str:
        """Names of all logs, for messages."""
        return ", ".join(self.names)


def _without_outliers(log: Aligned) -> Aligned:
    """The log as the reference velocities have it: a prediction that starts from an outlier judges no model."""
    circles, t, y = log.loaded.model.circles, np.asarray(log.raw.t), np.asarray(log.raw.y)
    if not log.loaded.model.manifold.commuting:
        return log
    return log._replace(raw=log.raw._replace(y=np.where(outliers(t, y, circles)[0], np.nan, y)))


def _driven(logs: list[Aligned]) -> bool:
    """Whether any input changes: one that is constant is the same held and linear."""
    return any(bool((np.ptp(np.asarray(log.raw.u), axis=0) > 0).any()) for log in logs)
