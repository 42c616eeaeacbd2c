"""Whether fitted numbers make up for an input that was read wrongly, which `fit` asks before it writes them."""

from typing import Any

import numpy as np

from covariant.calibration.diagnosis._case import busiest, case_without_outliers, in_coordinates
from covariant.calibration.diagnosis._finding import Finding
from covariant.calibration.diagnosis._guesses import other_numbers
from covariant.calibration.diagnosis._input_curves import Balance, input_curve, late_inputs
from covariant.calibration.diagnosis._thresholds import FEW_ROWS, MOST_ROWS, THRESHOLDS
from covariant.models import ModelFile
from covariant.signals import Record


def misread_input(file: ModelFile, fitted: ModelFile, record: Record, family: Any = None) -> Finding | None:
    """The finding on an input that acts by another curve than logged, with the other sign, or at another time.

    Numbers that are fitted to such a log make up for it as far as they can. So the first ones are asked too, and those
    that explain it beside any curves of the inputs, where the fitted ones leave more of the accelerations than these do
    once the log is mended.

    Args:
        file: The model and its data sheet, with first values.
        fitted: The same with fitted ones.
        record: The log as it was read.
        family: The `Family` or `RobotFamily` of the model, with its numbers open; None to ask for no others.

    Returns:
        The finding, whose line mends the log; None where all inputs act as logged, or the model is not in coordinates.

    Example:
        >>> import covariant
        >>> from covariant.calibration.diagnosis import misread_input
        >>> from covariant.models import load
        >>> log = covariant.simulate("oscillator", duration=20.0, rate=100.0, amplitude=2.0, noise=1e-4).record
        >>> spring = load("oscillator")
        >>> misread_input(spring, spring, log) is None
        True
        >>> misread_input(spring, spring, log._replace(u=log.u + 0.5)).what
        'offset of an input'
    """
    case = case_without_outliers(fitted, busiest(record, MOST_ROWS))[0] if in_coordinates(file) else None
    balance = None if case is None else Balance.of(case)
    if case is None or balance is None:
        return None
    left = balance.before.misfit / 2
    tried = [(case, np.inf)]
    if left > THRESHOLDS["curve"].least:
        tried.append((case._replace(file=file, model=file.model), left))
        few = case._replace(record=busiest(case.record, FEW_ROWS))
        other = None if family is None else other_numbers(few, lambda: family, (), "guesses or a fault")
        tried += [] if other is None else [(other[0](case), left)]
    for each, most in tried:
        balance = Balance.of(each)
        found = None if balance is None else input_curve(balance, signs=True) or late_inputs(balance)
        if found is not None and found[1].numbers["unexplained_after"] < most:
            return found[1]
    return None
