"""Defines the states and infos that observers share, and what a state or an info of any observer has."""

from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

from jaxtyping import Array, Float

from covariant._typing import Code, Scalar, Vector

LastInput = Float[Array, "m"] | None
"""The last finite input, in the field `last_input` of a state; None if the state stores none."""


class MechanicalState(NamedTuple):
    """Estimated configuration and velocity of a mechanical system at one time.

    Attributes:
        q: Estimated configuration: coordinates (n,), or on a group a matrix (N, N).
        v: Estimated velocity (n,), in the frame of the configuration space.
        t: Time [s] of the estimate, for forces that depend on time.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import observers
        >>> state = observers.MechanicalState(q=jnp.zeros(1), v=jnp.ones(1), t=jnp.zeros(()))
        >>> state._fields
        ('q', 'v', 't')
    """

    q: Vector
    v: Vector
    t: Scalar


class SampledState(NamedTuple):
    """State of a mechanical observer that also remembers the last input and the time since the last measurement.

    Attributes:
        q: Estimated configuration: coordinates (n,), or on a group a matrix (N, N).
        v: Estimated velocity (n,), in the frame of the configuration space.
        t: Time [s] of the estimate.
        last_input: The last finite input (m,), which replaces an input that is not finite; if it is None (default),
            zero replaces it.
        age: Time since the last measurement [s]; if it is None (default), every step counts as one after a measurement.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> observer = observers.ModelCopy(models.oscillator(), alpha=2.0, beta=4.0)
        >>> state = observer.init(jnp.array([0.5]), t=1.0)
        >>> state.v.tolist(), state.t.item(), state.last_input.tolist(), state.age.item()
        ([0.0], 1.0, [0.0], 0.0)
    """

    q: Vector
    v: Vector
    t: Scalar
    last_input: LastInput = None
    age: Scalar | None = None


class Info(NamedTuple):
    """Diagnostics of a step.

    This is the info of observers with constant gains; filters add fields such as standard deviations. A small
    `distance` with a result of 0 means that the model explains the measurements. `distance` is a length in the
    kinetic-energy metric, so its unit differs from that of the coordinates.

    Attributes:
        innovation: Difference (n,) from q̂ to y before the correction: y − q̂ in coordinates, with angles wrapped. 0
            for a missing measurement.
        distance: Its length in the metric.
        result: A `covariant.signals.StepCode` code.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import StepCode, models, observers
        >>> observer = observers.ModelCopy(models.oscillator(), alpha=2.0, beta=4.0)
        >>> state = observer.init(jnp.zeros(1))
        >>> _, info = observer.step(state, jnp.zeros(1), jnp.array([0.5]), 0.01)
        >>> info.innovation.tolist(), info.distance.item(), StepCode(int(info.result)).name
        ([0.5], 0.5, 'OK')
    """

    innovation: Vector
    distance: Scalar
    result: Code


@runtime_checkable
class Fields(Protocol):
    """A `NamedTuple`, as the state of every observer is."""

    @property
    def _fields(self) -> tuple[str, ...]: ...

    def _replace(self, **fields: object) -> Any: ...


@runtime_checkable
class Diagnostics(Fields, Protocol):
    """The info of a step: it has an innovation and a result code, whatever else it has."""

    @property
    def innovation(self) -> Vector: ...

    @property
    def result(self) -> Code: ...


State = TypeVar("State", bound=Fields)
Report = TypeVar("Report", bound=Diagnostics)
