"""Phase-locked loop: the α-β tracking loop by which drives make a velocity of a resolver or an encoder.

Source: Gardner 2005, Phaselock Techniques, the second-order type-II loop; Kalata 1984 for its samples.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Scalar, Vector
from covariant.observers._model_free import AbstractLinearFilter
from covariant.observers._protocol import as_gain, check_positive
from covariant.observers._sampled import sampled_gains
from covariant.observers._tracking_loop import AbstractTrackingLoop, loop_weights


class PLL(AbstractTrackingLoop, AbstractLinearFilter):
    """`q̂' = v̂ + 2ζω(y − q̂)`, `v̂' = ω²(y − q̂)`, sampled with the poles of this law: no lag on a steady turn.

    - `bandwidth` ω [rad/s], `damping` ζ.
    - `circles`: indices of the coordinates that are angles on a full circle, which are followed modulo a turn.

    Raises `ValueError` for a bandwidth or a damping that is not positive and finite.
    """

    order = 2
    bandwidth: Scalar = eqx.field(converter=as_gain)
    damping: Scalar = eqx.field(default=0.5**0.5, converter=as_gain)

    def __check_init__(self):
        check_positive("PLL", bandwidth=self.bandwidth, damping=self.damping)

    def gains(self, dt: Vector, error: Vector) -> Float[Array, "2 n"]:
        """What an error (n,) is multiplied by, dt [s] (n,) after the last measurement."""
        alpha, beta = 2 * self.damping * self.bandwidth, self.bandwidth**2
        return jnp.stack(jax.vmap(lambda each: sampled_gains(alpha, beta, each))(dt))

    def weights(self, rate: float) -> Float[np.ndarray, "k"]:
        return loop_weights(self.gains, rate)
