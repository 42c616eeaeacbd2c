"""Unwraps readings that repeat after a period, such as those of a single-turn encoder behind a gear."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Inexact

from covariant.observers.base import AbstractObserver, AbstractWrapper, Report, State
from scalargraph.errors import InputError


class Unwrapped(AbstractWrapper[State, Report]):
    """An observer of coordinates whose readings repeat after a period: the value nearest to the prediction is used.

    Use it for an encoder whose reading starts again while the coordinate continues, as on a motor behind a gear. Angles
    on a full circle do not need it, since every observer takes the short way around. The prediction error must be less
    than half a period, also after a gap in the readings. The first reading is used unchanged.

    Args:
        observer: Observer to which the readings are passed.
        period: Period (n,) of each coordinate [its unit]; 0 for one that does not repeat.

    Raises:
        ValueError: A period is negative or not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import observers
        >>> observer = observers.Unwrapped(observers.FilteredDerivative(50.0), period=(1.0,))
        >>> state = observer.init(jnp.array([0.9]))
        >>> state, info = observer.step(state, jnp.zeros(0), jnp.array([0.1]), 0.1)
        >>> round(info.innovation.item(), 6)
        0.2
    """

    observer: AbstractObserver[State, Report]
    period: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, observer: AbstractObserver, period: Sequence[float]):
        self.observer, self.period = observer, tuple(map(float, period))
        if not all(0 <= each < float("inf") for each in self.period):
            raise InputError(f"Unwrapped: periods must be finite numbers ≥ 0; got {period}")

    def correct(self, state: State, u: Float[Array, "m"], y: Inexact[Array, "*n"]) -> tuple[State, Report]:
        return self.observer.correct(state, u, self._nearest(state, y))

    def innovation(self, state: State, u: Float[Array, "m"], y: Inexact[Array, "*n"]) -> Any:
        return self.observer.innovation(state, u, self._nearest(state, y))

    def _nearest(self, state: State, y: Inexact[Array, "*n"]) -> Inexact[Array, "*n"]:
        """The measurement in which each coordinate is shifted by whole periods to the value nearest to the estimate."""
        q = self.observer.estimate(state)[: len(self.period)]
        moved = [y[i] + p * jnp.round((q[i] - y[i]) / p) if p else y[i] for i, p in enumerate(self.period)]
        return jnp.concatenate([jnp.stack(moved), y[len(self.period) :]])
