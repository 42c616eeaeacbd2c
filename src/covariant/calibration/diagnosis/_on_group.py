"""What readings on a group show without a chart and without the model: stamps in another unit, and frozen readings."""

import jax
import jax.numpy as jnp
import numpy as np

from covariant.calibration.diagnosis._finding import Finding, Rows
from covariant.calibration.diagnosis._thresholds import FAR, HELD_ROWS, PLAUSIBLE
from covariant.models import MechanicalSystem
from covariant.signals import Record

USUAL_STEP = (1e-4, 1.0)
"""Steps in time [s] of most logs, from which the unit of stamps is guessed."""
USUAL_RATE = (0.01, 100.0)
"""Rates [rad/s or m/s] of most machines."""


def group_findings(model: MechanicalSystem, record: Record, line: str, rows: Rows) -> list[Finding]:
    """Findings on stamps and on frozen readings; `line` is the name of the column of the stamps."""
    y = np.asarray(record.y)
    complete = np.flatnonzero(np.isfinite(y).reshape(len(y), -1).all(axis=1))
    if len(complete) < 3:
        return []
    q = jnp.asarray(y[complete])
    displacements = jax.jit(jax.vmap(model.manifold.local))
    steps = np.abs(np.asarray(displacements(q[:-1], q[1:])))
    same = (np.diff(y[complete].reshape(len(complete), -1), axis=0) == 0).all(axis=1)
    return [*clock_findings(np.asarray(record.t)[complete], steps, line), *_frozen(same, steps, complete, rows)]


def clock_findings(
    t: np.ndarray, steps: np.ndarray, line: str, plausible: tuple[float, float] = PLAUSIBLE
) -> list[Finding]:
    """A finding on steps in time that no machine has, with the unit in which time and rates are usual ones."""
    step = float(np.median(np.diff(t)))
    if plausible[0] <= step <= plausible[1]:
        return []
    moved = np.median(np.max(steps, axis=1))

    def distance(low: float, high: float, value: float) -> float:
        return max(np.log(low / value), np.log(value / high), 0.0)

    def unusual(factor: float) -> float:
        seconds = factor * step
        return distance(*USUAL_STEP, seconds) + (distance(*USUAL_RATE, moved / seconds) if moved else 0.0)

    units = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9} if step > 1 else {"1e+03 s": 1e3, "1e+06 s": 1e6, "1e+09 s": 1e9}
    unit = min(units, key=lambda each: unusual(units[each]))
    seconds = units[unit] * step
    evidence = f"rows are {step:.4g} s apart, which no machine is logged at; in {unit} they are {seconds:.4g} s apart"
    numbers = {"step": step, "factor": units[unit]}
    return [Finding("unit of time", line, evidence, f'[units] t = "{unit}"', True, numbers)]


def _frozen(same: np.ndarray, steps: np.ndarray, complete: np.ndarray, rows: Rows) -> list[Finding]:
    """A finding on readings that repeat without end, while the rest of them moves by more than they resolve."""
    count = len(same) + 1
    if same.all():
        line = "log a motion: nothing can be told from this log"
        evidence = f"the configuration has one value in all {count} rows"
        return [Finding("nothing moves", "", evidence, line, True, {"rows": count})]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]])))
    begins, ends = edges[::2], edges[1::2]
    sizes = np.linalg.norm(steps, axis=1)
    usual = float(np.median(sizes[~same]))
    # Where few digits are printed a slow motion repeats readings by right, in all runs alike.
    often = float(np.median(np.diff(np.flatnonzero(np.concatenate([[True], ~same, [True]])))))

    def stops(k: int) -> bool:
        """Whether the motion stops at full speed, or goes on with a jump: a body that rests has slowed down before."""
        before, after = sizes[max(begins[k] - 3, 0) : begins[k]], sizes[ends[k] : ends[k] + 1]
        return bool((len(before) and np.median(before) > usual / 3) or (len(after) and after[0] > FAR * usual))

    frozen = [k for k in range(len(begins)) if ends[k] - begins[k] > max(FAR * often, HELD_ROWS) and stops(k)]
    total = int(sum(ends[k] - begins[k] for k in frozen))
    if not frozen:
        return []
    longest = max(frozen, key=lambda k: ends[k] - begins[k])
    run, first = int(ends[longest] - begins[longest]), rows.named(int(complete[begins[longest] + 1]))
    evidence = f"{total} of {count} rows repeat the configuration of the row before, {run} in a row from {first} on: "
    evidence += "the sensor froze, or is slower than the log"
    numbers = {"rows": total, "share": total / count, "in_a_row": run + 1}
    return [Finding("repeated rows", "", evidence, "leave the cells that repeat empty", True, numbers)]
