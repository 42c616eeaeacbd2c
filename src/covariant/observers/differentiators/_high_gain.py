"""High-gain differentiator of third order: position, velocity and acceleration from positions.

Source: Vasiljevic & Khalil 2008, Error bounds in differentiation of noisy signals by high-gain observers, Systems &
Control Letters 57(10); Khalil & Praly 2014, High-gain observers in nonlinear feedback control, IJRNC 24(6).
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Scalar, Vector
from covariant.observers.base import as_gain, check_positive
from covariant.observers.differentiators._model_free import AbstractLinearFilter
from covariant.observers.differentiators._tracking_loop import AbstractTrackingLoop, loop_weights, triple_pole


class HighGain(AbstractTrackingLoop, AbstractLinearFilter):
    """High-gain differentiator of third order with three equal poles.

    It is `q̂' = v̂ + 3ω e`, `v̂' = â + 3ω² e`, `â' = ω³ e`, `e = y − q̂`, with three poles at −ω, sampled with three poles
    at exp(−ω dt).

    Use it without a model if speeds change; it has no lag at a steady acceleration. It amplifies noise more than `PLL`
    at the same bandwidth.

    Attributes:
        bandwidth: Bandwidth ω [rad/s]; 1/ε of the papers.
        circles: Indices of the coordinates that are angles on a full circle, which are followed modulo a turn; none by
            default.

    Raises:
        ValueError: The bandwidth is not positive and finite.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, observers
        >>> t = np.linspace(0.0, 1.0, 101)
        >>> run = observers.run(observers.HighGain(bandwidth=30.0), Record(t, y=t[:, None] ** 2))
        >>> run.estimate[-1].round(3).tolist()  # a steady acceleration is followed without error
        [1.0, 2.0]
    """

    order = 3
    bandwidth: Scalar = eqx.field(converter=as_gain)

    def __check_init__(self):
        check_positive("HighGain", bandwidth=self.bandwidth)

    def gains(self, dt: Vector, error: Vector) -> Float[Array, "3 n"]:
        """Gains of the correction, for each coordinate.

        Args:
            dt: Time (n,) since the last measurement [s].
            error: Measured minus extrapolated position (n,) [rad or m]; it has no influence.

        Returns:
            Factors (3, n) of the error in the correction of position, velocity and acceleration: 1, 1/s, 1/s².
        """
        return triple_pole(self.bandwidth * dt, dt)

    def weights(self, rate: float) -> Float[np.ndarray, "k"]:
        return loop_weights(self.gains, rate)
