"""Whether other numbers of a model explain a log, alone or with another unit, order or sign of its columns.

The numbers of a model file are often first guesses. They are fitted to the accelerations of the log as it is, and of
the log with each change of its columns. Where several explain it, the one for which the guesses have to move least is
the cause: in another unit of an input all masses would be a thousand times as large.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant.calibration.diagnosis._case import Case, Residual, averaged, clearly, compared
from covariant.calibration.diagnosis._finding import Finding
from covariant.calibration.diagnosis._input_curves import corner_parts
from covariant.calibration.diagnosis._smooth import Smooth
from covariant.calibration.diagnosis._suspicion import HELD_OUT, Comparison, Suspicion, Unexplained, blocks_of
from covariant.calibration.diagnosis._thresholds import EXPLAINED, GUESS, THRESHOLDS
from covariant.models import Family, MechanicalSystem, acceleration
from scalargraph.errors import InputError

NUMBERS = "numbers of the model"
"""Name of the finding on them."""
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
        """The largest move of a guess."""
        return float(np.abs(self.x).max())

    @property
    def plain(self) -> bool:
        """Whether it explains all of the log by guesses that may be off so far."""
        return self.farthest < GUESS and self.comparison.choosing < EXPLAINED


def other_numbers(
    case: Case, family: Callable[[], Any], changes: Iterable[Suspicion], threshold: str = "guesses"
) -> tuple[Callable[[Case], Case], Suspicion | None, Finding] | None:
    """Numbers that explain a case, as a function from a case to that with them, the change of columns that they need,
    and the finding on either.

    None where the model explains most of the log, or no numbers do.
    """
    as_it_is, limit = compared(case), THRESHOLDS[threshold]
    if as_it_is is None or not as_it_is.told.any() or as_it_is.misfit < limit.least:
        return None
    try:
        guesses = Guesses.of(family())
    except InputError:  # its function takes plain numbers only, or refuses some of these
        return None
    accelerate, now = _with_slopes(guesses), Unexplained.of(as_it_is)

    def attempt(change: Suspicion | None, curves: bool = False) -> Iterator[_Tried]:
        log = clearly(case if change is None else change.apply(case))
        found = None if log is None else _fit(guesses, accelerate, log, curves)
        if found is not None:
            one = _Tried(change, found[0], Comparison.of(now, Unexplained.of(found[1])))
            yield from [one] if one.comparison.passes(threshold) else []

    tried = list(attempt(None))
    if not any(one.plain for one in tried):
        tried += [one for change in changes for one in attempt(change)]
    if not any(one.plain for one in tried):
        tried += attempt(None, curves=True)
    if not tried:
        return None
    least = max(limit.alike * min(one.comparison.choosing for one in tried), EXPLAINED)
    alike = [one for one in tried if one.comparison.choosing <= least]
    # The first of those that need about the least: a log without a fault comes first.
    nearest = min(one.farthest for one in alike) + np.log(2)
    best = next(one for one in alike if one.farthest <= nearest)
    if best.change is None and not MOVED < best.farthest < GUESS:
        return None
    words = guesses.words(best.x)
    if best.change is None:
        moved = (name for name, x in zip(guesses.names, best.x, strict=True) if abs(x) > MOVED)
        names = dict.fromkeys(name.partition("[")[0] for name in moved)
        line = f"covariant fit MODEL LOG --parameters {','.join(names)}"
        suspicion = Suspicion(NUMBERS, "", f"with {words}", line, lambda case: case)
    else:
        suspicion = best.change._replace(words=f"{best.change.words} and {words}")
    model = guesses.at(best.x)

    def effects(log: Smooth) -> list[np.ndarray]:
        return list(np.moveaxis(np.asarray(accelerate(best.x, log.t, log.q, log.v, log.u)[1]), -1, 0))

    def apply(case: Case) -> Case:
        return case._replace(model=model, file=case.file._replace(model=model), effects=effects)

    return apply, best.change, suspicion.finding(best.comparison)


def _with_slopes(guesses: Guesses) -> Callable:
    """Function from x (p,) and t, q, v, u at K points to accelerations (K, n), and their slopes in x (K, n, p)."""

    def one(x, *point):
        def at(x):
            return acceleration(guesses.at(x), *point)

        return at(x), jax.jacfwd(at)(x)

    return eqx.filter_jit(jax.vmap(one, (None, 0, 0, 0, 0)))


def _fit(
    guesses: Guesses, accelerate: Callable, log: Smooth, curves: bool
) -> tuple[Float[np.ndarray, "p"], Residual] | None:
    """Logarithms (p,) by which guesses move, and what the model then leaves of a smoothed log, by Levenberg and
    Marquardt's method on the blocks that choose; None for a log without accelerations. With `curves` each input acts by
    any curve, which is eliminated in each step."""
    told = Residual(log.a, np.zeros_like(log.a), log.used & np.isfinite(log.a).all(axis=1), log.a_noise)
    if not told.told.any():
        return None
    size, idle = np.sqrt(2 * told.scale), np.zeros_like(log.u)
    chosen = ~HELD_OUT[blocks_of(int(told.used.sum()))]
    parts = [corner_parts(column) for column in log.u.T] if curves else []

    def some(values: np.ndarray) -> np.ndarray:
        sized = values / size.reshape(-1, *np.ones(values.ndim - 2, int))
        return sized[told.used][chosen][:, told.told].reshape(-1, *values.shape[2:])

    def at(x):
        modelled, slopes = map(np.asarray, accelerate(x, log.t, log.q, log.v, idle if curves else log.u))
        units = (accelerate(x, log.t, log.q, log.v, idle + one)[0] - modelled for one in np.eye(len(log.u.T)))
        pairs = ((part, unit) for each, unit in zip(parts, units, strict=False) for part in each)  # no parts, no curves
        acting = [averaged(log, part[:, None] * np.asarray(unit)) for part, unit in pairs]
        modelled = averaged(log, modelled)
        columns = some(np.stack([averaged(log, each) for each in np.moveaxis(slopes, -1, 0)], axis=-1))
        left = some(log.a - modelled)
        if acting:
            by_curves = np.stack(acting, axis=-1)
            basis = some(by_curves)
            multiples = np.linalg.lstsq(basis, np.column_stack([left, columns]), rcond=1e-9)[0]
            left, columns = left - basis @ multiples[:, 0], columns - basis @ multiples[:, 1:]
            modelled = modelled + by_curves @ multiples[:, 0]
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
