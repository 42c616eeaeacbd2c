"""Test vectors of an exported observer: a run with faults, its estimates, and how far rounding may move them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from covariant.codegen._program import DTYPES, Program
from covariant.lowering import Lowered, evaluate, perturbed

UNITS = {"double": 2.0**-53, "float": 2.0**-24}
LANES = 12
ALLOWED = 10.0
"""Largest deviation of an estimate, as a multiple of what roundings at random make of it."""
ROWS = 40
SWING, PERIODS = 0.2, 1.5
"""Amplitude of the measured motion [rad or m], and how often it swings in a run."""
LONG_GAP = 5.0
"""A gap in the run, in sampling intervals."""


class Vectors(NamedTuple):
    """A run from the measurement `start`: rows of dt (T,), u (T, m), y (T, k) and missing (T, k), and what is expected.

    - `expected` (T, j): the numbers of the estimate after each row; `allowed` (T, j): how far they may be off.
    - `result` (T,): the result codes, or −1 where rounding decides them.
    """

    start: np.ndarray
    dt: np.ndarray
    u: np.ndarray
    y: np.ndarray
    missing: np.ndarray
    expected: np.ndarray
    allowed: np.ndarray
    result: np.ndarray


def vectors(program: Program, measured: np.ndarray, rate: float) -> Vectors:
    """A run at about a rate [Hz] over the measurements (ROWS + 1, *n), the first of which starts it.

    Some are missing, one is infinite, inputs are not finite, steps are zero, negative or long.
    """
    dtype = DTYPES[program.real]
    rows, random = len(measured) - 1, np.random.default_rng(0)
    y = np.asarray(measured, dtype).reshape(rows + 1, -1).astype(float)
    start, y = y[0], y[1:]
    missing = np.zeros(y.shape, bool)
    missing[5] = missing[11, :1] = True
    dt = random.uniform(0.8, 1.2, rows) / rate
    dt[[13, 17]] = 0.0, -1.0 / rate
    dt[25] *= LONG_GAP
    y[20, :1] = np.inf
    u = 0.3 * np.sin(np.arange(rows)[:, None] / 7 + np.arange(program.u))
    u[9, :1] = np.nan
    dt, u = dt.astype(dtype).astype(float), u.astype(dtype).astype(float)
    lanes, codes = _followed(program, start, np.where(missing, np.nan, y), u, dt)
    expected = lanes[:, :, 0]
    size = np.abs(lanes - expected[:, :, None]).max(axis=2)
    allowed = ALLOWED * (size + UNITS[program.real] * np.abs(expected)) + 64 * np.finfo(dtype).tiny
    result = np.where((codes == codes[:, :1]).all(axis=1), codes[:, 0], -1)
    return Vectors(start, dt, u, y, missing, expected, allowed, result.astype(int))


def _followed(program: Program, start, y, u, dt) -> tuple[np.ndarray, np.ndarray]:
    """Estimates (T, j, LANES) and result codes (T, LANES) of a run under roundings at random."""
    domain = perturbed(UNITS[program.real], LANES)
    dtype = DTYPES[program.real]
    values = [float(v) for each in program.values for v in np.ravel(np.asarray(each, dtype))]

    def read(lowered: Lowered, arguments: Sequence) -> list[np.ndarray]:
        with np.errstate(all="ignore"):
            found = evaluate(lowered, domain, [np.broadcast_to(np.asarray(a, float), LANES) for a in arguments])
        return [np.broadcast_to(np.asarray(value, float), LANES) for value in found]

    state = read(program.init, [*values, *start, 0.0])
    place = [leaf.name for leaf in program.info for _ in range(leaf.size)].index("result")
    shown = [k for k, leaf in enumerate(program.info) for _ in range(leaf.size)]
    estimates, codes = [], []
    for row in zip(u, y, dt, strict=True):
        found = read(program.step, [*values, *state, *row[0], *row[1], row[2]])
        state, info = found[: len(state)], found[len(state) :]
        told = [value for value, k in zip(info, shown, strict=True) if program.info[k] in program.told]
        estimates.append([*read(program.estimate, [*values, *state]), *told])
        codes.append(info[place])
    return np.array(estimates), np.array(codes)
