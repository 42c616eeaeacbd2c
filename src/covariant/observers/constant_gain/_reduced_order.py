"""Reduced-order observer: takes measured states from the measurement, and corrects the others by constant injection.

In continuous time it is `ŵ' = f_z(y, ẑ) − L f_y(y, ẑ)` with `ẑ = ŵ + Ly`, for measured states y and others z. Between
samples the model predicts both. At a sample y jumps to the measurement; w = z − Ly does not jump, so z jumps with y.

Source: Luenberger 1966, Observers for multivariable systems, IEEE TAC 11(2); `certificates.reduced_order` for L.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._integrate import rk4
from covariant._typing import Number, Scalar, Vector
from covariant.models import StateSpace
from covariant.observers.base import AbstractObserver, Info, LastInput, no_input
from covariant.observers.constant_gain._contracting import check_gain
from covariant.signals import StepCode

Outputs = Float[Array, "p"]


class ReducedOrderState(NamedTuple):
    """State of a `ReducedOrder` observer.

    Attributes:
        x: Estimated state (n,), measured states included.
        t: Time [s] of the state.
        last_input: The last finite input (m,).

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> observer = observers.ReducedOrder(models.duffing(), jnp.array([[1.0], [2.0]]), start=jnp.zeros(2))
        >>> observer.init(jnp.array([0.5])).x.tolist()  # the other state is what the measured one makes of it
        [0.5, 1.0]
    """

    x: Vector
    t: Scalar
    last_input: LastInput = None


class ReducedOrder(AbstractObserver):
    """Observer of the states that are not measured, `x⁺ = x̂ + [I; L] (y − h(x̂))` at each sample.

    A missing output corrects nothing. The noise of a measurement enters the estimate unfiltered.

    Use it if the outputs are states that are measured accurately. `verbs.design_reduced_order` computes the direction.
    It converges from any distance within the design's region. For noisy outputs choose `StateEKF` or `Contracting`.

    Attributes:
        model: The system, with n states, p of which are the outputs.
        direction: [I; L] (n, p) in the order of the states, `certificates.ReducedOrderDesign.direction`: the
            change of the states for a difference of one unit of an output.
        start: First estimate (n,).
        substeps: Number of Runge–Kutta steps of the model in each sample, 1 by default.

    Raises:
        ValueError: Direction, start and model do not fit each other, or the direction has an entry that is not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant import Record, certificates, models, observers
        >>> lorenz = models.lorenz()
        >>> design = certificates.reduced_order(lorenz, rate=1.0)
        >>> observer = observers.ReducedOrder(lorenz, design.direction, start=jnp.array([0.0, 1e4, -1e4]))
        >>> x, rows = jnp.array([1.0, 2.0, 20.0]), []
        >>> for _ in range(2001):
        ...     rows.append(x)
        ...     x = x + 0.005 * lorenz.f(0.0, x, jnp.zeros(0))
        >>> record = Record(np.arange(2001) * 0.005, np.zeros((2001, 0)), np.asarray(rows)[:, :1])
        >>> error = np.abs(observers.run(observer, record).estimate[-1] - rows[-1])  # the plant is stepped by Euler
        >>> bool(error.max() < 1.0)
        True
    """

    model: StateSpace
    direction: Float[Array, "n p"] = eqx.field(converter=jnp.asarray)
    start: Vector = eqx.field(converter=jnp.asarray)
    substeps: int = eqx.field(default=1, static=True)

    def __check_init__(self):
        check_gain("ReducedOrder", self.model, self.start, "direction", self.direction)

    def init(self, y: Float[Array, "p"], t: Number = 0.0) -> ReducedOrderState:
        """State at the first estimate, corrected by the first measurement.

        Args:
            y: First measurement (p,).
            t: Its time stamp [s], 0 by default.

        Returns:
            The state.
        """
        start = jnp.asarray(self.start, y.dtype)
        t = jnp.asarray(t, y.dtype)
        last_input = no_input(self.model, start)
        return ReducedOrderState(start - self._correction(t, start, last_input, y)[0], t, last_input)

    def estimate(self, state: ReducedOrderState) -> Vector:
        return state.x

    def predict(self, state: ReducedOrderState, u: Float[Array, "m"], dt: Scalar) -> ReducedOrderState:
        x = rk4(lambda s, x: self.model.f(s, x, u), state.t, state.x, dt, self.substeps)
        return state._replace(x=x, t=state.t + dt)

    def correct(
        self, state: ReducedOrderState, u: Float[Array, "m"], y: Float[Array, "p"]
    ) -> tuple[ReducedOrderState, Info]:
        """Correct a predicted state; the distance of the info is the Euclidean length of the correction.

        Args:
            state: State that `predict` returned.
            u: Input (m,) that acted over the prediction.
            y: Measurement (p,), NaN where missing.

        Returns:
            The corrected state and the info.
        """
        correction, error = self._correction(state.t, state.x, u, y)
        corrected = state.x - correction
        result = jnp.where(jnp.all(jnp.isnan(y)), int(StepCode.COASTED), int(StepCode.OK))
        result = jnp.where(jnp.all(jnp.isfinite(corrected)), result, int(StepCode.NOT_FINITE)).astype(jnp.int32)
        return state._replace(x=corrected), Info(-error, jnp.sqrt(correction @ correction), result)

    def innovation(self, state: ReducedOrderState, u: Float[Array, "m"], y: Float[Array, "p"]) -> Vector:
        return -self._correction(state.t, state.x, u, y)[1]

    def _correction(self, t: Scalar, x: Vector, u: Float[Array, "m"], y: Float[Array, "p"]) -> tuple[Vector, Outputs]:
        """The amount (n,) to subtract from the states, and the output differences (p,) h − y, 0 for missing outputs."""
        error = self.model.output_error(self.model.h(t, x, u), y)
        return jnp.asarray(self.direction, y.dtype) @ error, error
