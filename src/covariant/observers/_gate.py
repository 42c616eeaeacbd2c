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
    - `memory`: samples over which it is learnt how much larger the innovations are than expected, which widens the gate
      where the noise was told too small.
    """

    deviations: float = eqx.field(default=6.0, static=True)
    patience: int = eqx.field(default=10, static=True)
    memory: float = eqx.field(default=50.0, static=True)

    def __check_init__(self):
        for name in ("deviations", "memory"):
            given = getattr(self, name)
            if not (math.isfinite(given) and given > 0):
                raise ValueError(f"Gate: {name} must be a positive, finite number; got {given}")
        if self.patience < 0:
            raise ValueError(f"Gate: patience must be a number of samples, 0 or more; got {self.patience}")

    def judge(
        self, manifold: AbstractManifold, innovation: Vector, spread: Matrix, present: Bool[Array, "n"], scale: Vector
    ) -> tuple[Bool[Array, "n"], Vector]:
        """Which components present of an innovation (n,) with the expected covariance `spread` are too far off.

        `scale` (n,): how much larger than expected the squares of the innovations have been, 1 at the start; returned
        with this sample in it, of which no more counts than the gate lets pass.
        """
        far, learnt = jnp.zeros_like(present), scale
        for together in manifold.measured_together(innovation.shape[0]):
            own = jnp.asarray(together)
            r = innovation[own]
            square = r @ solve(spread[jnp.ix_(own, own)], r) / len(together)
            limit = self._limit(len(together)) / len(together) * jnp.maximum(scale[own[0]], 1.0)
            seen = jnp.all(present[own])
            far = far.at[own].set(seen & (square > limit))
            change = (jnp.minimum(square, limit) - scale[own]) / self.memory
            learnt = learnt.at[own].add(jnp.where(seen, change, 0.0))
        return far, learnt

    def _limit(self, n: int) -> float:
        """The squared length that n Gaussian numbers exceed as seldom as one exceeds `deviations` (Wilson–Hilferty)."""
        if n == 1:
            return self.deviations**2
        normal = NormalDist()
        z = -normal.inv_cdf(max(2 * normal.cdf(-self.deviations), 1e-300))
        return n * (1 - 2 / (9 * n) + z * math.sqrt(2 / (9 * n))) ** 3
