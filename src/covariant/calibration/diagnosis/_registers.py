"""How columns were read: rows made from others, inputs that were read less often, velocities in other units."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.diagnosis._case import Case
from covariant.calibration.diagnosis._finding import Finding, Names, Rows
from covariant.calibration.diagnosis._sensor_checks import named_unit
from covariant.calibration.diagnosis._smooth import Smooth
from covariant.calibration.diagnosis._suspicion import Suspicion
from covariant.calibration.diagnosis._thresholds import HELD_INPUT, HELD_REGULARLY, OFF_RATE, SAME_RATE
from covariant.logs import Register, unit_factor


def made_rows(
    t: Float[np.ndarray, "T"], y: Float[np.ndarray, "T n"], names: Names, rows: Rows
) -> tuple[Bool[np.ndarray, "T n"], list[Finding]]:
    """Readings (T, n) that lie on the line between others, in all but every k-th row, and findings on them."""
    made, findings = np.zeros(y.shape, bool), []
    for i, column in enumerate(y.T):
        every, first = Register.read_rows(t, column)
        if every == 1:
            continue
        made[:, i] = np.arange(len(t)) % every != first
        begin = f" --from {t[first] - t[0]:.6g}" if first else ""
        evidence = f"only one in {every} rows was read, {rows.named(first)} and every {every} rows from there: the "
        evidence += "others lie on the line between readings, and show neither noise nor ticks"
        line = f"leave them out by --every {every * rows.every}{begin}, or leave these cells empty"
        numbers = {"every": every, "first": first}
        findings.append(Finding("interpolated rows", names.q[i], evidence, line, True, numbers))
    return made, findings


def held_inputs(case: Case) -> Iterator[tuple[Suspicion, Finding]]:
    """Suspect that inputs change in few rows since they were read there alone, with the note if it did so."""
    u = np.asarray(case.record.u)
    for j, (name, column) in enumerate(zip(case.names.u, u.T, strict=True)):
        changes = np.append(0, np.flatnonzero(np.diff(column)) + 1)
        runs = np.diff(changes)
        usual = int(np.median(runs)) if len(runs) > 2 else 1
        # What is switched on and off changes at no regular distance.
        if usual < HELD_INPUT or np.mean(runs % usual == 0) < HELD_REGULARLY:
            continue

        def apply(case: Case, j: int = j, changes: np.ndarray = changes) -> Case:
            t, u = np.asarray(case.record.t), np.array(case.record.u, float)
            u[:, j] = np.interp(t, t[changes], u[changes, j])
            return case._replace(file=case.file._replace(input_between="linear")).with_inputs(u)

        claim = f"{name} changes only every {usual} rows"
        line = f"interpolate {name} between the rows in which it changes, or log it in every row"
        words, numbers = "with the straight line from change to change", {"rows": usual}
        note = "if it acted so, nothing has to change; if it was only read so, interpolate between these rows"
        finding = Finding("inputs between rows", name, claim, note, False, numbers)
        yield Suspicion("inputs between rows", name, words, line, apply, "rows", claim, numbers), finding


def rate_findings(case: Case, log: Smooth, t: np.ndarray, v: Float[np.ndarray, "T n"]) -> list[Finding]:
    """Notes on logged velocities that are not those of the positions."""
    names, stated, findings = case.file.columns.v, case.file.columns.units.get("v", ()), []
    ratios, units = [], []
    for i, unit in enumerate(case.names.units):
        seen = np.isfinite(v[:, i])
        slope = log.v[log.used, i]
        logged = np.interp(log.t[log.used], t[seen], v[seen, i]) if seen.sum() > 1 else slope
        square = float(slope @ slope)
        alike = np.corrcoef(slope, logged)[0, 1] if np.ptp(slope) and np.ptp(logged) else 0.0
        ratio = float(slope @ logged) / square if abs(alike) > SAME_RATE else 1.0
        ratios.append(ratio)
        now = unit_factor(stated[i if len(stated) > 1 else 0]) if stated else 1.0
        text = named_unit(now / ratio, f"{unit}/s")
        units.append(text if text[-1].isalpha() else f"{now / ratio:.3g} {unit}/s".strip())
    off = [i for i, ratio in enumerate(ratios) if abs(ratio - 1) > OFF_RATE]
    if off:
        texts = ", ".join(f"{names[i]} is {ratios[i]:.3g} times the slope of {case.names.q[i]}" for i in off)
        written = f'"{units[0]}"' if len(set(units)) == 1 else "[" + ", ".join(f'"{each}"' for each in units) + "]"
        line = f"[units] v = {written}, or another column"
        where, numbers = ", ".join(names[i] for i in off), {"ratio": ratios}
        evidence = f"{texts}: they are in another unit, and estimates are compared with them"
        findings.append(Finding("unit of velocities", where, evidence, line, False, numbers))
    return findings
