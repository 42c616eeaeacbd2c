"""The gate: decides which measurements an estimator uses, by how far they are from what it expects.

Source: Bar-Shalom, Li & Kirubarajan 2001, Estimation with Applications to Tracking and Navigation, section 5.4.
"""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from covariant._linalg import solve
from covariant._typing import Matrix, Vector
from covariant.geometry import AbstractManifold

BELIEVED = 4.0
"""Cap on a squared innovation in the average, as a multiple of the average: so an outlier changes it little."""


class Gate(eqx.Module):
    """Refuses a measurement that is too improbable, unless such measurements persist.

    - `deviations`: a single number is refused when it is off by more standard deviations than this. Several numbers
      measured together, such as an attitude, are refused when they are as improbable as that.
    - `patience`: after this many samples refused in a row the next is accepted, and the estimate starts anew from it.
    - `memory`: number of samples over which the ratio of the actual to the expected squared innovations is averaged;
      it widens the gate where the assumed noise is too small.
    """

    deviations: float = eqx.field(default=8.0, static=True)
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
        """Find the measured components of an innovation (n,) that are too far off, given its covariance `spread`.

        - `present` (n,): which components were measured.
        - `scale` (n,): averaged ratio of actual to expected squared innovations, 1 at the start.

        Returns which components are refused, and the scale updated by this sample, whose square counts no more than
        `BELIEVED` times the scale.
        """
        far, learnt = jnp.zeros_like(present), scale
        for together in manifold.measured_together(innovation.shape[0]):
            own = jnp.asarray(together)
            r = innovation[own]
            square = r @ solve(spread[jnp.ix_(own, own)], r) / len(together)
            limit = self._limit(len(together)) / len(together) * jnp.maximum(scale[own[0]], 1.0)
            measured = jnp.all(present[own])
            far = far.at[own].set(measured & (square > limit))
            change = (jnp.minimum(square, BELIEVED * jnp.maximum(scale[own], 1.0)) - scale[own]) / self.memory
            learnt = learnt.at[own].add(jnp.where(measured, change, 0.0))
        return far, learnt

    def _limit(self, n: int) -> float:
        """The squared length that n standard Gaussian numbers exceed as rarely as a single one exceeds `deviations`."""
        rare, low, high = _exceed(1, self.deviations**2), 0.0, 4 * (self.deviations**2 + n)
        for _ in range(80):
            middle = (low + high) / 2
            low, high = (middle, high) if _exceed(n, middle) > rare else (low, middle)
        return high


def _exceed(n: int, square: float) -> float:
    """Probability that χ² with n degrees of freedom exceeds `square`: `Q(n/2, square/2)`, by its recurrence in n."""
    x = square / 2
    a, total = (1.0, math.exp(-x)) if n % 2 == 0 else (0.5, math.erfc(math.sqrt(x)))
    while a < n / 2:
        total += math.exp(a * math.log(x) - x - math.lgamma(a + 1)) if x > 0 else 0.0
        a += 1
    return total
