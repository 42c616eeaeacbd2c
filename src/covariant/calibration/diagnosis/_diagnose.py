"""Compares a log with a model, before anybody estimates from the log.

The model's accelerations along the smoothed log are compared with the measured ones. The remainder shows whether the
log is in the units, order and signs of the model, and whether every column was measured at its stamps.

Suspicions are judged against each other on rows held out, in an order where that cannot decide:

1. What readings and stamps show by themselves, since smoothing needs readings without outliers; of parts in which a
   position may be stuck, or from which on its zero may be another one, the model decides.
2. `COLUMNS`, one after another: in wrong units or order nothing else explains anything.
3. Delays and scales against friction and rotors, each of which looks like the other.
4. Whole rows and what inputs do between rows, in the log without these: so small a fault shows only there.
5. What is left when no suspicion explains it.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from covariant.calibration.diagnosis._case import in_coordinates, names_of
from covariant.calibration.diagnosis._finding import Diagnosis, Finding, Rows
from covariant.calibration.diagnosis._misfit import OF_COMMANDS
from covariant.calibration.diagnosis._sensor_motion import Beside
from covariant.calibration.diagnosis._stages import STAGES, Examination, compared
from covariant.models import ModelFile
from covariant.signals import Record

HIDING = ("nothing moves", "several senders", "too little motion")
"""Findings on logs that show no accelerations."""
WEIGHTS = (
    *("clock", "nothing moves", "several senders"),
    *("interpolated", "repeated", "outliers"),
    *OF_COMMANDS,
    *("servo off", "gain of a servo", "zero of a servo", "limit of a servo"),
    *("unit of", "period", "swapped", "sign of", "axes of", "sensor", "zero of"),
    *("lost counts", "offset", "limit", "dead band"),
    *("gravity", "friction", "rotor inertia", "added inertia", "too little motion"),
    *("delay", "row shift", "scale of", "inputs between"),
    *("ticks", "a position", "bias of"),
    *("numbers", "model", "uncertainty", "noise"),
)
"""How findings begin, in the order in which they have to be mended: a wrong unit or order makes all numbers below it
wrong, and numbers of the model are fitted to a log that is right."""


def diagnose(
    file: ModelFile,
    record: Record,
    quantum: float | tuple[float, ...] | None = None,
    first_row: int = 1,
    every: int = 1,
    sensors: Sequence[Beside] = (),
    v: np.ndarray | None = None,
    family: Callable[[], Any] | None = None,
) -> Diagnosis:
    """Compare a log with a model, and report what is wrong with the log, or with the model file for it.

    Call it before any fit, tuning or estimate: a wrong unit, sign or delay looks like noise or a wrong parameter. Mend
    the first finding first, since it can cause the later ones. Where the model explains nothing of the motion, begin
    with the columns and units. The verb `covariant.check` does the same from files.

    Args:
        file: The model and its data sheet. For a machine that is not in coordinates, and for a `StateSpace`, only the
            stamps and missing measurements are checked, and the delay of the encoders of a robot on legs.
        record: The log as it was read, without a lag of the inputs. Of more than `MOST_ROWS` rows, the stretch in which
            the positions move most is compared with the model.
        quantum: One tick of the encoders that the model file states, or one for each coordinate, where `file` no longer
            has it.
        first_row: Row of the file, counted from 1, at which the record begins; messages count from it.
        every: The record has each `every`-th row of the file.
        sensors: Sensors beside the positions with their readings in the rows of the record, which are judged by what
            the positions predict of them; of a machine that is not in coordinates they are not.
        v: Velocities (T, n) of the log, which are compared with the slopes of the positions.
        family: Function that makes the `Family` or `RobotFamily` of the model with its guesses open, which is called
            if the model leaves much of the log; None where all numbers are known.

    Returns:
        The findings, sorted by what they invalidate: those first that make others meaningless. A log that fits has none
        that is `wrong`.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import diagnose
        >>> from covariant.models import load
        >>> from covariant.signals import Record
        >>> t = np.arange(0.0, 10.0, 0.01)
        >>> y = 0.2 * np.cos(t) + 1e-4 * np.random.default_rng(0).normal(size=1000)
        >>> diagnose(load("oscillator"), Record(t, np.zeros((1000, 1)), y[:, None])).findings
        ()
    """
    quantum = file.quantum if quantum is None else quantum
    if v is not None and in_coordinates(file):
        sensors = (*sensors, Beside.of_velocities(names_of(file), file.columns.v, v))
    log = Examination(file, record, quantum, Rows(np.asarray(record.t), first_row, every), sensors, family)
    for stage in STAGES:
        if stage(log):
            break
    findings, checks = sorted(log.findings, key=_weight), log.checks
    hidden = any(each.what in HIDING for each in findings)
    return Diagnosis(tuple(findings), checks, tuple(each for each in compared(file) if hidden and each not in checks))


def _weight(finding: Finding) -> tuple[bool, int]:
    """Sort key of a finding: wrong ones first, and among them those that make others meaningless."""
    place = next((k for k, begin in enumerate(WEIGHTS) if finding.what.startswith(begin)), len(WEIGHTS))
    return not finding.wrong, place
