"""Phase-locked loop: the α-β tracking loop by which drives make a velocity of a resolver or an encoder.

Source: Gardner 2005, Phaselock Techniques, the second-order type-II loop; Kalata 1984 for its samples.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Number, Scalar, Vector
from covariant.observers._model_free import AbstractLinearFilter, FilterInfo
from covariant.observers._protocol import as_gain, check_positive
from covariant.observers._sampled import sampled_gains
from covariant.observers._tracking_loop import LoopState, loop_weights, standing, tracked


class PLL(AbstractLinearFilter):
    """`q̂' = v̂ + 2ζω(y − q̂)`, `v̂' = ω²(y − q̂)`, sampled with the poles of this law: no lag on a steady turn.

    - `bandwidth` ω [rad/s], `damping` ζ.
    - `circles`: indices of the coordinates that are angles on a full circle, which are followed modulo a turn.

    Raises `ValueError` for a bandwidth or a damping that is not positive and finite.
    """

    bandwidth: Scalar = eqx.field(converter=as_gain)
    damping: Scalar = eqx.field(default=0.5**0.5, converter=as_gain)
    circles: tuple[int, ...] = eqx.field(default=(), static=True)

    def __check_init__(self):
        check_positive("PLL", bandwidth=self.bandwidth, damping=self.damping)

    def init(self, y: Vector, t: Number = 0.0) -> LoopState:
        return standing(2, y)

    def estimate(self, state: LoopState) -> Float[Array, "two_n"]:
        return jnp.concatenate([state.x[0], state.x[1]])

    def advance(self, state: LoopState, u: Float[Array, "m"], y: Vector, dt: Scalar) -> tuple[LoopState, FilterInfo]:
        return tracked(self.gains, self.circles, state, y, dt)

    def gains(self, dt: Vector, error: Vector) -> Float[Array, "2 n"]:
        """What an error (n,) is multiplied by, dt [s] (n,) after the last measurement."""
        alpha, beta = 2 * self.damping * self.bandwidth, self.bandwidth**2
        return jnp.stack(jax.vmap(lambda each: sampled_gains(alpha, beta, each))(dt))

    def weights(self, rate: float) -> Float[np.ndarray, "k"]:
        return loop_weights(self.gains, rate)
