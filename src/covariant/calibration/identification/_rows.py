"""Rows of logs that a fit uses, one after the other, and those that are held out."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from covariant._linalg import known_rms
from covariant.geometry import AbstractManifold
from covariant.models import Motion
from covariant.scoring import unwrap
from covariant.signals import AnyArray, Record
from scalargraph.errors import InputError

MOST_ROWS = 20_000
"""Usual largest number of rows of a fit; beyond it stretches of `STRETCH` rows are left out evenly."""
STRETCH = 500
FEWEST_ROWS, FEWEST_WINDOWS = 12, 8
"""Least number of rows with a reading, in which a log shows anything, and of windows that judge a fit to several."""
LONGEST_GAP = 5.0
"""Longest step within a stretch, in median steps: after a longer gap in the stamps a new one begins."""
FITTED = 2 / 3
"""Fraction of a log, its first part, that a fit to it alone or a tuning uses; the rest judges."""
BETWEEN_LOGS = 1e9
"""Step [s] put between the inputs of two logs, so that a lag of the first has died away in the second."""
BLOCKS, EACH, FEWEST_IN_BLOCK = 32, 12, 10
"""Numbers of blocks of rows whose errors are taken as independent, in all or of each machine, and their least number of
rows."""
SIZES = 4
"""Numbers of rows in an octave to which rows are padded, so that few programs serve logs of any length."""


class Rows(NamedTuple):
    """T rows of one or more logs, and the inputs of the whole logs.

    A stretch of rows without a gap begins with a motion of its own. Padding, at the end, has no readings.

    Attributes:
        t: Stamps (T,) [s].
        y: Measured positions (T, ...), NaN where missing.
        start: Motion near the true one, from the readings: configurations (T, ...) and velocities (T, n).
        rows: Row (T,) of `inputs` that acts in the step after it.
        inputs: Inputs (S, m) of all rows of the logs.
        steps: Time (S,) since the row before [s].
        fresh: Rows (T,) at which a stretch begins.
        block: Block (T,) that each row is in, from 0; blocks are in order.
        machine: Index (B,) of the machine of each block, of several with numbers of their own.
        used: Number of rows before the padding.
    """

    t: Float[AnyArray, "T"]
    y: AnyArray
    start: Motion
    rows: Int[AnyArray, "T"]
    inputs: Float[AnyArray, "S m"]
    steps: Float[AnyArray, "S"]
    fresh: Bool[AnyArray, "T"]
    block: Int[AnyArray, "T"]
    machine: Int[AnyArray, "B"]
    used: int

    def only(self, kept: Bool[np.ndarray, "T"]) -> "Rows":
        """The rows with readings at some of them only; programs are the same for any selection."""
        y = np.asarray(self.y)
        seen = np.where(kept.reshape(-1, *[1] * (y.ndim - 1)), y, np.nan)
        # Where nothing is read the motion begins anew in each row: the uncertainty of one that goes on may overflow.
        return self._replace(y=seen, fresh=np.asarray(self.fresh) | ~kept | np.diff(kept, prepend=kept[:1]))

    @property
    def of_machine(self) -> Int[np.ndarray, "T"]:
        """Index (T,) of the machine of each row."""
        return np.asarray(self.machine)[np.asarray(self.block)]

    @property
    def step(self) -> float:
        """Usual time from a row to the next [s]."""
        steps = np.diff(np.asarray(self.t)[: self.used])[~np.asarray(self.fresh)[1 : self.used]]
        return float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0


def gather(
    manifold: AbstractManifold,
    records: Sequence[Record],
    velocities: Sequence[Float[np.ndarray, "_ n"]],
    machines: Sequence[int] | None = None,
    most: int = MOST_ROWS,
) -> Rows:
    """Put the rows of records one after the other.

    Args:
        manifold: The configurations.
        records: The logs.
        velocities: Reference velocities (T, n) of each, near which the search for the motion begins.
        machines: Index of the machine of each record; by default one machine has made all.
        most: Most rows.

    Returns:
        The rows.

    Raises:
        ValueError: Nothing moves, or there are fewer than `FEWEST_ROWS` readings.
    """
    if all((np.nan_to_num(velocity) == 0.0).all() for velocity in velocities):
        raise InputError("nothing moves in the logs, so that they tell no parameter; log a motion")
    machines = [0] * len(records) if machines is None else machines
    logs = [(np.asarray(r.t, float), np.asarray(r.y, float), np.asarray(r.u, float)) for r in records]
    if sum(int(np.isfinite(y.reshape(len(t), -1)).all(axis=1).sum()) for t, y, _ in logs) < FEWEST_ROWS:
        raise InputError(f"the logs hold fewer than {FEWEST_ROWS} rows with positions; give longer ones")
    t, y, u = (np.concatenate(parts) for parts in zip(*logs, strict=True))
    lengths = [len(log[0]) for log in logs]
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(int)
    steps = np.diff(t, prepend=t[:1] - BETWEEN_LOGS)
    steps[offsets[:-1]] = BETWEEN_LOGS
    fresh = np.concatenate([_begins(own[0]) for own in logs])
    # Where a turn of a joint counts as none, the motion is one without jumps.
    q = np.concatenate([filled(own[0], unwrap(own[1], manifold.circles)) for own in logs])
    v = np.concatenate([filled(own[0], np.asarray(velocity)) for own, velocity in zip(logs, velocities, strict=True)])
    chosen = np.arange(len(t))
    if len(t) > most:
        stretches = len(t) // STRETCH
        kept = np.linspace(0, stretches - 1, most // STRETCH).round().astype(int)
        chosen = np.flatnonzero(np.isin(chosen // STRETCH, kept))
        fresh[chosen[np.diff(chosen, prepend=-2) > 1]] = True
    block, machine = _blocks(chosen, offsets, machines)
    count, size = len(chosen), _padded(len(chosen))

    def pad(column: np.ndarray) -> np.ndarray:
        rows = column[chosen]
        return np.concatenate([rows, np.repeat(rows[-1:], size - count, axis=0)])

    seen = pad(y)
    seen[count:] = np.nan
    block = np.concatenate([block, np.full(size - count, block[-1])])
    begins = pad(fresh) | (np.arange(size) >= count)
    start = Motion(jnp.asarray(pad(q)), jnp.asarray(pad(v)))
    return Rows(pad(t), seen, start, pad(np.arange(len(t))), u, steps, begins, block, machine, count)


def stretch(t: AnyArray, y: AnyArray, u: AnyArray, run: Motion) -> Rows:
    """The rows of one log, with a motion along them, as one block without padding."""
    steps = np.diff(np.asarray(t), prepend=np.asarray(t)[:1] - BETWEEN_LOGS)
    rows, none = np.arange(len(steps)), np.zeros(len(steps), int)
    return Rows(t, y, run, rows, u, steps, _begins(np.asarray(t)), none, np.zeros(1, int), len(rows))


def _begins(t: Float[np.ndarray, "T"]) -> Bool[np.ndarray, "T"]:
    """Rows (T,) of a log at which a stretch without a gap begins."""
    steps = np.diff(t)
    return np.concatenate([[True], steps > LONGEST_GAP * np.median(steps)])


def filled(t: np.ndarray, column: np.ndarray) -> np.ndarray:
    """The column with values between the nearest known ones where rows are missing: the last one known of those that
    cannot be interpolated, as the parts of an attitude that is missing whole."""
    flat = np.array(column).reshape(len(t), -1)
    known = np.isfinite(flat)
    for j in range(flat.shape[1]):
        here = np.flatnonzero(known[:, j])
        if not len(here):
            flat[:, j] = 0.0
        elif column.ndim == 2:
            flat[:, j] = np.interp(t, t[here], flat[here, j])
        else:
            flat[:, j] = flat[here[np.clip(np.searchsorted(here, np.arange(len(t)), "right") - 1, 0, None)], j]
    return flat.reshape(column.shape)


def _blocks(
    chosen: Int[np.ndarray, "T"], offsets: Int[np.ndarray, "K1"], machines: Sequence[int]
) -> tuple[Int[np.ndarray, "T"], Int[np.ndarray, "B"]]:
    """Block of each row, and the machine of each block: parts of the logs of about equal length."""
    length = max(len(chosen) // max(BLOCKS, EACH * len(set(machines))), FEWEST_IN_BLOCK)
    log = np.searchsorted(offsets, chosen, "right") - 1
    block, machine, first = np.zeros(len(chosen), int), [], 0
    for k in np.unique(log):
        own = np.flatnonzero(log == k)
        parts = max(1, len(own) // length)
        block[own] = first + np.arange(len(own)) * parts // len(own)
        machine += [machines[k]] * parts
        first += parts
    return block, np.array(machine)


def _padded(count: int) -> int:
    """The least of `SIZES` numbers in each octave that is not below a count."""
    octave = 2.0 ** np.floor(np.log2(count))
    return int(octave * (1 + math.ceil(SIZES * (count / octave - 1)) / SIZES))


def held_out_rows(
    rows: Rows, stamps: Sequence[Float[np.ndarray, "_"]], last: Bool[np.ndarray, "K"]
) -> Bool[np.ndarray, "T"]:
    """Rows (T,) that are held out: those of the `last` logs, or the last third of each if there are none."""
    log = np.searchsorted(np.cumsum([len(t) for t in stamps]), np.asarray(rows.rows), "right")
    border = np.array([t[0] + FITTED * (t[-1] - t[0]) for t in stamps])
    held_out = last[log] if last.any() else np.asarray(rows.t) >= border[log]
    whole = np.isfinite(np.asarray(rows.y)).reshape(len(log), -1).all(axis=1)
    if (count := int(np.sum(whole & held_out))) < FEWEST_ROWS:
        raise InputError(
            f"what is held out has {count} rows with all positions, and {FEWEST_ROWS} must judge; give more"
        )
    return held_out


def held_out_logs(
    stamps: Sequence[Float[np.ndarray, "_"]], length: float, machines: Sequence[int]
) -> Bool[np.ndarray, "K"]:
    """Logs (K,) that are held out: of each machine with several the least number of the last that hold enough windows,
    and less than half of them."""
    # Windows share no row, so that each takes a step more than its length.
    counts = np.array([int(len(t) / (length / np.median(np.diff(t)) + 1) + 1e-9) for t in stamps])
    held_out = np.zeros(len(counts), bool)
    for machine in set(machines):
        own = np.flatnonzero(np.asarray(machines) == machine)
        last = 1
        while sum(counts[own[-last:]]) < FEWEST_WINDOWS and last < (len(own) - 1) // 2:
            last += 1
        held_out[own[-last:]] = len(own) > 1
    return held_out


def horizon(t: Float[np.ndarray, "T"], velocity: Float[np.ndarray, "T n"]) -> float:
    """Time [s] over which predictions judge a model: twice that in which the velocity changes by its own size.

    That is `2 rms(v)/rms(v')`, in units of each velocity, and at most a sixth of the log. Over much shorter times a
    position hardly shows a force, and over much longer ones errors of the model grow beyond the range of a
    linearisation.
    """
    steps = np.diff(t)
    change = np.diff(velocity, axis=0) / np.where(steps > 0, steps, np.nan)[:, None]
    size, pace = known_rms(velocity), known_rms(change)
    time = 2 / np.sqrt(np.mean((pace / np.where(size > 0, size, np.inf)) ** 2) + 1e-300)
    return float(max(FEWEST_ROWS * np.median(steps), min(time, (t[-1] - t[0]) / 6)))
