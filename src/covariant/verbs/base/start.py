"""Starts observers with constant gains at the motion that their first innovations determine, instead of at rest."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Inexact

from covariant._typing import Number, Scalar, Vector
from covariant.engine import EngineName, run_logs
from covariant.observers import AbstractObserver, AbstractWrapper, with_velocity
from covariant.signals import Record, Run, StepCode

KEPT = (
    *("innovation", "innovation_cov", "distance", "result", "nis", "noise_scale", "sensors"),
    *("velocity_std", "state_std", "slow", "slow_std"),
)
"""What the commands use of the info of an observer."""
ROUNDS, SPAN = 5, 3.0
"""Starts that are tried; time in which innovations determine one, in reciprocals of the natural frequency."""
LEAST_NOISE = 1e-6
"""Least change of an innovation from row to row, relative to the largest, by which it is weighted."""
FEWEST, MOST, SHARE = 5, 1000, 3
"""Rows that determine a start: at least for each number of it, at most, and at most one in so many of the log."""


class Started(AbstractWrapper):
    """An observer that starts near the first measurement (n,), displaced from it, and with a velocity (n,).

    A restart in a later row is that of the inner observer.
    """

    observer: AbstractObserver
    displacement: Vector
    velocity: Vector

    @property
    def manifold(self) -> Any:
        return self.observer.manifold

    @property
    def input_at_end(self) -> bool:
        return self.observer.input_at_end

    def init(self, y: Inexact[Array, "*n"], t: Number = 0.0) -> Any:
        place: Any = self.manifold
        state = self.observer.init(place.retract(y, self.displacement.astype(y.dtype)), t)
        return with_velocity(state, self.velocity.astype(y.dtype))

    def estimate(self, state: Any) -> Any:
        return self.observer.estimate(state)

    def step(self, state: Any, u: Float[Array, "m"], y: Inexact[Array, "*n"], dt: Number) -> tuple[Any, Any]:
        return self.observer.step(state, u, y, dt)

    def predict(self, state: Any, u: Float[Array, "m"], dt: Scalar) -> Any:
        return self.observer.predict(state, u, dt)

    def correct(self, state: Any, u: Float[Array, "m"], y: Inexact[Array, "*n"]) -> tuple[Any, Any]:
        return self.observer.correct(state, u, y)

    def moved(self, change: np.ndarray) -> "Started":
        """The same with other numbers, by a change (2n,) of displacement and velocity."""
        displacement, velocity = jnp.split(jnp.concatenate([self.displacement, self.velocity]) + change, 2)
        return Started(self.observer, displacement, velocity)


def run_through(observer: AbstractObserver, record: Record, engine: EngineName, repeats: int = 1) -> tuple[Run, str]:
    """Run an observer over a record; all starts share one compiled program."""
    others = [observer.moved(np.ones(2 * observer.velocity.size))] if isinstance(observer, Started) else []
    (run,), by = run_logs(observer, record, KEPT, engine, others, repeats)
    return run, by


def with_start(observer: AbstractObserver, record: Record, engine: EngineName) -> tuple[AbstractObserver, int]:
    """An observer with constant gains that starts at the motion of the first rows, and their number.

    The start makes the weighted sum of the squared innovations in these rows least. An error of it decays in them by
    the gains, so that all of them together determine it as well as later rows determine later errors. Others are
    returned as they are, and 0: a filter with a covariance forgets a start at rest by itself.
    """
    inner: Any = observer
    while hasattr(inner, "observer"):  # behind a gate or a delay
        inner = inner.observer
    space, rate = getattr(getattr(inner, "model", None), "space", None), getattr(inner, "beta", None)
    if rate is None or space is None or space.manifold.redundant:
        return observer, 0
    rest = np.zeros(space.manifold.zero(jnp.asarray(record.y[0])).size)
    started, t = Started(observer, jnp.asarray(rest), jnp.asarray(rest)), np.asarray(record.t)
    rows = int(np.searchsorted(t, t[0] + SPAN / math.sqrt(float(np.min(rate)))))
    rows = max(min(rows, MOST, len(t) // SHARE), min(FEWEST * 2 * rest.size, len(t)))
    part = Record(*(np.asarray(each)[:rows] for each in record[:3]))
    noise = np.std(np.diff(_innovations(started, part, engine, len(t))[0], axis=0), axis=0)
    weight = 1 / np.maximum(noise, max(LEAST_NOISE * float(np.max(noise)), np.finfo(float).eps))
    size = 1e-3 * np.concatenate([1 / weight, 1 / weight / (t[rows - 1] - t[0])])
    best, least = observer, math.inf
    for _ in range(ROUNDS):
        first, used = _innovations(started, part, engine, len(t))
        error = (first * weight)[used].ravel()
        if not error @ error < least * error.size:  # no better, or not finite
            break
        best, least = started, float(error @ error) / error.size
        changed = [_innovations(started.moved(step), part, engine, len(t))[0] for step in np.diag(size)]
        slopes = [((each - first) * weight)[used].ravel() / step for each, step in zip(changed, size, strict=True)]
        if not np.isfinite(slopes).all():
            break
        started = started.moved(np.linalg.lstsq(np.stack(slopes, axis=1), -error, rcond=None)[0])
    return best, rows if best is not observer else 0


def _innovations(
    observer: AbstractObserver, record: Record, engine: EngineName, rows: int
) -> tuple[Float[np.ndarray, "T n"], np.ndarray]:
    """Innovations of an observer over the first of `rows` rows, and in which of them no reading was refused."""
    run, _ = run_through(observer, record, engine, math.ceil(rows / len(record.t)))
    return np.asarray(run.info.innovation), np.asarray(run.info.result) < StepCode.OUTLIER
