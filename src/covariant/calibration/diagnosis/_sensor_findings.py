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
        statement = (
            f"the model file says {shown(stated_ticks, units, 4)}" if stated else "the model file does not say so"
        )
        key, number = ("quantum", ticks) if len(counting) == len(ticks) else ("std", sensor.std)
        findings.append(
            Finding(
                "ticks",
                ", ".join(names[i] for i in counting),
                f"positions are whole ticks of {apart} apart, and {statement}",
                f"[measurement] {key} = {written(one_or_each(number, units, 5))}",
                stated is not None,
                {"quantum": one_or_each(ticks, units, 17), "stated": stated},
            )
        )
    usual = np.full(len(ticks), np.inf) if std is None else np.broadcast_to(std, len(ticks))
    noisy = (ticks == 0) & sensor.white & (sensor.noise > NOISIER * usual)
    if noisy.any():
        worst = int(np.argmax(np.where(noisy, sensor.noise / usual, 0.0)))
        std = one_or_each(np.where(noisy, sensor.noise, usual), units, 2)
        findings.append(
            Finding(
                "noise",
                ", ".join(name for name, bad in zip(names, noisy, strict=True) if bad),
                f"positions have noise of {shown(sensor.noise[[worst]], [units[worst]], 3)}, "
                f"{sensor.noise[worst] / usual[worst]:.2g} times that of the model file",
                f"[measurement] std = {written(std)}",
                True,
                {"std": float(sensor.noise[worst]), "stated": float(usual[worst])},
            )
        )
    return findings


def standstill(record: Record, circles: tuple[int, ...], columns: Names, ticks: np.ndarray) -> Finding:
    """Finding for a log whose motion is too small or too short for the comparison."""
    t, y = np.asarray(record.t), unwrap(np.asarray(record.y), circles)
    ranges = [
        f"{name} by {np.nanmax(c) - np.nanmin(c):.3g} {unit}".rstrip()
        for name, c, unit in zip(columns.q, y.T, columns.units, strict=True)
    ]
    return Finding(
        "too little motion",
        "",
        f"in {t[-1] - t[0]:.3g} s of {len(t)} rows {', '.join(ranges)} moved: too little or too short to tell an "
        "acceleration from noise",
        "log a motion that is large against the noise: accelerations, on which units, signs, order and delays are "
        "judged, cannot be compared in this log",
        # Of known encoders that are too coarse for this motion nothing is wrong with the log.
        not (ticks > 0).all(),
        {"rows": len(t)},
    )
