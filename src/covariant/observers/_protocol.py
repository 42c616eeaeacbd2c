"""The one protocol of all observers, and the loop that drives them.

An observer is a frozen recipe; what it remembers is a state in the caller's hand; what a person wants to see of a step
is its info. Writing the loop by hand takes four lines:

    state = observer.init(y[0], t[0])
    for k in range(1, len(t)):
        state, info = observer.step(state, u[k - 1], y[k], t[k] - t[k - 1])
        x = observer.estimate(state)
"""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Inexact

from covariant._typing import Code, Number, Scalar, Vector
from covariant.signals import Record, Result, Run


class MechanicalState(NamedTuple):
    """Estimated configuration and velocity, and the time [s] they belong to (for forces that depend on time)."""

    q: Vector
    v: Vector
    t: Scalar


class Info(NamedTuple):
    """What a step saw.

    `innovation`: y − q̂ before the correction, wrapped, 0 where missing; `distance`: its length in the metric;
    `result`: a `covariant.signals.Result` code.
    """

    innovation: Vector
    distance: Scalar
    result: Code


class AbstractObserver(eqx.Module):
    """From positions to state. Sampled: `step` brings the state to the stamp of y and then takes y in."""

    @abc.abstractmethod
    def init(self, y: Inexact[Array, "*n"], t: Number = 0.0) -> Any:
        """State at rest at the measured position y, at time t [s]: (n,), or (N, N) on a group."""

    @abc.abstractmethod
    def step(self, state: Any, u: Float[Array, "m"], y: Inexact[Array, "*n"], dt: Scalar) -> tuple[Any, Any]:
        """Advance by dt [s] under the input u (m,) held over the step, then correct by y; NaN in y is coasted."""

    @abc.abstractmethod
    def estimate(self, state: Any) -> Any:
        """The estimate x = (q, v) (2n,), or on a group a `Motion`."""


class AbstractFlowObserver(AbstractObserver):
    """An observer that is a differential equation."""

    @abc.abstractmethod
    def flow(self, t: Scalar, state: Any, u: Float[Array, "m"], y: Inexact[Array, "*n"]) -> Any:
        """Time derivative of the state, for measurements in continuous time."""


def outcome(q: Array, v: Array, y: Array, result: Code | int = Result.OK) -> Code:
    """Result code of a step: not finite beats coasted beats the step's own."""
    finite = jnp.all(jnp.isfinite(q)) & jnp.all(jnp.isfinite(v))
    measured = jnp.where(jnp.any(jnp.isnan(y)), int(Result.COASTED), result)
    return jnp.where(finite, measured, int(Result.NOT_FINITE)).astype(jnp.int32)


@eqx.filter_jit
def _scan(observer: AbstractObserver, t: Array, u: Array, y: Array):
    before = jnp.concatenate([u[:1], u[:-1]])  # the input that acted since the previous stamp
    dt = jnp.diff(t, prepend=t[:1])

    def step(state, sample):
        moved, info = observer.step(state, *sample)
        # The first row is where the state comes from: its measurement must not count twice.
        state = jax.tree.map(lambda new, old: jnp.where(sample[2] > 0, new, old), moved, state)
        return state, (observer.estimate(state), info)

    return jax.lax.scan(step, observer.init(y[0], t[0]), (before, y, dt))[1]


def run(observer: AbstractObserver, record: Record) -> Run:
    """Drive an observer along a record; row k of the run has used measurements up to row k and no later ones.

    Raises `ValueError` from `Record.check`.
    """
    t, u, y, _ = record.check()
    estimate, info = _scan(observer, jnp.asarray(t), jnp.asarray(u), jnp.asarray(y))
    return Run(jnp.asarray(t), estimate, info)
