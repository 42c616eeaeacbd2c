"""The gate: decides which measurements an estimator uses, by how far they are from what it expects.

Source: Bar-Shalom, Li & Kirubarajan 2001, Estimation with Applications to Tracking and Navigation, section 5.4.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from covariant._linalg import solve
from covariant._typing import Code, Flag, Matrix, Vector
from covariant.geometry import AbstractManifold
from covariant.signals import Result

BELIEVED = 4.0
"""Cap on a squared innovation in the average, as a multiple of the average: so an outlier changes it little."""


class Judged(NamedTuple):
    """What a gate finds in a measurement of n components.

    - `far` (n,): which of them are refused.
    - `restart`: whether so many were refused in a row that the estimate has to start anew from this measurement.
    - `refused` (n,): number of samples in a row that were refused, this one included.
    - `scale` (n,): averaged ratio of actual to expected squared innovations.
    """

    far: Bool[Array, "n"]
    restart: Flag
    refused: Int[Array, "n"]
    scale: Vector

    def result(self, otherwise: Code) -> Code:
        """The result code of the step: what the gate did, or `otherwise` where that is worse."""
        code = jnp.where(self.restart, int(Result.RESTARTED), jnp.where(jnp.any(self.far), int(Result.OUTLIER), 0))
        return jnp.maximum(code, otherwise)


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
        self,
        manifold: AbstractManifold,
        innovation: Vector,
        spread: Matrix,
        present: Bool[Array, "n"],
        refused: Int[Array, "n"],
        scale: Vector,
        least: Vector | float = 1.0,
    ) -> Judged:
        """Find the measured components of an innovation (n,) that are too far off, given its covariance `spread`.

        - `present` (n,): which components were measured.
        - `refused` (n,), `scale` (n,): what was found in the sample before; 0 and 1 at the start.
        - `least` (n,): the gate is never narrower than for a scale of this.

        In the average, the square of an innovation counts no more than `BELIEVED` times the scale.
        """
        far, learnt = jnp.zeros_like(present), scale
        wide = jnp.maximum(scale, least)
        for together in manifold.measured_together(innovation.shape[0]):
            own = jnp.asarray(together)
            r = innovation[own]
            square = r @ solve(spread[jnp.ix_(own, own)], r) / len(together)
            measured = jnp.all(present[own])
            far = far.at[own].set(measured & (square > self._limit(len(together)) / len(together) * wide[own[0]]))
            change = (jnp.minimum(square, BELIEVED * wide[own]) - scale[own]) / self.memory
            learnt = learnt.at[own].add(jnp.where(measured, change, 0.0))
        # A new start needs a complete configuration.
        restart = jnp.any(far & (refused >= self.patience)) & jnp.all(present)
        counted = jnp.where(far, refused + 1, jnp.where(present, 0, refused))
        return Judged(far, restart, jnp.where(restart, 0, counted), learnt)

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


def judged(
    gate: Gate | None,
    manifold: AbstractManifold,
    innovation: Vector,
    spread: Matrix,
    present: Bool[Array, "n"],
    refused: Int[Array, "n"],
    scale: Vector,
) -> Judged:
    """`Gate.judge`; without a gate nothing is refused."""
    if gate is None:
        return Judged(jnp.zeros_like(present), jnp.zeros((), bool), refused, scale)
    return gate.judge(manifold, innovation, spread, present, refused, scale)


def open_gate(v: Vector) -> tuple[Int[Array, "n"], Vector]:
    """`refused` and `scale` of a state at the start, for n velocities v."""
    return jnp.zeros(v.shape, jnp.int32), jnp.ones_like(v)
