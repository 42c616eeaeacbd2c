"""The gate: which measurements an estimator believes, told from how far they are from what it expects.

Source: Bar-Shalom, Li & Kirubarajan 2001, Estimation with Applications to Tracking and Navigation, section 5.4.
"""

import math
from statistics import NormalDist

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from covariant._linalg import solve
from covariant._typing import Matrix, Vector
from covariant.geometry import AbstractManifold


class Gate(eqx.Module):
    """Refuses a measurement that is too improbable, unless as much comes again and again.

    - `deviations`: a single number is refused when it is more standard deviations off than this; several that are
      measured together, such as an attitude, when they are as improbable.
    - `patience`: samples refused in a row, after which the next is believed and the estimate starts anew from it.
    """

    deviations: float = eqx.field(default=6.0, static=True)
    patience: int = eqx.field(default=10, static=True)

    def __check_init__(self):
        if not (math.isfinite(self.deviations) and self.deviations > 0):
            raise ValueError(f"Gate: deviations must be a positive, finite number; got {self.deviations}")
        if self.patience < 0:
            raise ValueError(f"Gate: patience must be a number of samples, 0 or more; got {self.patience}")

    def refuses(self, manifold: AbstractManifold, innovation: Vector, spread: Matrix) -> Bool[Array, "n"]:
        """Which components of the innovation (n,), expected to have the covariance `spread`, are too far off."""
        far = jnp.zeros(innovation.shape, bool)
        for together in manifold.measured_together(innovation.shape[0]):
            own = jnp.asarray(together)
            r = innovation[own]
            square = r @ solve(spread[jnp.ix_(own, own)], r)
            far = far.at[own].set(square > self._limit(len(together)))
        return far

    def _limit(self, n: int) -> float:
        """The squared length that n Gaussian numbers exceed as seldom as one exceeds `deviations` (Wilson–Hilferty)."""
        if n == 1:
            return self.deviations**2
        normal = NormalDist()
        z = -normal.inv_cdf(max(2 * normal.cdf(-self.deviations), 1e-300))
        return n * (1 - 2 / (9 * n) + z * math.sqrt(2 / (9 * n))) ** 3
