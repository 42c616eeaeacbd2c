"""Logs in the times at which their positions were true, for `fit` and `tune`."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from covariant import models, scoring
from covariant.models import Overrides
from covariant.signals import Record, acting_inputs, lag_inputs, read_together
from covariant.verbs.base.inputs import Job, Loaded, ReferenceVelocity, load


class Aligned(NamedTuple):
    """Log whose stamps are the times at which its positions were true.

    Attributes:
        loaded: Model and log; the inputs of its `log` act without their lag, those of its `record` with it.
        raw: The record with its inputs as they are logged.
        late: Time [s] after its row at which an input acts, one number or one for each input.
        whole: The inputs of all rows of the log, of which `raw` may have a part.
    """

    loaded: Loaded
    raw: Record
    late: Any
    whole: Record

    def acting(self, between: str, lag: float = 0.0) -> Record:
        """The record with the inputs that act in each step, behind a lag."""
        return acting_inputs(lag_inputs(self.whole, lag), between, self.late, self.raw, self.loaded.file.input_lead)


def aligned(job: Job) -> Aligned:
    """Read a log, its rows at the times at which the positions were true.

    Where one coordinate is later than another they are interpolated to the times of the latest.
    """
    file = models.load(job.model, job.overrides)
    delay = np.asarray(file.delay, float)
    # Read without a delay: here the delay moves the inputs instead, by `late`.
    undelayed = job._replace(overrides=with_overrides(job.overrides, {"measurement.delay": 0}))
    loaded = load(undelayed, why="" if job.fits else "this command takes")
    complete = loaded.kind.complete(np.asarray(loaded.log.record.y))
    loaded = loaded._replace(log=loaded.log._replace(record=loaded.log.record._replace(y=complete)))
    whole = loaded.log.all_rows
    if np.ptp(delay) > 0:
        loaded = _together(loaded, delay)
    # What moves a position back by its delay moves an input on by as much against it.
    raw, late = loaded.log.record, (np.asarray(file.input_delay) + float(delay.max())).tolist()
    log = Aligned(loaded, raw, late, whole)
    unlagged = loaded.log._replace(record=log.acting(file.input_between))
    return log._replace(loaded=loaded._replace(log=unlagged, record=log.acting(file.input_between, file.input_lag)))


def with_overrides(overrides: Overrides, more: Mapping[str, float]) -> Overrides:
    """Overrides of either kind, and more."""
    texts = [f"{key}={value}" for key, value in more.items()]
    return {**overrides, **more} if isinstance(overrides, Mapping) else (*overrides, *texts)


def _together(loaded: Loaded, delay: np.ndarray) -> Loaded:
    """The log with all positions as they were at one time, and reference velocities at these times."""
    file, log = loaded.file, loaded.log
    y = scoring.unwrap(np.asarray(log.record.y), loaded.model.circles)
    record = read_together(log.record._replace(y=y), np.broadcast_to(delay, y.shape[1]))
    t = np.asarray(record.t)
    slopes = scoring.zero_phase_velocity(t, np.asarray(record.y), t, file.reference_half, int(file.reference_order))
    reference = ReferenceVelocity(slopes, "zero-phase reference", scoring.scored_window(t))
    # Velocities and truth of the log are those at its stamps, not at these times.
    return loaded._replace(log=log._replace(record=record, v=None, truth=None), reference=reference)
