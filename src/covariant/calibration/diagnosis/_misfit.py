"""Whether a log fits its model at all, which verbs ask before they use it."""

from covariant.calibration.diagnosis._case import busiest, case_without_outliers, clearly, compared, in_coordinates
from covariant.calibration.diagnosis._columns import units
from covariant.calibration.diagnosis._finding import Finding
from covariant.calibration.diagnosis._missing_torques import missing_torques
from covariant.calibration.diagnosis._servo_faults import servo_findings
from covariant.calibration.diagnosis._suspicion import clearly_unexplained, judge
from covariant.calibration.diagnosis._thresholds import BARELY, FEW_ROWS
from covariant.calibration.diagnosis._unexplained import constant_inputs, unexplained
from covariant.models import ModelFile
from covariant.signals import Record

OF_COMMANDS = ("unit of a command", "sign of a command", "swapped commands", "period of a command")
"""Findings on commands that make a log useless."""


def misfit(file: ModelFile, record: Record) -> Finding | None:
    """Reason why a log is useless for a model: other units, or a motion that the model does not explain.

    At most `FEW_ROWS` rows of the record are compared, in a fraction of the time of an estimate.

    Args:
        file: The model and its data sheet.
        record: The log as it was read.

    Returns:
        The finding. None where the model explains the accelerations, where they do not exceed the noise, and where the
        model is not in coordinates.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import misfit
        >>> from covariant.models import load
        >>> from covariant.signals import Record
        >>> t = np.arange(0.0, 10.0, 0.01)
        >>> y = 0.2 * np.cos(t) + 1e-4 * np.random.default_rng(0).normal(size=1000)
        >>> misfit(load("oscillator"), Record(1e3 * t, np.zeros((1000, 1)), y[:, None])).line
        '[units] t = "ms"'
    """
    if not in_coordinates(file):
        return None
    case, _ = case_without_outliers(file, busiest(record, FEW_ROWS))
    if file.input_kind == "command":
        # What no servo explains; their numbers may be first guesses.
        return next((each for each in servo_findings(case)[0] if each.wrong and each.what in OF_COMMANDS), None)
    left = compared(case)
    if left is not None and left.told.any() and left.misfit < BARELY:
        return None
    accepted = judge(case, units(case), clearly_unexplained)
    if accepted is not None:
        return accepted[1]
    if file.wrenches or file.external_force or file.external_force_std:
        return None  # the forces that the file states may be what the model leaves
    constant = constant_inputs(record, case.names)
    findings = [each for each in unexplained(case, left, None, constant) if each.what == "model"] if left else []
    log = clearly(case)
    if not findings or log is None:
        return None
    accepted = judge(case, missing_torques(case, log), clearly_unexplained)
    return findings[0] if accepted is None else accepted[1]
