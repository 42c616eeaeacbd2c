"""Levant's differentiator of second order: exact after a finite time, if there is no noise and the jerk is bounded.

In continuous time, with `⌈e⌋ᵖ = |e|ᵖ sign e` and `κ = 3/2 L`,

    q̂' = v̂ + 3κ^⅓⌈e⌋^⅔,   v̂' = â + 3κ^⅔⌈e⌋^⅓,   â' = κ sign e,   e = y − q̂:

a high-gain differentiator whose bandwidth is `ω(e) = (κ/|e|)^⅓`, with three equal poles −ω(e). The sampled form keeps
these poles: its correction places the poles of the loop at exp(−ω(e) dt). They go to 0 with the error, so the estimate
does not chatter at rest, as it would in Euler's scheme. For small steps the correction equals Levant's, times dt.

Source: Levant 2003, Higher-order sliding modes, differentiation and output-feedback control, Int. J. Control 76; Koch,
Reichhartinger, Horn & Fridman 2020, Discrete-time implementation of homogeneous differentiators, IEEE TAC 65(2).
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._typing import Scalar, Vector
from covariant.observers.base import as_gain, check_positive
from covariant.observers.differentiators._tracking_loop import AbstractTrackingLoop, triple_pole

MARGIN = 1.5
"""Ratio κ/L. At 1 the sign term only just outweighs the jerk; tests search for the worst case of the jerk."""


class Levant(AbstractTrackingLoop):
    """Levant's differentiator with a bound on the jerk.

    Without noise the error of the velocity falls below a multiple of `L dt²` in finite time.

    It needs a bound on the jerk instead of a bandwidth: large errors are corrected fast and small ones slowly. Use it
    if there is little noise. With much noise `JointKalman` or `SavitzkyGolay` is more accurate. The bound is one number
    for all coordinates, so scale them alike.

    Attributes:
        jerk: Bound L on the jerk [rad/s³ or m/s³]. A larger bound gives faster convergence and passes more noise.
        circles: Indices of the coordinates that are angles on a full circle, which are differentiated modulo a turn;
            none by default.

    Raises:
        ValueError: The bound is not positive and finite.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, observers
        >>> t = np.linspace(0.0, 2.0, 201)
        >>> run = observers.run(observers.Levant(jerk=10.0), Record(t, y=np.sin(t)[:, None]))
        >>> bool(abs(run.estimate[-1, 1] - np.cos(2.0)) < 1e-2)
        True
    """

    order = 3
    jerk: Scalar = eqx.field(converter=as_gain)

    def __check_init__(self):
        check_positive("Levant", jerk=self.jerk)

    def gains(self, dt: Vector, error: Vector) -> Float[Array, "3 n"]:
        """Gains of the correction, for each coordinate.

        Args:
            dt: Time (n,) since the last measurement [s].
            error: Measured minus extrapolated position (n,) [rad or m], which sets the bandwidth `(κ/|e|)^⅓`.

        Returns:
            Factors (3, n) of the error in the correction of position, velocity and acceleration: 1, 1/s, 1/s².
        """
        size = jnp.where(error != 0, jnp.abs(error), 1.0)  # a zero error needs no correction, so any gain is correct
        return triple_pole(jnp.cbrt(MARGIN * self.jerk / size) * dt, dt)
