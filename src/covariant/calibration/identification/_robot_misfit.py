"""Reasons why a log is useless for a fit of a robot: nothing moves, or positions and stamps are in other units.

A robot without its friction and rotors may explain little of a log, since these are what a fit looks for. So torques
are compared, and what any friction and any rotor of the joints could explain is taken out first.
"""

import numpy as np

from covariant.calibration import diagnosis
from covariant.calibration.identification._robot_fit import driving
from covariant.calibration.identification._robot_torques import at_rows, needed
from covariant.models import MechanicalSystem, ModelFile, RobotFamily
from covariant.signals import Record

MOVED = 6.0
"""Range of the smoothed positions of a joint that moves, in the noise or the ticks of its encoder."""
SLOW = 0.1
"""Speed, relative to the usual one, below which a joint may stick, so that its torque says nothing."""
HEAVIEST = 30.0
"""Largest inertia of a rotor or a load, relative to the robot's, that may explain a log in other units: a larger one
explains any unit."""


def robot_misfit(family: RobotFamily, file: ModelFile, record: Record) -> diagnosis.Finding | None:
    """Reason why a fit of a robot must not use a log: nothing moves, or another unit explains its torques; or None."""
    case, _ = diagnosis.case_without_outliers(file, diagnosis.busiest(record, diagnosis.FEW_ROWS))
    found = standing_still(file, record, case)
    log = diagnosis.clearly(case)
    if found is not None or log is None or not log.used.any():
        return found  # what is too short, whoever fits says
    model, scaled = family.make(np.zeros(len(family.names))), any(n.group == "torque_constants" for n in family.numbers)

    # As the log is, a rotor or load of any size is granted.
    now = _unexplained_torques(model, log, scaled, np.inf)

    def compare(changed: diagnosis.Case) -> diagnosis.Unexplained | None:
        if changed is case:
            return now
        smoothed = diagnosis.clearly(changed)
        return None if smoothed is None else _unexplained_torques(model, smoothed, scaled, HEAVIEST)

    if now is None or not now.blocks.mean() > diagnosis.BARELY:
        return None
    suspicions = list(diagnosis.units(case))
    # One wrong unit is likelier than two, and stamps that are far from seconds show already in the rate.
    for likely in ("unit of positions", "unit of time", "unit of time and positions"):
        accepted = diagnosis.judge(case, [each for each in suspicions if each.what == likely], compare, "torques")
        if accepted is not None:
            finding = accepted[1]
            return finding._replace(evidence=f"whatever friction, rotors and loads may be, {finding.evidence}")
    return None


def standing_still(file: ModelFile, record: Record, case: diagnosis.Case | None = None) -> diagnosis.Finding | None:
    """Reason why a fit must not use a log in which nothing moves; None where something does."""
    if case is None:
        case, _ = diagnosis.case_without_outliers(file, diagnosis.busiest(record, diagnosis.FEW_ROWS))
    still, whole = diagnosis.still_findings(np.asarray(record.y), case.names.q, case.names.units)
    if whole:
        return still[0]
    log = diagnosis.clearly(case)
    if log is None or not log.used.any():
        return None
    if (np.ptp(log.q[log.used], axis=0) > MOVED * np.maximum(log.noise, case.ticks)).any():
        return None
    return diagnosis.standstill(case.record, case.model.circles, case.names, case.ticks)


def _unexplained_torques(
    model: MechanicalSystem, log: diagnosis.Smooth, scaled: bool, heaviest: float
) -> diagnosis.Unexplained | None:
    """What of the torques of the joints that move no friction, rotor and weight of a right sign explains.

    Rotors and loads are at most `heaviest`, relative to the robot's.
    """
    from scipy.optimize import lsq_linear

    blocks, none = [], np.zeros_like(log.q)
    needs, drives = (at_rows(lambda _, *row, of=function: of(model, *row)) for function in (needed, driving))
    weight, standing, moving = (needs((), log.q, v, a) for v, a in ((none, none), (none, log.a), (log.v, log.a)))
    for j, (v, a, motor) in enumerate(zip(log.v.T, log.a.T, drives((), log.u).T, strict=True)):
        rows = log.used & (np.abs(v) > SLOW * np.sqrt(np.mean(v[log.used] ** 2))) if log.used.any() else log.used
        if rows.sum() < 2 * diagnosis.BLOCKS:
            continue
        inertia = np.sqrt(np.mean((standing - weight)[rows, j] ** 2) / np.maximum(np.mean(a[rows] ** 2), 1e-300))
        columns = [v, np.sign(v), np.ones_like(v), inertia * a, weight[:, j], -motor]
        least = (0.0, 0.0, -np.inf, 0.0, -1.0, 1 / HEAVIEST - 1)
        most = (np.inf, np.inf, np.inf, heaviest, heaviest, HEAVIEST)
        count = len(columns) if scaled else len(columns) - 1
        matrix = np.stack(columns[:count], axis=1)[rows]
        size = np.maximum(np.sqrt(np.mean(matrix**2, axis=0)), 1e-300)
        bounds = tuple(np.array(each[:count]) * size for each in (least, most))
        best = lsq_linear(matrix / size, (motor - moving[:, j])[rows], bounds)
        # Relative to the torques as scaled, or else the smallest scale would explain all.
        motor = motor[rows] * (1 + (best.x[-1] / size[-1] if scaled else 0.0))
        squares = np.array([part.mean() for part in np.array_split(best.fun**2, diagnosis.BLOCKS)])
        # Of a joint without a motor all torques sum to zero: its error is compared with those that have to balance.
        inertial = (standing - weight)[rows, j]
        balancing = np.mean(inertial**2 + (moving[rows, j] - inertial) ** 2)
        blocks.append(2 * squares / max(np.mean(motor**2 + moving[rows, j] ** 2), balancing))
    if not blocks:
        return None
    return diagnosis.Unexplained(np.stack(blocks, axis=1), np.zeros(len(blocks)), np.ones(len(blocks), bool))
