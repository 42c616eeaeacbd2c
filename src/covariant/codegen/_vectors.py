"""Computes test vectors of an exported observer: a run with faults, its estimates, and their allowed deviations."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from covariant.codegen._program import DTYPES, Program
from scalargraph import Lowered, evaluate, perturbed
from scalargraph.errors import InputError

# Half the distance from 1 to the next number: the largest relative error of one rounding.
UNITS = {"double": 2.0**-53, "float": 2.0**-24}
LANES = 12
ALLOWED = 10.0
"""Allowed deviation of an estimate, as a multiple of its deviation under random rounding."""
ROWS = 40
SWING, PERIODS = 0.2, 1.5
"""Amplitude of the measured motion [rad or m], and its number of periods in a run."""
LONG_GAP = 5.0
"""Length of a gap in the run, in sampling intervals."""
LAST_FAULT = 25
"""The row of the gap, which comes after all other faults."""


class Vectors(NamedTuple):
    """Test vectors: a run from the measurement `start`, in T rows, and its expected estimates.

    Attributes:
        start: Measurement (k,) from which it starts, at the time 0.
        dt: Time [s] since the previous row (T,).
        u: Inputs (T, m).
        y: Measurements (T, k).
        missing: Mask (T, k) of missing numbers.
        expected: The j numbers of the estimate after each row (T, j).
        allowed: Largest deviations (T, j) from these.
        result: Result codes (T,), or −1 where rounding decides them.

    Example:
        >>> import numpy as np
        >>> from covariant import codegen, observers
        >>> recipe = codegen.with_open_numbers(observers.FilteredDerivative(20.0))
        >>> program = codegen.program(recipe, np.zeros(1))
        >>> measured = np.sin(np.arange(codegen.ROWS + 1) / 10)[:, None]
        >>> run = codegen.vectors(program, measured, 100.0)
        >>> run.expected.shape, int(run.missing.sum()), bool((run.allowed > 0).all())
        ((40, 2), 2, True)
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
    """Compute the test vectors of an observer: a run with faults, whose rows are the same in every call.

    Some measurements are missing, one is infinite, some inputs are not finite, some steps are zero, negative or long.

    Args:
        program: The observer as graphs.
        measured: Measurements (ROWS + 1, *n); the run starts from the first one.
        rate: Sampling rate [Hz]; intervals differ from it by up to a fifth.

    Returns:
        The run; allowed deviations are `ALLOWED` times the deviations under random rounding.

    Raises:
        ValueError: There are too few measurements for all the faults.

    Example:
        >>> import numpy as np
        >>> from covariant import codegen, observers
        >>> recipe = codegen.with_open_numbers(observers.FilteredDerivative(20.0))
        >>> program = codegen.program(recipe, np.zeros(1))
        >>> run = codegen.vectors(program, np.zeros((codegen.ROWS + 1, 1)), 100.0)
        >>> run.dt.shape, int(run.dt.argmin())  # a negative step
        ((40,), 17)
    """
    if len(measured) <= LAST_FAULT + 1:
        raise InputError(f"test vectors need at least {LAST_FAULT + 2} measurements; got {len(measured)}")
    dtype = DTYPES[program.real]
    rows, random = len(measured) - 1, np.random.default_rng(0)
    y = np.asarray(measured, dtype).reshape(rows + 1, -1).astype(float)
    start, y = y[0], y[1:]
    missing = np.zeros(y.shape, bool)
    missing[5] = missing[11, :1] = True
    dt = random.uniform(0.8, 1.2, rows) / rate
    dt[[13, 17]] = 0.0, -1.0 / rate
    dt[LAST_FAULT] *= LONG_GAP
    y[20, :1] = np.inf
    u = 0.3 * np.sin(np.arange(rows)[:, None] / 7 + np.arange(program.u))
    u[9, :1] = np.nan
    # Rounded to the type of the code, so that C reads exactly the numbers used here.
    dt, u = dt.astype(dtype).astype(float), u.astype(dtype).astype(float)
    lanes, codes = _run_with_roundings(program, start, np.where(missing, np.nan, y), u, dt)
    # An infinite bound means that nothing is known, so it is not compared.
    lanes = np.where(np.isinf(lanes), np.nan, lanes)
    expected = lanes[:, :, 0]
    deviation = np.abs(lanes - expected[:, :, None]).max(axis=2)
    # The last term covers underflow; one unit of the last digit is allowed even if roundings change nothing.
    allowed = ALLOWED * (deviation + UNITS[program.real] * np.abs(expected)) + 64 * np.finfo(dtype).tiny
    # A code that differs between lanes depends on rounding, so it may differ between machines.
    result = np.where((codes == codes[:, :1]).all(axis=1), codes[:, 0], -1)
    return Vectors(start, dt, u, y, missing, expected, allowed, result.astype(int))


def _run_with_roundings(program: Program, start, y, u, dt) -> tuple[np.ndarray, np.ndarray]:
    """Estimates (T, j, LANES) and result codes (T, LANES) of a run with random roundings."""
    domain = perturbed(UNITS[program.real], LANES)
    dtype = DTYPES[program.real]
    values = [float(v) for each in program.values for v in np.ravel(np.asarray(each, dtype))]

    def read(lowered: Lowered, arguments: Sequence) -> list[np.ndarray]:
        with np.errstate(all="ignore"):
            outputs = evaluate(lowered, domain, [np.broadcast_to(np.asarray(a, float), LANES) for a in arguments])
        return [np.broadcast_to(np.asarray(value, float), LANES) for value in outputs]

    state = read(program.init, [*values, *start, 0.0])
    place = [leaf.name for leaf in program.info for _ in range(leaf.size)].index("result")
    shown = [k for k, leaf in enumerate(program.info) for _ in range(leaf.size)]
    estimates, codes = [], []
    for row in zip(u, y, dt, strict=True):
        outputs = read(program.step, [*values, *state, *row[0], *row[1], row[2]])
        state, info = outputs[: len(state)], outputs[len(state) :]
        extras = [value for value, k in zip(info, shown, strict=True) if program.info[k] in program.told]
        estimates.append([*read(program.estimate, [*values, *state]), *extras])
        codes.append(info[place])
    return np.array(estimates), np.array(codes)
