"""Readings that repeat those of the row before, although the position moves."""

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.diagnosis._finding import MOST_NAMED, Finding, Rows
from covariant.calibration.diagnosis._thresholds import (
    AROUND,
    AT_REST,
    FAST_TICKS,
    FEW_REPEATED,
    FEWEST_FAST,
    HELD_TICKS,
)


def repeated_findings(
    y: Float[np.ndarray, "T n"], ticks: Float[np.ndarray, "n"], names: tuple[str, ...], rows: Rows
) -> list[Finding]:
    """Findings on readings that repeat those of the row before, although the position moves.

    An encoder reads the same number until its next tick; a reading with noise is never the same twice.
    """
    moving = _moving(y, ticks)
    if not moving:
        return _held_ticks(y, ticks, names, rows)
    same = _find_repeats(y, moving)[1:]
    places = np.flatnonzero(same) + 1
    share = float(same.mean())
    if (share <= FEW_REPEATED and len(places) <= MOST_NAMED) or _only_at_rest(y[:, moving], np.append(False, same)):
        return []
    # Distances between changes of the reading are the lengths of its runs.
    runs = np.diff(np.flatnonzero(np.concatenate([[True], ~same, [True]])))
    usual = int(np.median(runs[runs > 1]))
    return [
        Finding(
            "repeated rows",
            ", ".join(names[i] for i in moving),
            f"{len(places)} of {len(y)} rows ({100 * share:.2g} %) repeat the readings of the row before, usually "
            f"{usual} in a row have the same: {rows.listed(places)}",
            "the sensor is slower than the log, or rows were copied: leave the cells that repeat empty",
            share > FEW_REPEATED,
            {"rows": len(places), "share": share, "in_a_row": usual},
        )
    ]


def _held_ticks(
    y: Float[np.ndarray, "T n"], ticks: Float[np.ndarray, "n"], names: tuple[str, ...], rows: Rows
) -> list[Finding]:
    """Findings on encoders that read the same number again although they move by more than a tick a row."""
    findings = []
    for i in np.flatnonzero(ticks > 0):
        same, fast = _held_and_fast(y[:, i], float(ticks[i]))
        if fast.sum() < FEWEST_FAST or same[fast].mean() <= HELD_TICKS:
            continue
        places = np.flatnonzero(same & fast)
        share = float(same[fast].mean())
        evidence = (
            f"of {fast.sum()} rows between which {names[i]} moves by more than a tick, {100 * share:.2g} % repeat the "
            f"reading of the row before: {rows.listed(places)}"
        )
        line = "the sensor is slower than the log, or rows were copied: leave the cells that repeat empty"
        numbers = {"rows": len(places), "share": share}
        findings.append(Finding("repeated rows", names[i], evidence, line, True, numbers))
    return findings


def _held_and_fast(y: np.ndarray, tick: float) -> tuple[Bool[np.ndarray, "T"], Bool[np.ndarray, "T"]]:
    """Rows (T,) that repeat the reading before, and those around which the position moves by more than a tick a row."""
    same, fast = np.zeros(len(y), bool), np.zeros(len(y), bool)
    if len(y) > 2 * AROUND:
        same[1:] = np.diff(y) == 0
        wide = y[2 * AROUND :] - y[: -2 * AROUND]
        # The same direction on both sides, so that a turn or a spike is no motion.
        there = (y[AROUND:-AROUND] - y[: -2 * AROUND]) * wide > 0
        fast[AROUND:-AROUND] = there & (np.abs(wide) > FAST_TICKS * 2 * AROUND * tick)
    return same, fast


def without_repeated(y: Float[np.ndarray, "T n"], ticks: Float[np.ndarray, "n"]) -> Float[np.ndarray, "T n"]:
    """Positions whose readings are missing where they repeat those of the row before."""
    kept = y.copy()
    for i in _moving(y, ticks):
        kept[_find_repeats(y, [i]), i] = np.nan
    for i in np.flatnonzero(ticks > 0):
        same, fast = _held_and_fast(y[:, i], float(ticks[i]))
        if fast.sum() >= FEWEST_FAST and same[fast].mean() > HELD_TICKS:
            kept[same & fast, i] = np.nan
    return kept


def _moving(y: np.ndarray, ticks: np.ndarray) -> list[int]:
    """Positions without ticks that do not stand still."""
    return [i for i in range(y.shape[1]) if ticks[i] == 0 and np.nanmin(y[:, i]) < np.nanmax(y[:, i])]


def _only_at_rest(y: Float[np.ndarray, "T k"], same: Bool[np.ndarray, "T"]) -> bool:
    """Whether readings repeat at rest, and hardly in the fastest quarter of the motion: those of a coarse encoder."""
    if len(y) < 8 * AROUND:
        return False
    moved = np.nan_to_num(np.abs(y[2 * AROUND :] - y[: -2 * AROUND]))
    fastest = (moved > np.quantile(moved, 0.75, axis=0)).any(axis=1)
    return bool(same[AROUND:-AROUND][fastest].mean() < AT_REST * same.mean()) if fastest.any() else False


def _find_repeats(y: np.ndarray, moving: list[int]) -> Bool[np.ndarray, "T"]:
    """Rows (T,) whose readings of these positions are those of the row before."""
    return np.concatenate([[False], (np.diff(y[:, moving], axis=0) == 0).all(axis=1)])
