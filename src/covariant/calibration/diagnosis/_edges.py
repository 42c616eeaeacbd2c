"""Logs of the edges of an encoder: a row comes when a reading changes by one tick, and not at even times."""

import numpy as np
from jaxtyping import Float

from covariant.calibration.diagnosis._finding import Finding, Names
from covariant.calibration.diagnosis._readings import FEWEST, one_or_each, shown, written
from covariant.calibration.diagnosis._thresholds import EDGE_JITTER, FEW_REPEATED, ONE_TICK

FINER = 0.1
"""Standard deviation of a position at an edge, in ticks: how evenly an encoder divides its turn."""


def edge_findings(
    t: Float[np.ndarray, "T"],
    y: Float[np.ndarray, "T n"],
    ticks: Float[np.ndarray, "n"],
    names: Names,
    stated: float | tuple[float, ...] | None,
) -> list[Finding]:
    """A finding if every row is an edge: positions are then known far better than to a tick, at these times only."""
    gaps = np.diff(t)
    if len(t) < FEWEST or not (ticks > 0).all() or np.std(gaps) < EDGE_JITTER * np.median(gaps):
        return []
    steps = np.rint(np.diff(y, axis=0) / ticks)
    if not np.isfinite(steps).all():
        return []
    moved = np.abs(steps[steps != 0])
    none = (steps == 0).all(axis=1)
    # Where the motion turns, the same edge is passed twice: a log of the edges' places then repeats a reading.
    turns = [_turns(column) for column in steps.T]
    repeated = sum(again for again, _ in turns) > sum(changed for _, changed in turns)
    unexplained = none.sum() - (sum(again for again, _ in turns) if repeated else 0)
    if not len(moved) or np.mean(moved == 1) < ONE_TICK or unexplained > FEW_REPEATED * len(none):
        return []
    std = f"[measurement] std = {written(one_or_each(FINER * ticks, names.units, 2))}"
    evidence = (
        f"each row comes when a position changes by one tick, {shown(ticks, names.units, 5)}, and its stamp is when "
        "that edge passed"
    )
    where = "the place of the edge is logged"
    if not repeated:
        where = "the position is then midway between the reading and the one before"
        std = f"put the mean of each reading and the one before in its place, and {std}"
    evidence = f"{evidence}: {where}, and a quantum would take it as known to a tick only, until the next row"
    numbers = {"quantum": one_or_each(ticks, names.units, 17), "stated": stated}
    return [Finding("ticks", ", ".join(names.q), evidence, std, stated is not None, numbers)]


def _turns(steps: Float[np.ndarray, "T"]) -> tuple[int, int]:
    """How often a motion turns with one reading repeated, and how often with none."""
    at = np.flatnonzero(steps)
    turned = np.flatnonzero(np.sign(steps[at[1:]]) != np.sign(steps[at[:-1]]))
    apart = at[turned + 1] - at[turned]
    return int((apart > 1).sum()), int((apart == 1).sum())
