"""How columns were read: rows made from others, and inputs that were read less often."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.diagnosis._case import Case
from covariant.calibration.diagnosis._finding import Finding, Names, Rows
from covariant.calibration.diagnosis._suspicion import Suspicion
from covariant.calibration.diagnosis._thresholds import HELD_INPUT, HELD_REGULARLY
from covariant.logs import Register


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
