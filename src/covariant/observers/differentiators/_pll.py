"""Phase-locked loops: α-β and α-β-γ tracking loops, with which drives obtain the velocity of a resolver or an encoder.

Source: Gardner 2005, Phaselock Techniques, the type-II loop of second order and the type-III loop of third order;
Kalata 1984 for their samples.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Scalar, Vector
from covariant.observers.base import as_gain, check_positive, sampled_force_gains, sampled_gains
from covariant.observers.differentiators._model_free import AbstractLinearFilter
from covariant.observers.differentiators._tracking_loop import AbstractTrackingLoop, loop_weights
from scalargraph.errors import InputError


class PLL(AbstractTrackingLoop, AbstractLinearFilter):
    """Phase-locked loop of second order, which has no lag at a steady speed, or of third, with none at an acceleration.

    It has the poles of `s² + 2ζωs + ω²`, `q̂' = v̂ + 2ζω(y − q̂)`, `v̂' = ω²(y − q̂)`; of third order it has one more at −ω,
    and follows the acceleration too. It is sampled with the poles of this law.

    It is the α-β, or α-β-γ, tracking loop of drives. At a steady acceleration a the velocity of second order lags by
    `2ζ a/ω`. With ζ = 1/√2, and in third order ½, it is the stationary Kalman filter of a motion whose acceleration, or
    jerk, is white noise. Use `FilteredDerivative` if the least work matters.

    Attributes:
        bandwidth: Natural frequency ω [rad/s].
        damping: Damping ratio ζ; 1/√2 by default.
        order: Number of integrators, 2 (default) or 3.
        circles: Indices of the coordinates that are angles on a full circle, which are followed modulo a turn; none by
            default.

    Raises:
        ValueError: The bandwidth or the damping is not positive and finite, or the order is neither 2 nor 3.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, observers
        >>> t = np.linspace(0.0, 1.0, 101)
        >>> run = observers.run(observers.PLL(bandwidth=20.0), Record(t, y=2.0 * t[:, None]))
        >>> run.estimate[-1].round(3).tolist()
        [2.0, 2.0]
        >>> third = observers.run(observers.PLL(30.0, damping=0.5, order=3), Record(t, y=t[:, None] ** 2))
        >>> third.estimate[-1].round(3).tolist()
        [1.0, 2.0]
    """

    bandwidth: Scalar = eqx.field(converter=as_gain)
    damping: Scalar = eqx.field(default=0.5**0.5, converter=as_gain)

    order: int = eqx.field(default=2, static=True)

    def __check_init__(self):
        check_positive("PLL", bandwidth=self.bandwidth, damping=self.damping)
        if self.order not in (2, 3):
            raise InputError(f"PLL: order must be 2 or 3; got {self.order}")

    def gains(self, dt: Vector, error: Vector) -> Float[Array, "k n"]:
        """Gains of the correction, for each coordinate.

        Args:
            dt: Time (n,) since the last measurement [s].
            error: Measured minus extrapolated position (n,) [rad or m]; it has no influence.

        Returns:
            Factors (k, n) of the error in the correction of position, velocity and acceleration: 1, 1/s, 1/s².
        """
        # Coefficients of s² + αs + β, whose roots are poles of the loop in continuous time; the third one is −ω.
        alpha, beta = 2 * self.damping * self.bandwidth, self.bandwidth**2

        def each(dt: Scalar) -> tuple[Scalar, ...]:
            third = self.order == 3
            return sampled_force_gains(alpha, beta, self.bandwidth, dt) if third else sampled_gains(alpha, beta, dt)

        return jnp.stack(jax.vmap(each)(dt))

    def weights(self, rate: float) -> Float[np.ndarray, "k"]:
        return loop_weights(self.gains, rate)
