"""Findings on noise and ticks of the sensors of a log, and on a motion that they hide."""

import numpy as np

from covariant.calibration.diagnosis._finding import Finding, Names
from covariant.calibration.diagnosis._readings import one_or_each, readings, shown, written
from covariant.scoring import unwrap
from covariant.signals import Record

NOISIER = 4.0
"""Measured noise, as a multiple of the data sheet's, from which it is a finding."""


def sensor_findings(
    record: Record,
    circles: tuple[int, ...],
    columns: Names,
    stated: float | tuple[float, ...] | None,
    std: float | tuple[float, ...] | None,
) -> list[Finding]:
    """Findings on ticks and noise, in the units of the model."""
    sensor, names, units = readings(record, circles), columns.q, columns.units
    if not sensor.known:
        return []
    ticks, findings = sensor.ticks, []
    stated_ticks = np.zeros(len(ticks)) if stated is None else np.broadcast_to(stated, len(ticks))
    unexpected = (ticks > 0) & ~((0.95 * stated_ticks < ticks) & (ticks < 1.05 * stated_ticks))
    if unexpected.any():
        counting = [i for i in range(len(ticks)) if ticks[i] > 0]
        apart = shown([ticks[i] for i in counting], [units[i] for i in counting], 5)
        said = f"says {shown(stated_ticks, units, 4)}" if stated else "does not say so"
        evidence = f"positions are whole ticks of {apart} apart, and the model file {said}"
        key, number = ("quantum", ticks) if len(counting) == len(ticks) else ("std", sensor.std)
        line = f"[measurement] {key} = {written(one_or_each(number, units, 5))}"
        where, numbers = ", ".join(names[i] for i in counting), {"quantum": one_or_each(ticks, units, 17)}
        findings.append(Finding("ticks", where, evidence, line, stated is not None, {**numbers, "stated": stated}))
    usual = np.full(len(ticks), np.inf) if std is None else np.broadcast_to(std, len(ticks))
    noisy = (ticks == 0) & sensor.white & (sensor.noise > NOISIER * usual)
    if noisy.any():
        worst = int(np.argmax(np.where(noisy, sensor.noise / usual, 0.0)))
        where = ", ".join(name for name, bad in zip(names, noisy, strict=True) if bad)
        evidence = f"positions have noise of {shown(sensor.noise[[worst]], [units[worst]], 3)}, "
        evidence += f"{sensor.noise[worst] / usual[worst]:.2g} times that of the model file"
        line = f"[measurement] std = {written(one_or_each(np.where(noisy, sensor.noise, usual), units, 2))}"
        numbers = {"std": float(sensor.noise[worst]), "stated": float(usual[worst])}
        findings.append(Finding("noise", where, evidence, line, True, numbers))
    return findings


def standstill(record: Record, circles: tuple[int, ...], columns: Names, ticks: np.ndarray) -> Finding:
    """Finding for a log whose motion is too small or too short for the comparison."""
    t, y = np.asarray(record.t), unwrap(np.asarray(record.y), circles)
    ranges = [
        f"{name} by {np.nanmax(c) - np.nanmin(c):.3g} {unit}".rstrip()
        for name, c, unit in zip(columns.q, y.T, columns.units, strict=True)
    ]
    evidence = f"in {t[-1] - t[0]:.3g} s of {len(t)} rows {', '.join(ranges)} moved: too little or too short to tell "
    evidence += "an acceleration from noise"
    line = "log a motion that is large against the noise: accelerations, on which units, signs, order and delays are "
    line += "judged, cannot be compared in this log"
    # Of known encoders that are too coarse for this motion nothing is wrong with the log.
    return Finding("too little motion", "", evidence, line, not (ticks > 0).all(), {"rows": len(t)})
