"""Findings on each sensor beside the positions: its sign, axes, unit, delay, bias and noise."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from covariant.calibration.diagnosis._case import Case
from covariant.calibration.diagnosis._finding import Finding
from covariant.calibration.diagnosis._sensor_changes import Verdict, best_rotation, judged
from covariant.calibration.diagnosis._sensor_findings import NOISIER
from covariant.calibration.diagnosis._sensor_motion import Beside, Pair, pair
from covariant.logs import unit_factor

SIGNIFICANT = 5.0
"""Standard errors from which a number of a sensor counts."""
OFF_SCALE = 0.1
"""Deviation of a scale from 1 from which it counts."""
LATE = 1.0
"""Delay in rows from which it counts."""
BIASED = 4.0
"""Bias in standard deviations of the one that the table allows from which it counts."""
UNEXPLAINED = 0.5
"""Part of the readings that no change explains from which they are not those of the sensor."""
TURNED = np.deg2rad(5.0)
"""Turn [rad] of the axes of a sensor from which it counts."""
NAMED = 0.05
"""Relative distance up to which a scale is taken for one of a unit."""
UNITS = {
    "rad/s": ("rad/s", "deg/s", "rpm", "mrad/s", "turn/s"),
    "m/s^2": ("m/s^2", "9.80665 m/s^2", "9.80665 mm/s^2", "mm/s^2", "cm/s^2"),
    "m/s": ("m/s", "mm/s", "cm/s", "km/h"),
    "m": ("m", "mm", "cm", "um"),
    "rad": ("rad", "deg", "turn", "mrad"),
}
"""Units to try for readings in SI units."""
OTHER_ORDER = {"quaternion_wxyz": "quaternion_xyzw", "quaternion_xyzw": "quaternion_wxyz"}
"""Attitudes that are taken for one another."""


def sensor_checks(case: Case, t: Float[np.ndarray, "T"], sensors: Sequence[Beside], late: Any = 0.0) -> list[Finding]:
    """Judge each sensor beside the positions by what the positions predict of it."""
    findings = []
    for each in sensors:
        found = _findings(case, np.asarray(t, float), each, late)
        units = [one for one in found if one.what in ("unit of a sensor", "sign of a sensor")]
        findings += [_of_velocities(each, one) for one in units] if each.compared else found
    return findings


def _of_velocities(beside: Beside, finding: Finding) -> Finding:
    """The note on logged velocities in another unit: nothing else of them matters."""
    line = f"[units] v{finding.line.rpartition('units')[2]}"
    line = re.sub(r'"(-?[\d.]+)"', rf'"\1 {beside.unit}"', line) if beside.unit else line
    where = ", ".join(beside.names)
    return finding._replace(what="unit of velocities", where=where, line=f"{line}, or another column", wrong=False)


def _findings(case: Case, t: np.ndarray, beside: Beside, late: Any) -> list[Finding]:
    if not np.isfinite(beside.readings).any():
        return []
    seen = pair(case, t, beside, late)
    name = beside.sensor.name
    spacing = float(np.median(np.diff(t[np.isfinite(beside.readings).any(axis=1)])))
    if seen is None:
        evidence = "too few readings, or too short a motion, to compare it with the positions"
        return [Finding("sensor not judged", name, evidence, "", False, {})]
    if beside.pose:
        turned = _pose_rotation_finding(seen, beside)
        if turned is not None:
            return [turned]
        seen = _first(seen, 3)
    notes = _unjudged_findings(seen, beside)
    verdict = judged(seen, beside.checks.vector, beside.checks.offset)
    found = _wrong(seen, beside, verdict, spacing) if seen.shown.any() else None
    if found is None:
        found = _bias_finding(seen, beside, verdict) or _noisy(seen, beside)
    return [*([] if found is None else [found]), *notes]


def _wrong(seen: Pair, beside: Beside, verdict: Verdict, spacing: float) -> Finding | None:
    """The first finding on sign, order, axes, scale and delay."""
    name, left = beside.sensor.name, f"of the variance of its readings the positions leave {_percent(verdict.before)}"
    shown = seen.shown | beside.checks.vector
    if verdict.after > UNEXPLAINED:
        evidence = f"{left}, and {_percent(verdict.after)} with the best sign, axes, unit and delay"
        line = f"look at kind, {'of' if beside.checks.coordinates else 'link'} and columns of [sensors.{name}]"
        return Finding("sensor", name, evidence, line, True, {"unexplained": verdict.before})
    after = f"{left}, and {_percent(verdict.after)}"
    numbers: dict[str, Any] = {
        "unexplained": verdict.before,
        "unexplained_after": verdict.after,
        "delay": verdict.delay,
        "delay_std": verdict.delay_std,
        "scale": verdict.scale.tolist(),
    }
    if verdict.change.kind:
        return _change_finding(seen, beside, verdict, after, numbers)
    turned = _rotation_finding(seen, beside)
    if turned is not None:
        return turned
    off = shown & (np.abs(verdict.scale - 1) > np.maximum(OFF_SCALE, SIGNIFICANT * verdict.scale_std))
    if off.any():
        return _scale_finding(beside, verdict, off, after, numbers)
    if abs(verdict.delay) > max(LATE * spacing, SIGNIFICANT * verdict.delay_std):
        return _late(beside, verdict, spacing, after, numbers)
    return None


def _change_finding(seen: Pair, beside: Beside, verdict: Verdict, after: str, numbers: dict[str, Any]) -> Finding:
    """The finding on signs, columns or axes."""
    name, matrix = beside.sensor.name, verdict.change.matrix
    numbers = numbers | {"matrix": matrix.tolist()}
    where = f"[sensors.{name}]"
    if verdict.change.kind == "sign":
        turned = np.diag(matrix) < 0
        which = "all signs" if turned.all() else f"the sign of {_list_names(beside.names, turned)}"
        line = f"{where} {_units_line(beside, np.where(turned, -1.0, 1.0))}"
        return Finding("sign of a sensor", name, f"{after} with {which} reversed", line, True, numbers)
    line = ""
    if verdict.change.kind == "order":
        # Row i of the matrix has its 1 at the number that column i really is.
        order = np.argmax(matrix, axis=0)
        names = ", ".join(f'"{beside.names[i]}"' for i in order)
        line = f"{where} columns = [{names}]"
        if beside.checks.own_axes and np.linalg.det(matrix) > 0:
            line += f", or {_axes_line(beside, matrix)}"
        what = f"{after} with the columns in the order {', '.join(beside.names[i] for i in order)}"
        return Finding("axes of a sensor", name, what + _single_axis_note(seen, beside), line, True, numbers)
    line = f"{where} {_axes_line(beside, matrix)}" if beside.checks.own_axes else _frame_line(matrix)
    evidence = f"{after} with its axes turned by {_degrees(matrix):.3g}°{_single_axis_note(seen, beside)}"
    return Finding("axes of a sensor", name, evidence, line, True, numbers)


def _rotation_finding(seen: Pair, beside: Beside) -> Finding | None:
    """The finding on axes that are turned by a smaller angle."""
    if not beside.checks.vector:
        return None
    # Always with a free offset: against gravity a bias looks like a turn.
    matrix, known = best_rotation(seen, True)
    half = len(seen.t) // 2
    parts = [
        best_rotation(seen._replace(used=seen.used & each), True)[0]
        for each in (np.arange(len(seen.t)) < half, np.arange(len(seen.t)) >= half)
        if (seen.used & each).sum() > 3
    ]
    # Two halves of the log have to agree on it: a bias that drifts looks like a turn too.
    apart = np.deg2rad(_degrees(parts[0].T @ parts[-1])) if parts else np.inf
    angle = np.deg2rad(_degrees(matrix))
    if angle < max(TURNED, 2 * apart):
        return None
    where = f"[sensors.{beside.sensor.name}] "
    line = where + _axes_line(beside, matrix) if beside.checks.own_axes else _frame_line(matrix)
    evidence = f"its axes are turned by {np.rad2deg(angle):.3g}° against those of the model file"
    evidence += "" if known else _single_axis_note(seen, beside)
    return Finding("axes of a sensor", beside.sensor.name, evidence, line, True, {"matrix": matrix.tolist()})


def _pose_rotation_finding(seen: Pair, beside: Beside) -> Finding | None:
    """The finding on the attitude of a pose, whose twelve numbers are a position and a rotation."""
    predicted, read = (each[seen.used][:, 3:].reshape(-1, 3, 3) for each in (seen.predicted, seen.read))
    turn, explained = _common_turn(predicted, read)
    if explained > 1 - UNEXPLAINED / 2 and _degrees(turn) < np.rad2deg(TURNED):
        return None
    other = next((other for one, other in OTHER_ORDER.items() if getattr(beside.columns, one)), None)
    if other is not None:
        again, share = _common_turn(predicted, _reorder_quaternions(read, other))
        if share > 1 - UNEXPLAINED / 2 and _degrees(again) < np.rad2deg(TURNED):
            off, then = _degrees(turn), _degrees(again)
            evidence = f"its attitudes are {off:.3g}° off, and {then:.2g}° in the order of {other}"
            line = f'[sensors.{beside.sensor.name}] attitude = "{other}"'
            return Finding("axes of a sensor", beside.sensor.name, evidence, line, True, {"attitude": other})
    if explained < 1 - UNEXPLAINED / 2:
        evidence = "no turn of its axes explains its attitudes"
        line = f"look at attitude, columns and link of [sensors.{beside.sensor.name}]"
        return Finding("sensor", beside.sensor.name, evidence, line, True, {})
    evidence = f"its attitude is turned by {_degrees(turn):.3g}° against the link"
    # turn: from the axes that are read to those that the model file states.
    line = f"[sensors.{beside.sensor.name}] {_axes_line(beside, turn.T)}"
    return Finding("axes of a sensor", beside.sensor.name, evidence, line, True, {"matrix": turn.T.tolist()})


def _common_turn(predicted: np.ndarray, read: np.ndarray) -> tuple[np.ndarray, float]:
    """The rotation (3, 3) T with `read = predicted T`, and how much of the attitudes it explains, at most 1."""
    u, s, vt = np.linalg.svd(np.einsum("kij,kil->jl", predicted, read) / len(read))
    # The singular values are all 1 where one turn explains all attitudes.
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, float(s.sum() / 3)


def _reorder_quaternions(read: np.ndarray, other: str) -> np.ndarray:
    """Attitudes (K, 3, 3) whose quaternions are in another order than they were read in."""
    from scipy.spatial.transform import Rotation

    last = Rotation.from_matrix(read).as_quat()  # x, y, z, w
    # Cells w x y z that are x y z w: the first three are the vector. The other way round the first is the scalar.
    cells = np.roll(last, 1, axis=1) if other == "quaternion_xyzw" else np.roll(last, -1, axis=1)
    return Rotation.from_quat(cells).as_matrix()


def _scale_finding(beside: Beside, verdict: Verdict, off: np.ndarray, after: str, numbers: dict[str, Any]) -> Finding:
    """The finding on scales: a sign, a unit, or a gear."""
    name, scale = beside.sensor.name, np.where(off, verdict.scale, 1.0)
    where, which = f"[sensors.{name}]", _list_names(beside.names, off)
    if (np.abs(scale + 1) < OFF_SCALE)[off].all():
        alone = "all signs" if off.all() and len(off) > 1 else f"the sign of {which}"
        evidence, line = f"{after} with {alone} reversed", f"{where} {_units_line(beside, scale)}"
        return Finding("sign of a sensor", name, evidence, line, True, numbers)
    values = [f"{value:.4g} ± {std:.2g}" for value, std in zip(scale[off], verdict.scale_std[off], strict=True)]
    evidence = f"{which}: readings are {values[0] if beside.checks.vector else ', '.join(values)} times what the "
    evidence += f"positions say; {after} with that scale"
    units = _units_line(beside, scale)
    line = f"{where} {units}"
    if beside.checks.coordinates and not any(letter.isalpha() for letter in units.split("=")[1]):
        # A scale of no unit is a gear.
        kind: Any = beside.sensor.h
        line = f"{where} reduction = {_number_or_list(np.asarray(kind.reduction) * scale)}, or {units}"
    return Finding("unit of a sensor", name, evidence, line, True, numbers)


def _late(beside: Beside, verdict: Verdict, spacing: float, after: str, numbers: dict[str, Any]) -> Finding:
    name, delay = beside.sensor.name, verdict.delay
    size = f"{1e3 * abs(delay):.3g} ms ± {1e3 * verdict.delay_std:.2g} ms, {abs(delay) / spacing:.2g} rows,"
    total = beside.delay + delay
    stated = f" than its delay of {1e3 * beside.delay:g} ms says" if beside.delay else " than the positions"
    evidence = f"its readings are {size} {'later' if delay > 0 else 'earlier'}{stated}; {after} then"
    line = f"[sensors.{name}] delay = {total:.2g}"
    if total < 0:
        line = f"[measurement] delay = {-total:.2g} more, or add {-total:.2g} s to the stamps of {name}"
    return Finding("delay of a sensor", name, evidence, line, True, numbers)


def _bias_finding(seen: Pair, beside: Beside, verdict: Verdict) -> Finding | None:
    """The finding on a bias that the table does not allow for."""
    sensor, bias = beside.sensor, np.array(verdict.bias)
    std = np.sqrt(np.diag(np.asarray(sensor.cov)))[: len(bias)]
    if sensor.period is not None:
        turn = np.asarray(sensor.period)
        bias = np.where(turn > 0, bias - turn * np.round(bias / np.where(turn > 0, turn, 1.0)), bias)
    allowed, slow = std, sensor.slow
    if slow is not None:
        lasted = float(seen.t[-1] - seen.t[0])
        allowed = BIASED * np.sqrt(np.diag(np.asarray(slow.first_cov) + lasted * np.asarray(slow.walk_cov)))
    big = np.abs(bias) > np.maximum(allowed, SIGNIFICANT * verdict.bias_std)
    if not big.any():
        return None
    values = ", ".join(
        f"{name} by {value:.3g} ± {error:.2g} {beside.unit}".rstrip()
        for name, value, error, bad in zip(beside.names, bias, verdict.bias_std, big, strict=False)
        if bad
    )
    said = "its table has no bias" if slow is None else "that is more than 4 times the bias of its table"
    size = float(f"{np.abs(bias[big]).max():.2g}")
    line = f"[sensors.{sensor.name}] bias = {size:g}"
    if beside.checks.vector and not beside.checks.own_axes:
        line = f"look at place of [sensors.{sensor.name}], and at the origin of the world that it measures in"
    evidence = f"readings are off all the time, {values}, and {said}"
    return Finding("bias of a sensor", sensor.name, evidence, line, True, {"bias": bias.tolist()})


def _noisy(seen: Pair, beside: Beside) -> Finding | None:
    """The finding on noise beyond the table's."""
    std = np.sqrt(np.diag(np.asarray(beside.sensor.cov)))[: len(seen.noise)]
    noisy = seen.noise > NOISIER * std
    if not noisy.any():
        return None
    worst = int(np.argmax(np.where(noisy, seen.noise / std, 0.0)))
    noise, key = float(seen.noise[worst]), "position_std" if beside.pose else "std"
    evidence = f"{beside.names[worst]} has noise of {noise:.3g} {beside.unit}".rstrip()
    evidence += f", {noise / std[worst]:.3g} times that of its table"
    line = f"[sensors.{beside.sensor.name}] {key} = {noise:.2g}"
    numbers = {"std": noise, "stated": float(std[worst])}
    return Finding("noise of a sensor", beside.sensor.name, evidence, line, True, numbers)


def _unjudged_findings(seen: Pair, beside: Beside) -> list[Finding]:
    """A note on what the motion does not show of a sensor."""
    if seen.shown.all():
        return []
    which = _list_names(beside.names, ~seen.shown)
    evidence = f"the motion hardly changes what {which} should read: sign, axes, unit and delay of that are not judged"
    return [Finding("sensor not judged", beside.sensor.name, evidence, "", False, {"columns": which})]


def _single_axis_note(seen: Pair, beside: Beside) -> str:
    known = best_rotation(seen, beside.checks.offset)[1] if beside.checks.vector else True
    return "" if known else "; the motion is about one axis, so that a turn about that axis is not determined"


def _units_line(beside: Beside, scale: np.ndarray) -> str:
    """The units that readings are in, which the table takes for others by a scale (k,)."""
    if beside.pose:
        name = named_unit(float(1 / scale[0]), "m")
        return f"has its position in m: {', '.join(beside.names[:3])} are in units of {name}"
    texts = list(beside.columns.units.get("q", ()))
    now = (texts * len(scale) if len(texts) == 1 else texts) or ["1"] * len(scale)
    factors = np.array([unit_factor(text) for text in now[: len(scale)]]) / scale
    written = [
        text if s == 1 and texts else named_unit(f, beside.unit)
        for f, s, text in zip(factors, scale, now, strict=False)
    ]
    return f'units = "{written[0]}"' if len(set(written)) == 1 else f"units = {written}".replace("'", '"')


def named_unit(factor: float, unit: str) -> str:
    """Text of a unit of a factor to SI units, by name where one is near."""
    for name in UNITS.get(unit, ()):
        if abs(abs(factor) / unit_factor(name) - 1) < NAMED:
            return name if factor > 0 else f"-1 {name}"
    return f"{factor:.4g}"


def _axes_line(beside: Beside, matrix: np.ndarray) -> str:
    """The axes of a table, from the rotation (3, 3) of its readings: r = M Aᵀω is that of A Mᵀ."""
    kind: Any = beside.sensor.h
    u, _, vt = np.linalg.svd(np.asarray(kind.axes) @ matrix.T)
    rows = [", ".join(f"{value + 0.0:.7g}" for value in np.round(row, 7)) for row in u @ vt]
    return f"axes = [{', '.join(f'[{row}]' for row in rows)}]"


def _frame_line(matrix: np.ndarray) -> str:
    rows = ", ".join(f"[{', '.join(f'{value + 0.0:.4g}' for value in np.round(row, 4))}]" for row in matrix.T)
    return f"multiply its readings by [{rows}]: they are in another frame than the world of the model"


def _first(seen: Pair, count: int) -> Pair:
    """The first numbers of a pair."""
    cut = {name: getattr(seen, name)[..., :count] for name in Pair._fields if name not in ("t", "used", "half")}
    return seen._replace(**cut)


def _degrees(rotation: np.ndarray) -> float:
    return float(np.rad2deg(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1.0, 1.0))))


def _number_or_list(values: np.ndarray) -> str:
    texts = [f"{value:.4g}" for value in values]
    return texts[0] if len(set(texts)) == 1 else f"[{', '.join(texts)}]"


def _list_names(names: Sequence[str], which: np.ndarray) -> str:
    return ", ".join(name for name, each in zip(names, which, strict=False) if each)


def _percent(share: float) -> str:
    # Readings in another unit or of the other sign are farther off than no prediction at all.
    return f"{100 * share:.3g} %" if share < 1 else "all"
