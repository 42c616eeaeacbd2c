"""Faults of the clock that stamps a log: repeated stamps, missing rows, and a clock that was set during the log."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.calibration.diagnosis._finding import Finding, Rows, counted
from covariant.calibration.diagnosis._thresholds import CONTINUES, FAR, GAP, JITTER, JUMP, SEEN
from covariant.logs import displaced_rows
from covariant.signals import Record

MONOTONIC = "stamp rows by a clock that nobody sets, such as CLOCK_MONOTONIC or `time.monotonic`"


class Mended(NamedTuple):
    """A log with rising stamps, and findings on the original ones.

    Attributes:
        record: The log: rows with a repeated stamp are left out, and stamps continue by the usual step where the clock
            was set back.
        findings: Findings on repeated stamps and on a clock that was set back.

    Example:
        >>> import numpy as np
        >>> from covariant import Record
        >>> from covariant.calibration import mended_clock
        >>> t = np.array([0.0, 0.1, 0.2, 0.2, 0.3, 0.1, 0.2, 0.3])
        >>> mended = mended_clock(Record(t, y=np.zeros((8, 1))))
        >>> [finding.what for finding in mended.findings], mended.record.t.round(1).tolist()
        (['repeated stamps', 'clock set back'], [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    """

    record: Record
    findings: tuple[Finding, ...]


def mended_clock(record: Record) -> Mended:
    """Make the stamps of a log rise, and report where they did not.

    Args:
        record: The log, with stamps in seconds that may repeat or go back.

    Returns:
        The mended log and the findings.
    """
    t = np.array(record.t, float)
    rows, findings = Rows(t.copy()), []
    if (displaced := displaced_rows(t)) is not None:
        t[displaced.rows] -= displaced.late
        evidence = f"{len(displaced.rows)} of {len(t)} rows are stamped {displaced.how}, the rows around them are not: "
        evidence += rows.listed(displaced.rows)
        line = f"{displaced.remedy}; read all parts of a stamp at once, since a second that begins between them is lost"
        numbers = {"rows": len(displaced.rows), "late": displaced.late}
        findings.append(Finding("clock of single rows", "", evidence, line, True, numbers))
    steps = np.diff(t)
    rising = steps[steps > 0]
    usual = float(np.median(rising)) if len(rising) else 1.0
    same, back = np.flatnonzero(steps == 0) + 1, np.flatnonzero(steps < 0) + 1
    if len(same):
        evidence = f"{len(same)} of {len(t)} rows have the stamp of the row before: {rows.listed(same)}"
        line = "keep one row of each stamp, or log stamps with more digits; here the first of each is compared"
        findings.append(Finding("repeated stamps", "", evidence, line, True, {"rows": len(same)}))
    if len(back):
        longest = float(-steps.min())
        evidence = f"time goes back in {counted(len(back), 'place')}, by up to {longest:.4g} s: {rows.listed(back)}"
        line = f"{MONOTONIC}; split this log there: each part is a log by itself"
        numbers = {"places": len(back), "longest": longest}
        findings.append(Finding("clock set back", "", evidence, line, True, numbers))
    mended = t[0] + np.concatenate([[0.0], np.cumsum(np.where(steps < 0, usual, steps))])
    kept = np.concatenate([[True], steps != 0])
    return Mended(Record(mended[kept], *(np.asarray(a)[kept] for a in record[1:3])), tuple(findings))


def stamps(t: Float[np.ndarray, "T"]) -> list[Finding]:
    """Findings on missing rows and irregular stamps."""
    steps = np.diff(t)
    usual = float(np.median(steps))
    # 1.4826 makes the median deviation of normal steps their standard deviation; few gaps hardly change a median.
    jitter = 1.4826 * float(np.median(np.abs(steps - usual)))
    gaps = steps > max(GAP * usual, usual + FAR * jitter)
    findings = []
    if gaps.any():
        # A gap of k usual steps lacks k − 1 rows.
        missing = int(np.sum(np.rint(steps[gaps] / usual) - 1))
        evidence = f"{missing} rows are missing in {int(gaps.sum())} places, the longest of {steps.max():.4g} s, where "
        evidence += f"rows are {usual:.4g} s apart"
        line = "nothing to change: estimates use the stamps, and run on with the model alone meanwhile"
        numbers = {"rows": missing, "places": int(gaps.sum()), "longest": float(steps.max())}
        findings.append(Finding("missing rows", "", evidence, line, False, numbers))
    std = float(np.std(steps[~gaps]))
    if std > JITTER * usual:
        evidence = f"rows are {usual:.4g} s ± {std:.2g} s apart, from {steps.min():.4g} s to {steps[~gaps].max():.4g}"
        line = "nothing to change: estimates use the stamps and assume no constant step"
        findings.append(Finding("irregular stamps", "", evidence, line, False, {"step": usual, "std": std}))
    return findings


def set_forward(
    t: Float[np.ndarray, "T"], y: Float[np.ndarray, "T n"], noise: Float[np.ndarray, "n"], rows: Rows
) -> list[Finding]:
    """Findings on long steps in time during which the motion advances only as in a usual step."""
    steps = np.diff(t)
    usual = float(np.median(steps))
    places = [int(k) for k in np.flatnonzero(steps > JUMP * usual) if 3 <= k < len(t) - 4]
    jumps = []
    for k in places:
        before = (y[k] - y[k - 3]) / (t[k] - t[k - 3])
        after = (y[k + 4] - y[k + 1]) / (t[k + 4] - t[k + 1])
        rate, moved = (before + after) / 2, y[k + 1] - y[k]
        scale, seen = np.where(noise > 0, noise, np.inf), np.isfinite(rate + moved)
        displacement = np.linalg.norm((rate * steps[k] / scale)[seen])
        usually, whole = (np.linalg.norm(((moved - rate * h) / scale)[seen]) for h in (usual, steps[k]))
        if displacement > SEEN and usually < CONTINUES * whole:
            jumps.append(k + 1)
    if not jumps:
        return []
    longest = float(max(steps[k - 1] for k in jumps))
    evidence = f"in {counted(len(jumps), 'place')} the stamps go on by up to {longest:.4g} s, and the motion only by "
    evidence += f"the usual step of {usual:.4g} s: {rows.listed(jumps)}"
    numbers = {"places": len(jumps), "longest": longest}
    return [Finding("clock set forward", "", evidence, MONOTONIC, True, numbers)]
