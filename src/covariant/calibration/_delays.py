"""Findings about when coordinates were measured and inputs act, and about how strongly inputs act."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration._changes import Names
from covariant.calibration._finding import Finding
from covariant.calibration._residual import Residual, residual
from covariant.calibration._smooth import Smooth
from covariant.calibration._timing import Fitted, fit
from covariant.models import MechanicalSystem

SIGNIFICANT = 4.0
"""Standard errors from which a delay of one coordinate against another is believed."""
LATE = 0.6
"""Fraction of a row from which it is: below that an error of the model may look like one."""
SIGNIFICANT_COMMON, LATE_COMMON, GAIN_COMMON = 5.0, 1.5, 0.4
"""The same for a delay of all coordinates against the inputs, and by which fraction the unexplained squares must fall:
a wrong friction looks like it too."""
SIGNIFICANT_SCALE, OFF_SCALE, GAIN = 5.0, 0.25, 0.5
"""Standard errors, deviation from 1, and fraction of the unexplained squares, from which a scale is believed."""
LOST = 0.02
"""Unexplained fraction from which a delay may be too long to be found from none."""
SEARCHED = (5e-3, 1e-2, 2e-2, 4e-2, 8e-2)
"""Delays [s] that are tried then."""
ROUNDS = 5
SETTLED = 0.01
"""Change of a delay, in rows, or of a scale, that ends the search."""
WHOLE_ROW = 0.2
"""A delay is a row where it is off by less than this fraction of one."""


class _Told(NamedTuple):
    """Delays against the earliest coordinate (n,) [s], and scales (m,); each with its standard error, and whether it is
    believed."""

    delay: Float[np.ndarray, "n"]
    delay_std: Float[np.ndarray, "n"]
    late: Bool[np.ndarray, "n"]
    scale: Float[np.ndarray, "m"]
    scale_std: Float[np.ndarray, "m"]
    off: Bool[np.ndarray, "m"]


class _Common(NamedTuple):
    """The delay of all positions against the inputs [s], with its standard error; zero where it is not believed."""

    delay: float = 0.0
    std: float = 0.0


class Stated(NamedTuple):
    """What the model file says already: delays (n,) [s] of the positions, and the lag [s] of the inputs."""

    delay: Float[np.ndarray, "n"]
    lag: float


class _Fit(NamedTuple):
    """What is compared: the model, and the log smoothed after delays (n,) [s] are taken off and inputs are scaled."""

    model: MechanicalSystem
    smoothed: Callable[[np.ndarray], Smooth]

    def at(self, delay: np.ndarray, scale: np.ndarray) -> tuple[Smooth, Residual]:
        log = self.smoothed(delay)
        log = log._replace(u=log.u * scale)
        return log, residual(self.model, log)


def delay_findings(
    model: MechanicalSystem,
    names: Names,
    spacing: float,
    stated: Stated,
    smoothed: Callable[[np.ndarray], Smooth],
) -> tuple[list[Finding], Residual]:
    """Findings of delays and of scales of inputs, and what the model leaves of the log after they are put right.

    - `spacing` [s]: time between two rows; `stated`: what the model file says.
    - `smoothed`: gives the smoothed log with delays (n,) [s] taken off, beyond those that the model file states.
    """
    fitting = _Fit(model, smoothed)
    n, m = len(names.q), len(names.u)
    log, before = fitting.at(np.zeros(n), np.ones(m))
    start = _searched(model, log, before)
    # A wrong sign or size of an input looks like a delay, and a delay of all positions like one of some of them.
    scale = np.where((first := _settled(fitting, start, np.ones(m), spacing, False)[0]).off, first.scale, 1.0)
    common = _common(fitting, start, scale, spacing) if m else _Common()
    told, after = _settled(fitting, start + common.delay, scale, spacing, True)
    return list(_findings(names, spacing, stated, told, common, before, after)), after


def _settled(
    fitting: _Fit, delay: np.ndarray, scale: np.ndarray, spacing: float, delays: bool
) -> tuple[_Told, Residual]:
    """What is believed in the end of delays, if asked for, and of scales; and what is left with them taken off.

    The least of `delay`, which is that of all against the inputs, stays taken off.
    """
    base = delay.min()
    told, now = None, None
    for _ in range(ROUNDS):
        log, now = fitting.at(delay, scale)
        told = _told(fit(fitting.model, log, now), delay, scale, spacing)
        step = np.where(told.late, told.delay, 0.0) + base - delay if delays else np.zeros_like(delay)
        change = np.where(told.off, told.scale, 1.0) - scale
        delay, scale = delay + step, scale + change
        if np.abs(step).max(initial=0.0) < SETTLED * spacing and np.abs(change).max(initial=0.0) < SETTLED:
            break
    assert told is not None
    assert now is not None
    return told, now


def _common(fitting: _Fit, delay: np.ndarray, scale: np.ndarray, spacing: float) -> _Common:
    """The delay of all positions against the inputs."""
    n, total, std = len(delay), 0.0, 0.0
    log, before = fitting.at(delay, scale)
    now = before
    for _ in range(ROUNDS):
        fitted = fit(fitting.model, log, now)
        earliest = delay == delay.min()
        weights = earliest / earliest.sum()
        step, std = float(weights @ fitted.delay), float(np.sqrt(weights @ fitted.cov[:n, :n] @ weights))
        if not (np.isfinite(std) and abs(total + step) > SIGNIFICANT_COMMON / 2 * std):
            return _Common()
        total += step
        log, now = fitting.at(delay + total, scale)
        if abs(step) < SETTLED * spacing:
            break
    large = abs(total) > LATE_COMMON * spacing and abs(total) > SIGNIFICANT_COMMON * std
    if large and now.misfit < (1 - GAIN_COMMON) * before.misfit:
        return _Common(total, std)
    return _Common()


def _searched(model: MechanicalSystem, log: Smooth, now: Residual) -> Float[np.ndarray, "n"]:
    """The long delay of one coordinate that halves what is left, or none (n,)."""
    n = log.q.shape[1]
    best, least = np.zeros(n), now.misfit / 2
    if not now.misfit > LOST or n == 1:
        return best
    for i in range(n):
        for points in sorted({max(1, round(size / log.step)) for size in SEARCHED}):
            tried = residual(model, _rolled(log, i, points))
            if tried.misfit < least:
                best, least = np.where(np.arange(n) == i, points * log.step, 0.0), tried.misfit
    return best


def _rolled(log: Smooth, i: int, points: int) -> Smooth:
    """The smoothed log with coordinate i as it is so many points of the grid later."""

    def moved(values):
        values = values.copy()
        values[:, i] = np.roll(values[:, i], -points)
        return values

    used = log.used & np.roll(log.used, -points)  # the first and last points are never used
    return log._replace(q=moved(log.q), v=moved(log.v), a=moved(log.a), used=used)


def _told(fitted: Fitted, delay: np.ndarray, scale: np.ndarray, spacing: float) -> _Told:
    """What is believed of a fit to a log from which `delay` was taken off and whose inputs were scaled."""
    n = len(delay)
    total, cov = delay + fitted.delay, fitted.cov[:n, :n]
    against = np.eye(n) - np.eye(n)[int(np.argmin(total))]
    later, std = against @ total, _std(against @ cov @ against.T) if np.isfinite(cov).all() else np.full(n, np.inf)
    late = (later > LATE * spacing) & (later > SIGNIFICANT * std)
    scales, scale_std = scale * fitted.scale, np.abs(scale) * _std(fitted.cov[n:, n:])
    deviation = np.abs(scales - 1)
    gained = (fitted.gain > GAIN) | (scale != 1)
    off = (deviation > OFF_SCALE) & (deviation > SIGNIFICANT_SCALE * scale_std) & gained
    return _Told(later, std, late, scales, scale_std, off)


def _std(cov: np.ndarray) -> np.ndarray:
    return np.sqrt(np.diag(cov))


def _findings(
    names: Names, spacing: float, stated: Stated, told: _Told, common: _Common, before: Residual, after: Residual
) -> Iterator[Finding]:
    falls = ""
    if after.misfit < before.misfit:
        falls = f"; of the squares of the accelerations the model leaves {_share(after)} then, not {_share(before)}"
    taken_off = stated.delay + np.where(told.late, told.delay, 0.0) + max(common.delay, 0.0)
    line = f"[measurement] delay = [{', '.join(f'{value:.2g}' for value in taken_off)}]"
    first, lag = names.q[int(np.argmin(told.delay))], stated.lag
    for i in np.flatnonzero(told.late):
        delay, std = float(told.delay[i]), float(told.delay_std[i])
        evidence = f"{names.q[i]} is measured {_ms(delay, std)} later than {first}{_rows(delay, std, spacing)}{falls}"
        numbers = {"delay": delay, "std": std, "rows": delay / spacing}
        yield Finding("delay", names.q[i], evidence, line, True, numbers)
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
    for j in np.flatnonzero(told.off):
        scale, std = float(told.scale[j]), float(told.scale_std[j])
        line = names.line("u", np.where(np.arange(len(names.u)) == j, scale, 1.0))
        yield Finding(
            "scale of an input",
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
