"""The zero of a position that moves during a log: evenly, or with the counts that are lost at speed.

To first order a zero that moves adds a multiple of its path to the accelerations that a model leaves, which is judged
beside all that a rough model may have wrong.
"""

from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float

from covariant.calibration.diagnosis._block_regression import weighted_least_squares
from covariant.calibration.diagnosis._case import Case, averaged, residual
from covariant.calibration.diagnosis._finding import Finding
from covariant.calibration.diagnosis._input_curves import WORDS_OF_ALL, Balance, Rest
from covariant.calibration.diagnosis._suspicion import Suspicion
from covariant.calibration.diagnosis._thresholds import CURVE_ERRORS

SPEEDS = (0.15, 0.3, 0.45, 0.6)
"""Speeds above which counts may be lost, relative to the fastest."""
NUDGE = 1e-4
"""Movement of a zero [unit of the position] for the derivative in it."""


def moving_zero(balance: Balance) -> tuple[Suspicion, Finding] | None:
    """The suspicion that the zero of a position moves, and the finding on it; None if all stay."""
    case, of_inputs = balance.case, range(len(balance.effects))
    rest = balance.beside([balance.by_corners(j)[:, :2] for j in of_inputs])
    found = rest.choose(rest.measured, lambda: _suspicions(rest))
    if found is None:
        return None
    stated = np.broadcast_to(case.file.bias_drift, len(case.names.q))[case.names.q.index(found[0].where)] > 0
    return found[0], found[1]._replace(wrong=False, line="") if stated else found[1]


def _suspicions(rest: Rest) -> Iterator[tuple[Suspicion, Float[np.ndarray, "N"]]]:
    """A zero that is wrong all the time, which is no fault of this kind, and the best paths of one that moves."""
    case, log = rest.balance.case, rest.balance.log
    best: dict[str, tuple[float, Suspicion, np.ndarray]] = {}
    for i, name in enumerate(case.names.q):
        unit = case.names.units[i]
        for kind, how, path in _paths(log.t, log.v[:, i], f"{unit}/s" if unit else "a second"):
            effect = rest.beyond(_effect(rest.balance, i, path))
            table = effect.reshape(-1, int(rest.balance.before.told.sum()), 1)
            (size,), cov = weighted_least_squares(rest.measured.reshape(table.shape[:2]), table, np.eye(table.shape[1]))
            std, left = float(np.sqrt(cov[0, 0])), rest.measured - size * effect
            loss = float(np.sum(left[rest.chosen] ** 2))
            if abs(size) > CURVE_ERRORS * std and loss < best.get(kind, (np.inf,))[0]:
                moved = f"{size * path[-1]:.2g} ± {std * abs(path[-1]):.1g} {unit}".rstrip()
                claim = f"the zero of {name} moves by {moved} in {log.t[-1] - log.t[0]:.3g} s, {how}"
                drift = float(np.ptp(path) * abs(size) / np.sqrt(log.t[-1] - log.t[0]))
                line = f"[measurement] bias = {drift:.2g}; [measurement] bias_drift = {drift:.2g}"
                words, numbers = WORDS_OF_ALL, {"moved": float(size * path[-1]), "std": float(std * abs(path[-1]))}
                apply = _without(i, log.t, -size * path)
                best[kind] = loss, Suspicion(kind, name, words, line, apply, "moving zero", claim, numbers), left
    yield from (each[1:] for each in best.values())


def _paths(
    t: Float[np.ndarray, "K"], v: Float[np.ndarray, "K"], unit: str
) -> Iterator[tuple[str, str, Float[np.ndarray, "K"]]]:
    """Paths of a zero, from simple to rich: the finding, how it moves, and the path (K,)."""
    yield "", "", np.ones_like(t)
    yield "zero of a position", "evenly", t - t[0]
    fastest = np.quantile(np.abs(v), 0.99)
    for speed in (side * share * fastest for share in SPEEDS for side in (1, -1)):
        lost = v > speed if speed > 0 else v < speed
        how = f"as if counts were lost above about {abs(speed):.2g} {unit} {'upwards' if speed > 0 else 'downwards'}"
        yield "lost counts", how, np.cumsum(np.where(lost, v, 0.0)) * (t[1] - t[0])


def _effect(balance: Balance, i: int, path: Float[np.ndarray, "K"]) -> Float[np.ndarray, "N"]:
    """Residual accelerations that one unit of a path of a zero causes."""
    log, before = balance.log, balance.before
    slope = np.gradient(path, log.step)
    moved = {"q": path, "v": slope, "a": averaged(log, np.gradient(slope, log.step)[:, None])[:, 0]}
    for field, change in moved.items():
        values = getattr(log, field).copy()
        values[:, i] += NUDGE * change
        moved[field] = values
    after = residual(balance.case.model, log._replace(**moved))
    return balance.sized((after.measured - after.modelled - before.measured + before.modelled) / NUDGE)


def _without(i: int, t: Float[np.ndarray, "K"], path: Float[np.ndarray, "K"]) -> Callable[[Case], Case]:
    """Function from a case to the case whose position i is moved along a path."""

    def apply(case: Case) -> Case:
        y = np.array(case.record.y, float)
        y[:, i] += np.interp(np.asarray(case.record.t), t, path)
        return case.with_readings(y)

    return apply
