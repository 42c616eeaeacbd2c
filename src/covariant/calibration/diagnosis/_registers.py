"""Rows of a log that were made from others."""

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.diagnosis._finding import Finding, Names, Rows
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
