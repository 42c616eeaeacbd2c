"""Other readings of a log that change when its cells were true, judged on blocks of time that are held out.

A column that is some whole rows late, and inputs that go from row to row in another way than the model file says. Each
is compared with the log as it is, or with a delay that was fitted. Of the blocks of time two in three choose among the
alternatives, and the third ones judge the chosen one.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.calibration.diagnosis._changes import Names
from covariant.calibration.diagnosis._finding import Finding
from covariant.calibration.diagnosis._residual import Residual
from covariant.signals import Record, acting_inputs, lag_inputs

BLOCKS = 30
HELD_OUT = np.arange(BLOCKS) % 3 == 2
"""Blocks of time that judge an alternative; the others choose it."""
HALF = 0.5
"""Part of what the model leaves beyond noise, up to which an alternative has to lower it on the blocks held out."""
MATTERS = 1e-4
"""Fraction of the squares of the accelerations that the log as it is has to leave beyond noise: 1 % of their size."""
SIGNIFICANT = 4.0
"""Standard errors of the signed ranks of its falls in all blocks, from which an alternative counts."""
MOST_ROWS = 2
"""Whole rows by which a column may be early or late although no delay was found."""
BETWEEN = {
    "held": "the value of a row acts from its stamp to the next",
    "linear": "inputs go linearly from row to row",
    "earlier": "the value of a row acts up to its stamp",
}
"""How inputs may go from row to row."""
LATEST = 5
"""Most rows by which inputs may act later than the model file says, of those that are tried."""


class Blocks(NamedTuple):
    """What a model leaves of the accelerations in blocks of time, relative to their squares.

    Attributes:
        squares: In each block (b,), with the noise.
        noise: Part of the noise.
    """

    squares: Float[np.ndarray, "b"]
    noise: float

    @classmethod
    def of(cls, left: Residual, like: Residual | None = None) -> "Blocks":
        """The blocks of a residual, relative to the accelerations and told coordinates of another one."""
        like = like or left
        told, scale = like.told, np.mean(like.measured[like.used] ** 2, axis=0)
        scale = np.where(scale > 0, scale, 1.0)[told]
        parts = np.array_split(left.left[:, told] ** 2, BLOCKS)
        return cls(
            np.array([(part.mean(axis=0) / scale).mean() for part in parts]),
            float(np.mean(left.noise[told] ** 2 / scale)),
        )

    def beyond_noise(self, blocks: np.ndarray) -> float:
        """Mean over some blocks of what exceeds the noise; a tenth of the noise at least, below which nothing shows."""
        return max(float(self.squares[blocks].mean()) - self.noise, 0.1 * self.noise)


def better(before: Blocks, after: Blocks) -> bool:
    """Whether an alternative leaves less than half as much on the blocks held out, and less in nearly all blocks."""
    left, falls = before.beyond_noise(HELD_OUT), before.squares - after.squares
    return left > MATTERS and after.beyond_noise(HELD_OUT) < HALF * left and signed_ranks(falls) >= SIGNIFICANT


def signed_ranks(falls: Float[np.ndarray, "b"]) -> float:
    """Wilcoxon's statistic of differences, as a standard normal: how surely their middle is above zero."""
    count = len(falls)
    # Ranks from 1 to b: the position of each in the order of sizes; equal sizes have probability zero.
    ranks = np.argsort(np.argsort(np.abs(falls))) + 1.0
    # Under symmetry about zero the variance of the sum is b (b + 1) (2b + 1) / 6.
    return float(np.sum(ranks * np.sign(falls)) / np.sqrt(count * (count + 1) * (2 * count + 1) / 6))


def chosen(tried: Mapping[Any, Blocks]) -> Any:
    """The key of the alternative that leaves least on the blocks that choose."""
    return min(tried, key=lambda key: tried[key].squares[~HELD_OUT].mean())


def moved_rows(y: Float[np.ndarray, "T n"], rows: np.ndarray) -> Float[np.ndarray, "T n"]:
    """Positions with column i moved up by `rows[i]` rows; missing where there is no such row.

    Args:
        y: Positions (T, n).
        rows: Whole numbers (n,), negative to move a column down.
    """
    moved = np.full(y.shape, np.nan)
    for i, k in enumerate(rows):
        count = len(y) - abs(k)
        moved[max(-k, 0) : max(-k, 0) + count, i] = y[max(k, 0) : max(k, 0) + count, i]
    return moved


def row_shift(names: Names, before: Residual, residual_of: Callable[[np.ndarray], Residual]) -> Finding | None:
    """Finding on a column that is whole rows early or late, of which no delay was found.

    Args:
        names: Columns of the log.
        before: Residual of the log as it is.
        residual_of: Function from numbers of rows (n,) by which columns are moved up to the residual.
    """
    n = len(names.q)
    if n < 2 or not before.told.any() or before.used.sum() < 2 * BLOCKS:
        return None
    shifts = [(i, k) for i in range(n) for k in range(-MOST_ROWS, MOST_ROWS + 1) if k]
    tried = {}
    for i, k in shifts:
        left = residual_of(np.where(np.arange(n) == i, k, 0))
        if left.used.sum() >= 2 * BLOCKS:
            tried[i, k] = Blocks.of(left, before)
    if not tried:
        return None
    i, k = chosen(tried)
    now, then = Blocks.of(before), tried[i, k]
    if not better(now, then):
        return None
    count = f"{abs(k)} row{'s' if abs(k) > 1 else ''}"
    way, back = ("late", "up") if k > 0 else ("early", "down")
    return Finding(
        "row shift",
        names.q[i],
        f"cells of {names.q[i]} are {count} {way}; {_falls(now, then)} with that column moved {back}",
        f"move the column {names.q[i]} {back} by {count} in the log",
        True,
        {"rows": k, **_numbers(now, then)},
    )


def inputs_between_rows(
    names: Names,
    record: Record,
    stated: tuple[str, float, float],
    before: Residual,
    residual_of: Callable[[Record], Residual],
) -> Finding | None:
    """Finding on inputs that go from row to row in another way than the model file says.

    Args:
        names: Columns of the log.
        record: The log as it was read.
        stated: How they go, their delay [s] and the time constant [s] of their lag, according to the model file.
        before: Residual of the log as it is.
        residual_of: Function from a record with inputs that act in each step to the residual.
    """
    between, delay, lag = stated
    if not names.u or not before.told.any() or before.used.sum() < 2 * BLOCKS:
        return None
    now = Blocks.of(before)
    tried = {
        name: Blocks.of(residual_of(acting), before)
        for name, acting in _acting(lag_inputs(record, lag), delay, between)
        if name != between
    }
    name = chosen(tried)
    if not better(now, tried[name]):
        return None
    if isinstance(name, int):
        return _late_inputs(name, delay, float(np.median(np.diff(record.t))), now, tried[name])
    line = {
        "held": '[inputs] between = "held"',
        "linear": '[inputs] between = "linear"',
        "earlier": f"move {', '.join(names.u)} up by one row in the log: a row holds the input before its stamp",
    }[name]
    return Finding(
        "inputs between rows",
        ", ".join(names.u),
        f"{_falls(now, tried[name])} where {BETWEEN[name]}, and not as the model file says, where {BETWEEN[between]}",
        line,
        True,
        _numbers(now, tried[name]),
    )


def _late_inputs(rows: int, stated: float, spacing: float, now: Blocks, then: Blocks) -> Finding:
    time, count = rows * spacing, f"{rows} row{'s' if rows > 1 else ''}"
    line = f"[measurement] delay = {time:.2g} where measurements are late, or [inputs] delay = {stated + time:.2g}"
    return Finding(
        "delay against the inputs",
        "",
        f"positions follow the inputs {count} later than the model says, {1e3 * time:.3g} ms; {_falls(now, then)} then",
        f"{line} where inputs act late",
        True,
        {"delay": time, "rows": rows, **_numbers(now, then)},
    )


def _acting(record: Record, delay: float, between: str) -> Iterator[tuple[str | int, Record]]:
    """The record with the inputs that act in each step, for each of `BETWEEN`, and for numbers of rows by which it is
    late."""
    u = np.asarray(record.u)
    for name in ("held", "linear"):
        yield name, acting_inputs(record, name, delay)
    yield "earlier", acting_inputs(record._replace(u=np.concatenate([u[1:], u[-1:]])), "held", delay)
    for k in range(1, LATEST + 1):
        yield k, acting_inputs(record._replace(u=np.concatenate([np.repeat(u[:1], k, axis=0), u[:-k]])), between, delay)


def _falls(before: Blocks, after: Blocks) -> str:
    shares = (100 * blocks.beyond_noise(HELD_OUT) for blocks in (before, after))
    first, then = (f"{share:.3g} %" for share in shares)
    return f"on rows held out the model leaves {first} of the squares of the accelerations as the log is, {then}"


def _numbers(before: Blocks, after: Blocks) -> dict[str, float]:
    return {"unexplained": before.beyond_noise(HELD_OUT), "unexplained_after": after.beyond_noise(HELD_OUT)}
