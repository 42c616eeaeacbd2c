"""Suspicions about when columns are true: delays and scales that are fitted, columns that are whole rows late, and
inputs that go from row to row in another way than the model file says.

A coordinate that lags by τ, read at the stamp t but true at t − τ, is corrected by `q(t + τ)`. The derivatives of the
residual with respect to the τ of every coordinate and to the scale of every input are computed numerically, so that a
few Gauss–Newton steps estimate them together. Their covariance is that of sums over blocks of time (Liang & Zeger
1986), which holds for any correlation within a block; it decides which of them are reported.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.diagnosis._block_regression import weighted_least_squares
from covariant.calibration.diagnosis._case import Case, Residual, input_effects, residual, smoothed, smoothed_residual
from covariant.calibration.diagnosis._columns import input_line, plain_scale
from covariant.calibration.diagnosis._finding import Finding, counted, later_line
from covariant.calibration.diagnosis._smooth import Smooth
from covariant.calibration.diagnosis._suspicion import Comparison, Suspicion, Unexplained, judge, unexplained_at
from covariant.calibration.diagnosis._thresholds import (
    COMMON_ERRORS,
    COMMON_GAIN,
    COMMON_ROWS,
    DELAY_ERRORS,
    DELAY_ROWS,
    LONG_GAIN,
    SCALE_ERRORS,
    SCALE_GAIN,
    SCALE_OFF,
    THRESHOLDS,
    WHOLE_ROW,
)
from covariant.models import MechanicalSystem

LOST = 0.02
"""Unexplained fraction from which a delay may be too long for a local search from zero."""
SEARCHED = (5e-3, 1e-2, 2e-2, 4e-2, 8e-2)
"""Delays [s] from which the search then starts."""
ROUNDS = 5
SETTLED = 0.01
"""Change of a delay, in rows, or of a scale, that ends the search."""
NUDGE = 1e-4
"""Shift [s] of the central differences for derivatives with respect to a delay."""
MOST_ROWS = 2
"""Whole rows by which a column may be early or late although no delay was found."""
LATEST = 5
"""Most rows by which inputs may act later than the model file says, of those that are tried."""
BETWEEN = {
    "held": "the value of a row acts from its stamp to the next",
    "linear": "inputs go linearly from row to row",
    "earlier": "the value of a row acts up to its stamp",
}
"""How inputs may go from row to row."""


class Timing(NamedTuple):
    """When columns are true, and how strongly inputs act.

    Attributes:
        delay: Delays (n,) [s] to be subtracted, beyond those that the model file states.
        scale: Factors (m,) of the inputs.
        rows: Whole rows (n,) by which columns are late in place of a delay.
        suspicions: What of this counts.
    """

    delay: Float[np.ndarray, "n"]
    scale: Float[np.ndarray, "m"]
    rows: np.ndarray
    suspicions: tuple[Suspicion, ...] = ()

    def apply(self, case: Case) -> Case:
        """The case with columns as they are once they are in time and to scale."""
        delay = np.broadcast_to(np.asarray(case.file.delay, float), self.delay.shape) + self.delay
        y, u = moved_rows(np.asarray(case.record.y), self.rows), np.asarray(case.record.u) * self.scale
        return case._replace(file=case.file._replace(delay=tuple(delay))).with_readings(y).with_inputs(u)

    def findings(self, case: Case, half: float) -> list[Finding]:
        """The findings, with what all of them together explain."""
        if not self.suspicions:
            return []
        comparison = self.comparison(case, half)
        return [each.finding(comparison) for each in self.suspicions]

    def comparison(self, case: Case, half: float) -> Comparison:
        """What the model leaves with and without it."""
        return Comparison.of(*(Unexplained.of(smoothed_residual(each, half)) for each in (case, self.apply(case))))

    def where_explained(self, case: Case, half: float) -> "Timing":
        """Nothing where much is unexplained even so, or a long delay explains little: it imitates another fault."""
        if not self.suspicions:
            return self
        comparison, late = self.comparison(case, half), self.delay - self.delay.min()
        little = not _falls(comparison) and late.max() > MOST_ROWS * case.spacing
        if comparison.after < THRESHOLDS["torques"].most and not little:
            return self
        return Timing(np.zeros_like(self.delay), np.ones_like(self.scale), np.zeros_like(self.rows))

    def explains_most(self, case: Case, half: float) -> bool:
        """Whether it explains so much of what is left that no wrong friction looks like it."""
        return not self.suspicions or _falls(self.comparison(case, half))

    @property
    def together(self) -> Suspicion:
        """All of it as one suspicion, to be judged against others."""
        return Suspicion("", "", "", "", self.apply, "fitted")


def _falls(comparison: Comparison) -> bool:
    return comparison.after <= (1 - LONG_GAIN) * comparison.before


def fit_timing(case: Case, half: float) -> Timing:
    """Estimate delays, scales of inputs and shifts by whole rows, and which of them count."""
    n, m = len(case.names.q), len(case.names.u)
    start = Timing(_long_delay(case, half), np.ones(m), np.zeros(n, int))
    # First scales, then the common delay: a wrong sign or size of an input looks like a delay, and a delay of all
    # positions like one of some of them.
    first, _ = _iterate_fit(case, half, start, delays=False)
    start = start._replace(scale=np.where(first.off, first.scale, 1.0))
    common, std = _common_delay(case, half, start) if m else (0.0, 0.0)
    estimates, timing = _iterate_fit(case, half, start._replace(delay=start.delay + common), delays=True)
    timing = timing._replace(rows=_whole_rows(case, half, timing, estimates))
    timing = timing._replace(suspicions=tuple(_suspicions(case, timing, estimates, common, std)))
    return timing.where_explained(case, half)


class _Estimates(NamedTuple):
    """Delays (n,) against the earliest coordinate [s] and scales (m,), with standard errors and which of them count."""

    delay: Float[np.ndarray, "n"]
    delay_std: Float[np.ndarray, "n"]
    late: Bool[np.ndarray, "n"]
    scale: Float[np.ndarray, "m"]
    scale_std: Float[np.ndarray, "m"]
    off: Bool[np.ndarray, "m"]

    @classmethod
    def of(cls, fitted: "Fitted", timing: Timing, spacing: float) -> "_Estimates":
        """Those of a fit to a log that is corrected already."""
        n = len(timing.delay)
        total, cov = timing.delay + fitted.delay, fitted.cov[:n, :n]
        # Differences from the earliest coordinate: a delay of all of them is none against another.
        against = np.eye(n) - np.eye(n)[int(np.argmin(total))]
        later = against @ total
        std = np.sqrt(np.diag(against @ cov @ against.T)) if np.isfinite(cov).all() else np.full(n, np.inf)
        late = (later > DELAY_ROWS * spacing) & (later > DELAY_ERRORS * std)
        scale, scale_std = timing.scale * fitted.scale, np.abs(timing.scale) * np.sqrt(np.diag(fitted.cov[n:, n:]))
        deviation = np.abs(scale - 1)
        # A scale that has been applied has no gain left, but had it before.
        gained = (fitted.gain > SCALE_GAIN) | (timing.scale != 1)
        off = (deviation > SCALE_OFF) & (deviation > SCALE_ERRORS * scale_std) & gained
        return cls(later, std, late, scale, scale_std, off)


def _iterate_fit(case: Case, half: float, timing: Timing, delays: bool) -> tuple[_Estimates, Timing]:
    """Iterate the fit to convergence; the least of the delays, that of all against the inputs, stays subtracted."""
    base = timing.delay.min()
    estimates = _Estimates.of(_fit_once(case, half, timing)[0], timing, case.spacing)
    for _ in range(ROUNDS - 1):
        delay = base + np.where(estimates.late, estimates.delay, 0.0) if delays else timing.delay
        scale = np.where(estimates.off, estimates.scale, 1.0)
        near = np.abs(delay - timing.delay).max(initial=0.0) < SETTLED * case.spacing
        if near and np.abs(scale - timing.scale).max(initial=0.0) < SETTLED:
            break
        timing = timing._replace(delay=delay, scale=scale)
        estimates = _Estimates.of(_fit_once(case, half, timing)[0], timing, case.spacing)
    return estimates, timing


def _fit_once(case: Case, half: float, timing: Timing) -> tuple["Fitted", Residual]:
    log = smoothed(timing.apply(case), half)
    left = residual(case.model, log)
    return fit(case.model, log, left), left


def _common_delay(case: Case, half: float, timing: Timing) -> tuple[float, float]:
    """The delay [s] of all positions against the inputs and its standard error; zeros where it does not count."""
    n, total, std, start = len(timing.delay), 0.0, 0.0, timing.delay
    weights = start == start.min()
    weights = weights / weights.sum()
    fitted, before = _fit_once(case, half, timing)
    after = before
    for _ in range(ROUNDS):
        # Of the coordinates that start together, the mean: their differences are findings of their own.
        step, std = float(weights @ fitted.delay), float(np.sqrt(weights @ fitted.cov[:n, :n] @ weights))
        # Half the threshold while it iterates; the full one is for the converged delay, below.
        if not (np.isfinite(std) and abs(total + step) > COMMON_ERRORS / 2 * std):
            return 0.0, 0.0
        total += step
        fitted, after = _fit_once(case, half, timing._replace(delay=start + total))
        if abs(step) < SETTLED * case.spacing:
            break
    large = abs(total) > COMMON_ROWS * case.spacing and abs(total) > COMMON_ERRORS * std
    return (total, std) if large and after.misfit < (1 - COMMON_GAIN) * before.misfit else (0.0, 0.0)


def _long_delay(case: Case, half: float) -> Float[np.ndarray, "n"]:
    """Long delay of one coordinate that halves the unexplained fraction, as a start (n,) [s]; zero without one."""
    n, best = len(case.names.q), np.zeros(len(case.names.q))
    least = smoothed_residual(case, half).misfit / 2
    # Not `<=`: a misfit of NaN, where no acceleration exceeds the noise, has to end here too.
    if not least > LOST / 2 or n == 1:
        return best
    timing = Timing(best, np.ones(len(case.names.u)), np.zeros(n, int))
    for delay in (size * one for one in np.eye(n) for size in SEARCHED):
        tried = smoothed_residual(timing._replace(delay=delay).apply(case), half)
        if tried.misfit < least:
            best, least = delay, tried.misfit
    return best


def _whole_rows(case: Case, half: float, timing: Timing, estimates: _Estimates) -> np.ndarray:
    """Whole rows (n,) by which late columns are moved, where that predicts held-out rows better than a delay, or 0."""
    rows, n = np.zeros(len(timing.delay), int), len(timing.delay)

    def shifted_by(i: int, k: int) -> Suspicion:
        delay = np.where(np.arange(n) == i, timing.delay.min(), timing.delay)
        shift = timing._replace(delay=delay, rows=np.where(np.arange(n) == i, k, 0))
        return Suspicion("", "", "", "", lambda _: shift.apply(case), "rows for a delay", numbers={"rows": k})

    for i in np.flatnonzero(estimates.late):
        late = estimates.delay[i] / case.spacing
        near = sorted({max(1, int(np.floor(late))), max(1, int(np.ceil(late)))})
        better = judge(timing.apply(case), [shifted_by(int(i), k) for k in near], unexplained_at(half))
        if better is not None:
            rows[i] = better[0].numbers["rows"]
    return rows


def _suspicions(
    case: Case, timing: Timing, estimates: _Estimates, common: float, common_std: float
) -> Iterator[Suspicion]:
    """Those delays and scales that count, in words."""
    names, spacing, lag = case.names, case.spacing, case.file.input_lag
    delays = np.where(timing.rows > 0, timing.rows * spacing, estimates.delay)
    taken_off = np.asarray(case.file.delay, float) + np.where(estimates.late, delays, 0.0) + max(common, 0.0)
    line = f"[measurement] delay = [{', '.join(f'{value:.2g}' for value in taken_off)}]"
    for i in np.flatnonzero(estimates.late):
        delay, std, whole = float(estimates.delay[i]), float(estimates.delay_std[i]), int(timing.rows[i])
        claim, move = f"{names.q[i]} is measured {_ms(delay, std)} later than {names.q[estimates.delay.argmin()]}", ""
        if whole:
            claim += f"; cells that are {counted(whole, 'row')} late predict rows that are held out better"
            move = f"move the column {names.q[i]} up by {counted(whole, 'row')} in the log, or "
        else:
            claim += _in_rows(delay, std, spacing)
        numbers = {"delay": float(delays[i]), "std": std, "rows": float(delays[i] / spacing)}
        yield Suspicion("delay", names.q[i], "then", move + line, timing.apply, "fitted", claim, numbers)
    if common:
        size, how = abs(common), f"{_ms(abs(common), common_std)}"
        rows = _in_rows(size, common_std, spacing)
        if common > 0:  # whether the one or the other is late, the log is the same
            claim = f"positions follow the inputs {how} later than the model says{rows}"
            line = f"{line} where measurements are late, or [inputs] lag = {lag + size:.2g} where inputs act late"
        else:
            claim = f"inputs are stamped {how} later than they act{rows}"
            less = f"[inputs] lag = {max(lag - size, 0.0):.2g}, or " if lag else ""
            line = f"{less}subtract {size:.2g} s from the stamps of {', '.join(names.u)}"
        numbers = {"delay": common, "std": common_std, "rows": common / spacing}
        yield Suspicion("delay against the inputs", "", "then", line, timing.apply, "fitted", claim, numbers)
    for j in np.flatnonzero(estimates.off):
        scale, std = float(estimates.scale[j]), float(estimates.scale_std[j])
        turned = abs(scale + 1) < SCALE_OFF
        prefix = plain_scale(scale, std)
        factors = np.where(np.arange(len(names.u)) == j, -1.0 if turned else prefix or scale, 1.0)
        claim = f"{names.u[j]} acts {scale:.3g} ± {std:.2g} times as strongly as logged"
        line = f"{input_line(names, factors)}, or [parameters] that make it so"
        if not (turned or prefix):  # of an odd scale a wrong mass is the usual cause
            line = f"`covariant fit` where [parameters] are guesses, or else {input_line(names, factors)}"
        what = "sign of an input" if turned else "unit of an input" if prefix else "scale of an input"
        numbers = {"scale": scale, "std": std}
        yield Suspicion(what, names.u[j], "then", line, timing.apply, "fitted", claim, numbers)


def row_shifts(case: Case) -> Iterator[Suspicion]:
    """Columns that are whole rows early or late, of which no delay was found."""
    n = len(case.names.q)
    for i in range(n) if n > 1 else ():
        for k in (k for k in range(-MOST_ROWS, MOST_ROWS + 1) if k):
            shift = Timing(np.zeros(n), np.ones(len(case.names.u)), np.where(np.arange(n) == i, k, 0))
            name, (early, back) = case.names.q[i], ("late", "up") if k > 0 else ("early", "down")
            count, words = counted(abs(k), "row"), f"with that column moved {back}"
            line, claim = f"move the column {name} {back} by {count} in the log", f"cells of {name} are {count} {early}"
            yield Suspicion("row shift", name, words, line, shift.apply, "rows", claim, {"rows": k})


def inputs_between_rows(case: Case) -> Iterator[Suspicion]:
    """Inputs that go from row to row in another way than the model file says, or act some rows later."""
    stated, names, file = case.file.input_between, ", ".join(case.names.u), case.file
    lines = {
        "held": '[inputs] between = "held"',
        "linear": '[inputs] between = "linear"',
        "earlier": f"move {names} up by one row in the log: a row holds the input before its stamp",
    }
    for between in BETWEEN if names else ():
        if between != stated:
            words = f"where {BETWEEN[between]}, and not as the model file says, where {BETWEEN[stated]}"
            change = _rows_later(between if between != "earlier" else "held", -1 if between == "earlier" else 0)
            yield Suspicion("inputs between rows", names, words, lines[between], change, "rows")
    for k in range(1, LATEST + 1) if names else ():
        time = k * case.spacing
        claim = f"positions follow the inputs {counted(k, 'row')} later than the model says, {1e3 * time:.3g} ms"
        numbers = {"delay": time, "rows": k}
        change = _rows_later(stated, k)
        yield Suspicion("delay against the inputs", "", "then", later_line(file, time), change, "rows", claim, numbers)


def _rows_later(between: str, rows: int) -> Callable[[Case], Case]:
    """Function that lets inputs go from row to row in a way, and act some rows later."""

    def apply(case: Case) -> Case:
        u = np.asarray(case.record.u)
        u = u[np.clip(np.arange(len(u)) - rows, 0, len(u) - 1)]
        return case._replace(file=case.file._replace(input_between=between)).with_inputs(u)

    return apply


def moved_rows(y: Float[np.ndarray, "T n"], rows: np.ndarray) -> Float[np.ndarray, "T n"]:
    """Positions with column i moved up by `rows[i]` rows; missing where there is no such row."""
    moved = np.full(y.shape, np.nan)
    for i, k in enumerate(rows):
        count = len(y) - abs(k)
        moved[max(-k, 0) : max(-k, 0) + count, i] = y[max(k, 0) : max(k, 0) + count, i]
    return moved


def _ms(value: float, std: float) -> str:
    return f"{1e3 * value:.3g} ms ± {1e3 * std:.2g} ms"


def _in_rows(delay: float, std: float, spacing: float) -> str:
    rows = delay / spacing
    whole = round(rows)
    if whole and abs(rows - whole) < WHOLE_ROW + 2 * std / spacing:
        return f", as if its cells were {counted(whole, 'row')} late"
    return f", {rows:.2g} rows"


class Fitted(NamedTuple):
    """Delays that remain in the log and scales of its inputs.

    Without inputs only differences of delays are known: their mean is zero then.

    Attributes:
        delay: Delays (n,) [s].
        scale: Scales (m,); 1 for an input that acts as logged.
        cov: Covariance (n + m, n + m) of both.
        gain: Fraction (m,) by which the sum of squared residuals falls if that input is scaled besides the others.
    """

    delay: Float[np.ndarray, "n"]
    scale: Float[np.ndarray, "m"]
    cov: Float[np.ndarray, "p p"]
    gain: Float[np.ndarray, "m"]


def fit(model: MechanicalSystem, log: Smooth, now: Residual) -> Fitted:
    """Estimate delays and scales by one Gauss–Newton step."""
    n, m = log.q.shape[1], log.u.shape[1]
    columns, used = [], now.used.copy()
    for i in range(n):
        # Central differences: their error is of second order in the shift.
        later, earlier = (residual(model, shifted(log, i, s)) for s in (NUDGE, -NUDGE))
        columns.append(((later.measured - later.modelled) - (earlier.measured - earlier.modelled)) / (2 * NUDGE))
        used &= later.used & earlier.used
    # The residual falls by the acceleration that the input causes, so its slope in the scale has a minus.
    columns += [-effect for effect in input_effects(model, log, now)]
    used &= np.isfinite(columns).all(axis=(0, 2))
    left, columns = (now.measured - now.modelled)[used], np.stack(columns, axis=2)[used]
    # Without inputs the time at which a motion happens changes nothing: only differences of delays are unknowns.
    free = np.eye(n + m) if m else np.linalg.qr(np.eye(n) - 1 / n)[0][:, : n - 1]
    if free.shape[1] == 0:
        return Fitted(np.zeros(n), np.ones(m), np.full((n + m, n + m), np.inf), np.zeros(m))
    theta, cov, weight = _reweighted(left, columns @ free)
    theta, cov = free @ theta, free @ cov @ free.T
    return Fitted(theta[:n], 1 + theta[n:], cov, _gains(left, columns[..., n:], weight))


def shifted(log: Smooth, i: int, shift: float) -> Smooth:
    """Advance one coordinate of a smoothed log in time, to first order."""

    def advanced(values):
        values = values.copy()
        values[:, i] += shift * np.gradient(values[:, i], log.step)
        return values

    return log._replace(q=advanced(log.q), v=advanced(log.v), a=advanced(log.a))


def _reweighted(left, columns):
    """Minimiser θ (p,) of the squares of `left + columns θ`, its covariance, and the weight (n, n) of the squares."""
    rest = left
    for _ in range(ROUNDS - 1):  # the weight is the inverse covariance of the final residual
        rest = left + columns @ weighted_least_squares(left, -columns, _weight(rest))[0]
    weight = _weight(rest)
    return *weighted_least_squares(left, -columns, weight), weight


def _weight(rest):
    # Pseudoinverse: coordinates whose residuals are proportional make the covariance singular.
    return np.linalg.pinv(rest.T @ rest / len(rest), rcond=1e-9)


def _gains(left, scales, weight):
    """Fraction by which the weighted squares of `left` (K, n) fall by each of the columns (K, n, m) besides the others.

    So several wrong inputs do not hide each other.
    """
    least = _squares(left, scales, weight)
    without = [_squares(left, np.delete(scales, j, axis=2), weight) for j in range(scales.shape[2])]
    return np.array([1 - least / rest if rest > 0 else 0.0 for rest in without])


def _squares(left, columns, weight):
    """Weighted sum of squares that remains with the best multiples of the columns."""
    rest = left - columns @ weighted_least_squares(left, columns, weight)[0] if columns.shape[2] else left
    return np.einsum("ki,ij,kj->", rest, weight, rest)
