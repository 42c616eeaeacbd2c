"""Phase-locked loop: the α-β tracking loop with which drives obtain the velocity of a resolver or an encoder.

Source: Gardner 2005, Phaselock Techniques, the second-order type-II loop; Kalata 1984 for its samples.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Scalar, Vector
from covariant.observers.base import as_gain, check_positive, sampled_gains
from covariant.observers.differentiators._model_free import AbstractLinearFilter
from covariant.observers.differentiators._tracking_loop import AbstractTrackingLoop, loop_weights


class PLL(AbstractTrackingLoop, AbstractLinearFilter):
    """Phase-locked loop of second order, which has no lag at a steady speed.

    It is `q̂' = v̂ + 2ζω(y − q̂)`, `v̂' = ω²(y − q̂)`, sampled with the poles of this law.

    It is the α-β tracking loop of drives. At a steady acceleration a the velocity lags by `2ζ a/ω`. Use `HighGain` if
    speeds change often, and `FilteredDerivative` if the least work matters.

    Attributes:
        bandwidth: Natural frequency ω [rad/s].
        damping: Damping ratio ζ; 1/√2 by default.
        circles: Indices of the coordinates that are angles on a full circle, which are followed modulo a turn; none by
            default.

    Raises:
        ValueError: The bandwidth or the damping is not positive and finite.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, observers
        >>> t = np.linspace(0.0, 1.0, 101)
        >>> run = observers.run(observers.PLL(bandwidth=20.0), Record(t, y=2.0 * t[:, None]))
        >>> run.estimate[-1].round(3).tolist()
        [2.0, 2.0]
    """

    order = 2
    bandwidth: Scalar = eqx.field(converter=as_gain)
    damping: Scalar = eqx.field(default=0.5**0.5, converter=as_gain)

    def __check_init__(self):
        check_positive("PLL", bandwidth=self.bandwidth, damping=self.damping)

    def gains(self, dt: Vector, error: Vector) -> Float[Array, "2 n"]:
        """Gains of the correction, for each coordinate.

        Args:
            dt: Time (n,) since the last measurement [s].
            error: Measured minus extrapolated position (n,) [rad or m]; it has no influence.

        Returns:
            Factors (2, n) of the error in the correction of position, velocity: 1, 1/s.
        """
        # Coefficients of s² + αs + β, whose roots are the poles of the loop in continuous time.
        alpha, beta = 2 * self.damping * self.bandwidth, self.bandwidth**2
        return jnp.stack(jax.vmap(lambda each: sampled_gains(alpha, beta, each))(dt))

    def weights(self, rate: float) -> Float[np.ndarray, "k"]:
        return loop_weights(self.gains, rate)
