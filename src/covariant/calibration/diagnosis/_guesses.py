"""Whether other numbers of a model explain a log, alone or with another unit, order or sign of its columns.

The numbers of a model file are often first guesses. They are fitted to the accelerations of the log as it is, and of
the log with each change of its columns. Where several explain it, the one for which the guesses have to move least is
the cause: in another unit of an input all masses would be a thousand times as large.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant.calibration.diagnosis._case import Case, Residual, averaged, clearly, compared
from covariant.calibration.diagnosis._finding import Finding
from covariant.calibration.diagnosis._smooth import Smooth
from covariant.calibration.diagnosis._suspicion import HELD_OUT, Comparison, Suspicion, Unexplained, blocks_of
from covariant.calibration.diagnosis._thresholds import EXPLAINED, GUESS, THRESHOLDS
from covariant.models import Family, MechanicalSystem, acceleration

PRICE = 1e-4
"""What a change by a factor of e costs, as a fraction of the squares of the accelerations: a number that the log does
not determine stays where it is."""
ROUNDS, FALL, STEP, DAMPED = 25, 1e-3, 1.5, 1e6
"""Most steps of a fit, the relative fall of its cost at which it ends, its longest step in a logarithm, and the damping
at which no step helps."""
MOVED = 0.05
"""Change of a logarithm from which a fit of the number is advised."""
NAMED = 3
"""Largest number of guesses that evidence names: those that move most."""


class Guesses(NamedTuple):
    """Numbers of a model that may be guesses.

    Attributes:
        names: Names (p,) of the numbers, as of [parameters].
        first: Their values (p,); one of zero stays.
        make: Function from values (p,), which JAX may trace, to the model.
    """

    names: tuple[str, ...]
    first: Float[np.ndarray, "p"]
    make: Callable[[Any], MechanicalSystem]

    @classmethod
    def of(cls, family: Any) -> "Guesses":
        """The open numbers of a `Family` or a `RobotFamily`."""
        if isinstance(family, Family):
            return cls(family.names, family.first, lambda values: family.make(values)[0])
        return cls(family.names, family.first, lambda values: family.make(values - family.first))

    def at(self, x: Any) -> MechanicalSystem:
        """The model with the guesses times exp(x), x (p,)."""
        return self.make(jnp.asarray(self.first) * jnp.exp(x))

    def words(self, x: Float[np.ndarray, "p"]) -> str:
        """The guesses that move most, with their values."""
        values = self.first * np.exp(x)
        return ", ".join(f"{self.names[k]} {values[k]:.2g}" for k in np.argsort(-np.abs(x))[:NAMED])


class _Tried(NamedTuple):
    """A change of columns, or None, logarithms (p,) by which guesses then move, and what is left."""

    change: Suspicion | None
    x: Float[np.ndarray, "p"]
    comparison: Comparison

    @property
    def farthest(self) -> float:
        return float(np.abs(self.x).max())


def other_numbers(
    case: Case, family: Callable[[], Any], changes: Iterable[Suspicion], threshold: str = "guesses"
) -> tuple[MechanicalSystem, Suspicion | None, Finding] | None:
    """The model with numbers that explain a case, the change of columns that they need, and the finding on either.

    None where the model explains most of the log, or no numbers do.
    """
    as_it_is, limit = compared(case), THRESHOLDS[threshold]
    if as_it_is is None or not as_it_is.told.any() or as_it_is.misfit < limit.least:
        return None
    guesses = Guesses.of(family())
    accelerate, now, tried = _with_slopes(guesses), Unexplained.of(as_it_is), list[_Tried]()
    for change in (None, *changes):
        changed = case if change is None else change.apply(case)
        log = clearly(changed)
        found = None if log is None else _fit(guesses, accelerate, log)
        if found is None:
            continue
        one = _Tried(change, found[0], Comparison.of(now, Unexplained.of(found[1])))
        tried += [one] if one.comparison.passes(threshold) else []
        if change is None and tried and one.farthest < GUESS and one.comparison.choosing < EXPLAINED:
            break
    if not tried:
        return None
    least = max(limit.alike * min(one.comparison.choosing for one in tried), EXPLAINED)
    alike = [one for one in tried if one.comparison.choosing <= least]
    # The first of those that need about the least: a log without a fault comes first.
    nearest = min(one.farthest for one in alike) + np.log(2)
    best = next(one for one in alike if one.farthest <= nearest)
    if best.change is None and best.farthest > GUESS:
        return None
    words = guesses.words(best.x)
    if best.change is None:
        moved = dict.fromkeys(
            name.partition("[")[0] for name, x in zip(guesses.names, best.x, strict=True) if abs(x) > MOVED
        )
        line = f"covariant fit MODEL LOG --parameters {','.join(moved)}"
        suspicion = Suspicion("numbers of the model", "", f"with {words}", line, lambda case: case)
    else:
        suspicion = best.change._replace(words=f"{best.change.words} and {words}")
    return guesses.at(best.x), best.change, suspicion.finding(best.comparison)


def _with_slopes(guesses: Guesses) -> Callable:
    """Function from x (p,) and t, q, v, u at K points to accelerations (K, n), and their slopes in x (K, n, p)."""

    def one(x, *point):
        def at(x):
            return acceleration(guesses.at(x), *point)

        return at(x), jax.jacfwd(at)(x)

    return eqx.filter_jit(jax.vmap(one, (None, 0, 0, 0, 0)))


def _fit(guesses: Guesses, accelerate: Callable, log: Smooth) -> tuple[Float[np.ndarray, "p"], Residual] | None:
    """Logarithms (p,) by which guesses move, and what the model then leaves of a smoothed log, by Levenberg and
    Marquardt's method on the blocks that choose; None for a log without accelerations."""
    none = np.zeros_like(log.a)
    told = Residual(log.a, none, log.used & np.isfinite(log.a).all(axis=1), log.a_noise)
    if not told.told.any():
        return None
    size = np.sqrt(2 * told.scale)
    chosen = ~HELD_OUT[blocks_of(int(told.used.sum()))]

    def at(x):
        modelled, slopes = map(np.asarray, accelerate(x, log.t, log.q, log.v, log.u))
        modelled = averaged(log, modelled)
        columns = np.stack([averaged(log, each) for each in np.moveaxis(slopes, -1, 0)], axis=-1)
        left, columns = (log.a - modelled) / size, columns / size[:, None]
        left, columns = (each[told.used][chosen][:, told.told].reshape(-1, *each.shape[2:]) for each in (left, columns))
        cost = np.mean(left**2) + PRICE * np.sum(x**2)
        normal = columns.T @ columns / len(left) + PRICE * np.eye(len(x))
        finite = np.isfinite(cost) and np.isfinite(normal).all()
        return cost if finite else np.inf, normal, columns.T @ left / len(left) - PRICE * x, modelled

    x, damping = np.zeros(len(guesses.first)), 1e-2
    now = at(x)
    for _ in range(ROUNDS):
        before = now[0]
        while damping < DAMPED and np.isfinite(before):
            step = np.linalg.solve(now[1] + damping * np.diag(np.diag(now[1])), now[2])
            step *= min(1.0, STEP / max(np.abs(step).max(), 1e-300))
            then = at(x + step)
            damping *= 0.2 if then[0] < before else 5.0
            if then[0] < before:
                x, now = x + step, then
                break
        if not before - now[0] > FALL * before:
            break
    return x, told._replace(modelled=now[3], used=told.used & np.isfinite(now[3]).all(axis=1))
