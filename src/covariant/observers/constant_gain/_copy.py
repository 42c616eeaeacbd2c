"""Defines the copy observer: the model with output injection, without parallel transport and curvature terms.

Source: Aghannan & Rouchon 2003, equation (15), the baseline of their figure 4.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._typing import Number, Scalar
from covariant.models import MechanicalSystem, Motion, friction, source
from covariant.observers.base import (
    AbstractMechanicalObserver,
    Info,
    SampledState,
    aged,
    as_gain,
    at_rest,
    check_positive,
    outcome,
    predicted,
    readability,
    sampled_correction,
    sampled_gains,
    step_result,
    still,
    time_since_measurement,
)


class ModelCopy(AbstractMechanicalObserver):
    """Observer (15) of Aghannan & Rouchon 2003: a copy of the model with output injection, in the frame of the space.

    With the error e = −local(q̂, q) it is

        q̂' = E(q̂)(v̂ − αe),   v̂' = −B(q̂)(v̂, v̂) + S(q) − βe + friction

    Use it with high gain on a nearly flat metric, whose curvature does not matter; it is the cheapest observer with a
    model. `Intrinsic` costs little more and has the full error law.

    Attributes:
        model: The mechanical system.
        alpha: Gain α [1/s]; the more curvature or velocity there is, the higher it must be.
        beta: Gain β [1/s²], likewise.
        substeps: Number of Runge–Kutta steps in each sample; None (default) uses as many as dt and the friction need
            (offline).

    Raises:
        ValueError: A gain is not positive and finite.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> t = np.linspace(0.0, 4.0, 401)
        >>> record = Record(t, np.zeros((401, 1)), np.cos(t)[:, None])  # a unit mass on a unit spring
        >>> run = observers.run(observers.ModelCopy(models.oscillator(), alpha=4.0, beta=8.0), record)
        >>> bool(abs(run.estimate[-1, 1] + np.sin(4.0)) < 1e-3)
        True
    """

    model: MechanicalSystem
    alpha: Scalar = eqx.field(converter=as_gain)
    beta: Scalar = eqx.field(converter=as_gain)
    substeps: int | None = eqx.field(default=None, static=True)

    def __check_init__(self):
        check_positive("ModelCopy", alpha=self.alpha, beta=self.beta)

    def init(self, y: Array, t: Number = 0.0) -> SampledState:
        return at_rest(self.model, y, t)

    def flow(self, t: Scalar, state: SampledState, u: Float[Array, "m"], y: Array) -> SampledState:
        q, v, _, last_input, age = state
        e = -self.model.manifold.towards(q, y)
        drive = source(self.model, t, self.model.manifold.measured(q, y), u) + friction(self.model, t, q, v, u)
        v_dot = drive - self.beta * e - self.model.space.connection(q, v, v)
        return SampledState(v - self.alpha * e, v_dot, jnp.ones_like(state.t), still(last_input), still(age))

    def predict(self, state: SampledState, u: Float[Array, "m"], dt: Scalar) -> SampledState:
        return predicted(self.model, state, u, dt, self.substeps)

    def correct(self, state: SampledState, u: Float[Array, "m"], y: Array) -> tuple[SampledState, Info]:
        (q, v, t), waited = state[:3], time_since_measurement(state)
        e = -self.model.manifold.towards(q, y)
        # The prediction used S(q̂), but observer (15) uses S at the measurement.
        missing = source(self.model, t, self.model.manifold.measured(q, y), u) - source(self.model, t, q, u)
        gains = sampled_gains(self.alpha, self.beta, waited)
        correction = sampled_correction(self.model.space, Motion(q, v), gains, waited, e, missing)
        new_q = self.model.manifold.retract(q, -correction.part * e)
        new_v = self.model.space.projected(new_q, v + correction.velocity)
        code = step_result(correction, readability(self.model, q, y))
        result = outcome(new_q, new_v, self.model.manifold.seen(q, y), code)
        new = state._replace(q=new_q, v=new_v, age=aged(self.model, state, y))
        return new, Info(self.innovation(state, u, y), self.model.space.norm(q, e), result)
