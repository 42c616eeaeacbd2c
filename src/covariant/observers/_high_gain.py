"""High-gain differentiator of third order: position, velocity and acceleration from positions.

Source: Vasiljevic & Khalil 2008, Error bounds in differentiation of noisy signals by high-gain observers, Systems &
Control Letters 57(10); Khalil & Praly 2014, High-gain observers in nonlinear feedback control, IJRNC 24(6).
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Scalar, Vector
from covariant.observers._model_free import AbstractLinearFilter
from covariant.observers._protocol import as_gain, check_positive
from covariant.observers._tracking_loop import AbstractTrackingLoop, loop_weights, triple_pole


class HighGain(AbstractTrackingLoop, AbstractLinearFilter):
    """`q̂' = v̂ + 3ω e`, `v̂' = â + 3ω² e`, `â' = ω³ e`, `e = y − q̂`: three poles at −ω, and at exp(−ω dt) in samples.

    - `bandwidth` ω [rad/s]: 1/ε of the papers.
    - `circles`: indices of the coordinates that are angles on a full circle, which are followed modulo a turn.

    Raises `ValueError` for a bandwidth that is not positive and finite.
    """

    order = 3
    bandwidth: Scalar = eqx.field(converter=as_gain)

    def __check_init__(self):
        check_positive("HighGain", bandwidth=self.bandwidth)

    def gains(self, dt: Vector, error: Vector) -> Float[Array, "3 n"]:
        """What an error (n,) is multiplied by, dt [s] (n,) after the last measurement."""
        return triple_pole(self.bandwidth * dt, dt)

    def weights(self, rate: float) -> Float[np.ndarray, "k"]:
        return loop_weights(self.gains, rate)
