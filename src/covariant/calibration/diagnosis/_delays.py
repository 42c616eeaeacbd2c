"""Findings on delays of coordinates and inputs, and on scales of inputs."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.diagnosis._alternatives import BLOCKS, HELD_OUT, Blocks, chosen
from covariant.calibration.diagnosis._changes import Names
from covariant.calibration.diagnosis._finding import Finding
from covariant.calibration.diagnosis._residual import Residual, residual
from covariant.calibration.diagnosis._smooth import Smooth
from covariant.calibration.diagnosis._timing import Fitted, fit
from covariant.models import MechanicalSystem

SIGNIFICANT = 4.0
"""Standard errors from which a delay of one coordinate against another is accepted."""
LATE = 0.6
"""Fraction of a row from which it is accepted: below that an error of the model may look like a delay."""
SIGNIFICANT_COMMON, LATE_COMMON, GAIN_COMMON = 5.0, 1.5, 0.4
"""The same for a delay of all coordinates against the inputs, and by which fraction the unexplained squares must fall:
a wrong friction looks like it too."""
SIGNIFICANT_SCALE, OFF_SCALE, GAIN = 5.0, 0.25, 0.5
"""Standard errors, deviation from 1, and fraction of the unexplained squares, from which a scale is accepted."""
LOST = 0.02
"""Unexplained fraction from which a delay may be too long for a local search from zero."""
SEARCHED = (5e-3, 1e-2, 2e-2, 4e-2, 8e-2)
"""Delays [s] from which the search then starts."""
ROUNDS = 5
SETTLED = 0.01
"""Change of a delay, in rows, or of a scale, that ends the search."""
WHOLE_ROW = 0.2
"""Largest distance of a delay from a whole number of rows, in rows, with which it is reported as such."""


class _Estimates(NamedTuple):
    """Estimated delays and scales, with standard errors and which are accepted.

    Attributes:
        delay: Delays (n,) against the earliest coordinate [s].
        delay_std: Their standard errors (n,) [s].
        late: Which delays (n,) are accepted.
        scale: Scales (m,) of the inputs.
        scale_std: Their standard errors (m,).
        off: Which scales (m,) are accepted.
        rows: Whole rows (n,) by which late columns are moved instead; 0 where a delay predicts better.
    """

    delay: Float[np.ndarray, "n"]
    delay_std: Float[np.ndarray, "n"]
    late: Bool[np.ndarray, "n"]
    scale: Float[np.ndarray, "m"]
    scale_std: Float[np.ndarray, "m"]
    off: Bool[np.ndarray, "m"]
    rows: np.ndarray


class _Common(NamedTuple):
    """Delay of all positions against the inputs [s], with its standard error; zero where it is not accepted."""

    delay: float = 0.0
    std: float = 0.0


class Stated(NamedTuple):
    """Delays according to the model file.

    Attributes:
        delay: Delay (n,) of each position [s].
        lag: Time constant [s] of the first-order lag of the inputs.
    """

    delay: Float[np.ndarray, "n"]
    lag: float


class _Fit(NamedTuple):
    """The model, and the log smoothed after delays (n,) [s] are subtracted and inputs are scaled."""

    model: MechanicalSystem
    smoothed: Callable[[np.ndarray, np.ndarray], Smooth]

    def at(self, delay: np.ndarray, scale: np.ndarray, rows: np.ndarray | None = None) -> tuple[Smooth, Residual]:
        log = self.smoothed(delay, np.zeros(len(delay), int) if rows is None else rows)
        log = log._replace(u=log.u * scale)
        return log, residual(self.model, log)


def delay_findings(
    model: MechanicalSystem,
    names: Names,
    spacing: float,
    stated: Stated,
    smoothed: Callable[[np.ndarray, np.ndarray], Smooth],
) -> tuple[list[Finding], "Corrected"]:
    """Findings on delays, shifts by whole rows and scales of inputs, and the corrected log.

    Args:
        model: The mechanical system.
        names: Columns and units of the log.
        spacing: Time between two rows [s].
        stated: Delays according to the model file.
        smoothed: Function from delays (n,) [s], beyond those that the model file states, and numbers of rows (n,), to
            the smoothed log from which the delays are subtracted, its columns moved up by the rows.

    Returns:
        The findings, and the log once delays and scales are corrected.
    """
    fitting = _Fit(model, smoothed)
    n, m = len(names.q), len(names.u)
    log, before = fitting.at(np.zeros(n), np.ones(m))
    start = _initial_delay(model, log, before)
    # First scales, then the common delay: a wrong sign or size of an input looks like a delay, and a delay of all
    # positions like one of some of them.
    scale = np.where((first := _iterated(fitting, start, np.ones(m), spacing, False)[0]).off, first.scale, 1.0)
    common = _common(fitting, start, scale, spacing) if m else _Common()
    estimates, corrected = _iterated(fitting, start + common.delay, scale, spacing, True)
    rows = _whole_rows(fitting, estimates, corrected, spacing)
    findings = list(_findings(names, spacing, stated, estimates._replace(rows=rows), common, before, corrected.left))
    return findings, corrected._replace(rows=rows)


class Corrected(NamedTuple):
    """A log whose delays and scales of inputs are corrected.

    Attributes:
        log: The smoothed log.
        left: Its residual accelerations.
        delay: Delays (n,) [s] that are subtracted, beyond those that the model file states.
        scale: Factors (m,) of the inputs.
        rows: Whole rows (n,) by which columns are late where that is better than a delay.
    """

    log: Smooth
    left: Residual
    delay: Float[np.ndarray, "n"]
    scale: Float[np.ndarray, "m"]
    rows: np.ndarray


def _whole_rows(fitting: _Fit, estimates: _Estimates, corrected: Corrected, spacing: float) -> np.ndarray:
    """Whole rows (n,) by which late columns are moved, where that predicts held-out rows better than a delay, or 0."""
    rows, n = np.zeros(len(corrected.delay), int), len(corrected.delay)
    if not corrected.left.told.any() or corrected.left.used.sum() < 2 * BLOCKS:
        return rows
    fitted = Blocks.of(corrected.left)
    for i in np.flatnonzero(estimates.late):
        late = estimates.delay[i] / spacing
        delay = np.where(np.arange(n) == i, corrected.delay.min(), corrected.delay)
        tried = {}
        for k in sorted({max(1, int(np.floor(late))), max(1, int(np.ceil(late)))}):
            _, left = fitting.at(delay, corrected.scale, np.where(np.arange(n) == i, k, 0))
            if left.used.sum() >= 2 * BLOCKS:
                tried[k] = Blocks.of(left, corrected.left)
        if tried and tried[k := chosen(tried)].squares[HELD_OUT].mean() < fitted.squares[HELD_OUT].mean():
            rows[i] = k
    return rows


def _iterated(
    fitting: _Fit, delay: np.ndarray, scale: np.ndarray, spacing: float, delays: bool
) -> tuple[_Estimates, "Corrected"]:
    """Iterate the fit to convergence, and return the accepted estimates with the log after their correction.

    Delays are corrected only if `delays` is set. The least of `delay`, that of all coordinates against the inputs,
    stays subtracted.
    """
    base = delay.min()
    estimates, corrected = None, None
    for _ in range(ROUNDS):
        corrected = Corrected(*fitting.at(delay, scale), delay, scale, np.zeros(len(delay), int))
        estimates = _estimates(fit(fitting.model, corrected.log, corrected.left), delay, scale, spacing)
        step = np.where(estimates.late, estimates.delay, 0.0) + base - delay if delays else np.zeros_like(delay)
        change = np.where(estimates.off, estimates.scale, 1.0) - scale
        delay, scale = delay + step, scale + change
        if np.abs(step).max(initial=0.0) < SETTLED * spacing and np.abs(change).max(initial=0.0) < SETTLED:
            break
    assert estimates is not None
    assert corrected is not None
    return estimates, corrected


def _common(fitting: _Fit, delay: np.ndarray, scale: np.ndarray, spacing: float) -> _Common:
    """The delay of all positions against the inputs."""
    n, total, std = len(delay), 0.0, 0.0
    log, before = fitting.at(delay, scale)
    after = before
    for _ in range(ROUNDS):
        fitted = fit(fitting.model, log, after)
        earliest = delay == delay.min()
        weights = earliest / earliest.sum()
        # Of the coordinates that start together, the mean: their differences are findings of their own.
        step, std = float(weights @ fitted.delay), float(np.sqrt(weights @ fitted.cov[:n, :n] @ weights))
        # Half the threshold while it iterates; the full one is for the converged delay, below.
        if not (np.isfinite(std) and abs(total + step) > SIGNIFICANT_COMMON / 2 * std):
            return _Common()
        total += step
        log, after = fitting.at(delay + total, scale)
        if abs(step) < SETTLED * spacing:
            break
    large = abs(total) > LATE_COMMON * spacing and abs(total) > SIGNIFICANT_COMMON * std
    if large and after.misfit < (1 - GAIN_COMMON) * before.misfit:
        return _Common(total, std)
    return _Common()


def _initial_delay(model: MechanicalSystem, log: Smooth, unshifted: Residual) -> Float[np.ndarray, "n"]:
    """Long delay of one coordinate that halves the unexplained fraction, as a start (n,) [s]; zero without one."""
    n = log.q.shape[1]
    best, least = np.zeros(n), unshifted.misfit / 2
    # Not `<=`: a misfit of NaN, where no acceleration exceeds the noise, has to end here too.
    if not unshifted.misfit > LOST or n == 1:
        return best
    for i in range(n):
        for points in sorted({max(1, round(size / log.step)) for size in SEARCHED}):
            tried = residual(model, _advanced(log, i, points))
            if tried.misfit < least:
                best, least = np.where(np.arange(n) == i, points * log.step, 0.0), tried.misfit
    return best


def _advanced(log: Smooth, i: int, points: int) -> Smooth:
    """The smoothed log with coordinate i advanced by `points` points of the grid."""

    def advanced(values):
        values = values.copy()
        # A negative shift of the rows is a later time: the row at t becomes q(t + shift).
        values[:, i] = np.roll(values[:, i], -points)
        return values

    used = log.used & np.roll(log.used, -points)  # the first and last points are never used
    return log._replace(q=advanced(log.q), v=advanced(log.v), a=advanced(log.a), used=used)


def _estimates(fitted: Fitted, delay: np.ndarray, scale: np.ndarray, spacing: float) -> _Estimates:
    """Estimates of a fit to a log from which `delay` was subtracted and whose inputs were multiplied by `scale`."""
    n = len(delay)
    total, cov = delay + fitted.delay, fitted.cov[:n, :n]
    # Differences from the earliest coordinate: a delay of all of them is none against another.
    against = np.eye(n) - np.eye(n)[int(np.argmin(total))]
    later, std = against @ total, _std(against @ cov @ against.T) if np.isfinite(cov).all() else np.full(n, np.inf)
    late = (later > LATE * spacing) & (later > SIGNIFICANT * std)
    scales, scale_std = scale * fitted.scale, np.abs(scale) * _std(fitted.cov[n:, n:])
    deviation = np.abs(scales - 1)
    # A scale that has been applied has no gain left, but had it before.
    gained = (fitted.gain > GAIN) | (scale != 1)
    off = (deviation > OFF_SCALE) & (deviation > SIGNIFICANT_SCALE * scale_std) & gained
    return _Estimates(later, std, late, scales, scale_std, off, np.zeros(n, int))


def _std(cov: np.ndarray) -> np.ndarray:
    return np.sqrt(np.diag(cov))


def _findings(
    names: Names,
    spacing: float,
    stated: Stated,
    estimates: _Estimates,
    common: _Common,
    before: Residual,
    after: Residual,
) -> Iterator[Finding]:
    falls = ""
    if after.misfit < before.misfit:
        falls = f"; of the squares of the accelerations the model leaves {_share(after)} then, not {_share(before)}"
    delays = np.where(estimates.rows > 0, estimates.rows * spacing, estimates.delay)
    taken_off = stated.delay + np.where(estimates.late, delays, 0.0) + max(common.delay, 0.0)
    line = f"[measurement] delay = [{', '.join(f'{value:.2g}' for value in taken_off)}]"
    first, lag = names.q[int(np.argmin(estimates.delay))], stated.lag
    for i in np.flatnonzero(estimates.late):
        delay, std, whole = float(estimates.delay[i]), float(estimates.delay_std[i]), int(estimates.rows[i])
        evidence = f"{names.q[i]} is measured {_ms(delay, std)} later than {first}{_rows(delay, std, spacing)}{falls}"
        numbers = {"delay": float(delays[i]), "std": std, "rows": float(delays[i] / spacing)}
        move = ""
        if whole:
            count = f"{whole} row{'s' if whole > 1 else ''}"
            evidence = f"{names.q[i]} is measured {_ms(delay, std)} later than {first}; cells that are {count} late "
            evidence += f"predict rows that are held out better{falls}"
            move = f"move the column {names.q[i]} up by {count} in the log, or "
        yield Finding("delay", names.q[i], evidence, move + line, True, numbers)
    if common.delay:
        size, how = abs(common.delay), f"{_ms(abs(common.delay), common.std)}"
        rows = _rows(size, common.std, spacing)
        if common.delay > 0:  # whether the one or the other is late, the log is the same
            evidence = f"positions follow the inputs {how} later than the model says{rows}{falls}"
            line = f"{line} where measurements are late, or [inputs] lag = {lag + size:.2g} where inputs act late"
        else:
            evidence = f"inputs are stamped {how} later than they act{rows}{falls}"
            less = f"[inputs] lag = {max(lag - size, 0.0):.2g}, or " if lag else ""
            line = f"{less}subtract {size:.2g} s from the stamps of {', '.join(names.u)}"
        numbers = {"delay": common.delay, "std": common.std, "rows": common.delay / spacing}
        yield Finding("delay against the inputs", "", evidence, line, True, numbers)
    for j in np.flatnonzero(estimates.off):
        scale, std = float(estimates.scale[j]), float(estimates.scale_std[j])
        turned = abs(scale + 1) < OFF_SCALE
        line = names.line("u", np.where(np.arange(len(names.u)) == j, -1.0 if turned else scale, 1.0))
        yield Finding(
            "sign of an input" if turned else "scale of an input",
            names.u[j],
            f"{names.u[j]} acts {scale:.3g} ± {std:.2g} times as strongly as logged{falls}",
            f"{line}, or [parameters] that make it so",
            True,
            {"scale": scale, "std": std},
        )


def _ms(value: float, std: float) -> str:
    return f"{1e3 * value:.3g} ms ± {1e3 * std:.2g} ms"


def _rows(delay: float, std: float, spacing: float) -> str:
    rows = delay / spacing
    whole = round(rows)
    if whole and abs(rows - whole) < WHOLE_ROW + 2 * std / spacing:
        return f", as if its cells were {whole} row{'s' if whole > 1 else ''} late"
    return f", {rows:.2g} rows"


def _share(left: Residual) -> str:
    return f"{100 * left.misfit:.3g} %"
