"""The gate: decides which measurements an estimator uses, by how far they are from the predicted ones.

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
"""Cap on a squared innovation in the average, as a multiple of the average, so that an outlier changes it little."""


class Judged(NamedTuple):
    """Verdict of a gate on a measurement of n components.

    Attributes:
        far: Which components (n,) are refused.
        restart: Whether so many samples were refused in a row that the estimate has to start anew from this
            measurement.
        refused: Number (n,) of samples refused in a row, this one included.
        scale: Average (n,) of the ratio of actual to expected squared innovations.
    """

    far: Bool[Array, "n"]
    restart: Flag
    refused: Int[Array, "n"]
    scale: Vector

    def result(self, otherwise: Code) -> Code:
        """Result code of the step.

        Args:
            otherwise: Code of the step without the gate.

        Returns:
            `RESTARTED`, `OUTLIER` or `OK` by what the gate did, or `otherwise` where that is worse.
        """
        code = jnp.where(self.restart, int(Result.RESTARTED), jnp.where(jnp.any(self.far), int(Result.OUTLIER), 0))
        return jnp.maximum(code, otherwise)


class Gate(eqx.Module):
    """Refuses a measurement that is too improbable, unless such measurements persist.

    Attributes:
        deviations: Threshold in standard deviations, 8 by default: a single number that is off by more is refused.
            Several numbers measured together, such as an attitude, are refused when they are as improbable as that.
        patience: Number of samples refused in a row after which the next one is accepted, and the estimate starts anew
            from it; 10 by default.
        memory: Number of samples over which the ratio of actual to expected squared innovations is averaged, 50 by
            default; the average widens the gate where the assumed noise is too small.

    Raises:
        ValueError: `deviations` or `memory` is not positive and finite, or `patience` is negative.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> gate, manifold = observers.Gate(deviations=5.0), models.ball_and_beam().manifold
        >>> innovation, cov = jnp.array([4.0, 6.0]), jnp.eye(2)
        >>> verdict = gate.judge(
        ...     manifold, innovation, cov, jnp.ones(2, bool), refused=jnp.zeros(2, jnp.int32), scale=jnp.ones(2)
        ... )
        >>> verdict.far.tolist(), verdict.refused.tolist()
        ([False, True], [0, 1])
    """

    deviations: float = eqx.field(default=8.0, static=True)
    patience: int = eqx.field(default=10, static=True)
    memory: float = eqx.field(default=50.0, static=True)

    def __check_init__(self):
        for name in ("deviations", "memory"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"Gate: {name} must be a positive, finite number; got {value}")
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
        """Judge the measured components of an innovation by its covariance.

        In the average, the square of an innovation counts no more than `BELIEVED` times the scale.

        Args:
            manifold: Manifold of the measured configurations, which says which components are measured together.
            innovation: Measured minus expected configuration (n,), in the frame.
            spread: Covariance (n, n) of the innovation.
            present: Which components (n,) are measured.
            refused: Field `refused` (n,) of the verdict on the previous sample; 0 at the start.
            scale: Field `scale` (n,) of the verdict on the previous sample; 1 at the start.
            least: Lower bound of the scale by which the gate is widened, a number or (n,); 1 by default.

        Returns:
            The verdict.
        """
        far, new_scale = jnp.zeros_like(present), scale
        widening = jnp.maximum(scale, least)
        for together in manifold.measured_together(innovation.shape[0]):
            block = jnp.asarray(together)
            r = innovation[block]
            # The squared length of n standard Gaussian numbers is n on average, so this is 1.
            square = r @ solve(spread[jnp.ix_(block, block)], r) / len(together)
            # A block is judged as a whole, so it needs all of its components.
            measured = jnp.all(present[block])
            far = far.at[block].set(
                measured & (square > self._limit(len(together)) / len(together) * widening[block[0]])
            )
            change = (jnp.minimum(square, BELIEVED * widening[block]) - scale[block]) / self.memory
            new_scale = new_scale.at[block].add(jnp.where(measured, change, 0.0))
        # A new start needs a complete configuration.
        restart = jnp.any(far & (refused >= self.patience)) & jnp.all(present)
        count = jnp.where(far, refused + 1, jnp.where(present, 0, refused))
        return Judged(far, restart, jnp.where(restart, 0, count), new_scale)

    def _limit(self, n: int) -> float:
        """The squared length that n standard Gaussian numbers exceed as rarely as a single one exceeds `deviations`."""
        target, low, high = _exceedance(1, self.deviations**2), 0.0, 4 * (self.deviations**2 + n)
        # Bisection: 80 halvings exhaust the digits of a double.
        for _ in range(80):
            middle = (low + high) / 2
            low, high = (middle, high) if _exceedance(n, middle) > target else (low, middle)
        return high


def _exceedance(n: int, square: float) -> float:
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
    """Verdict of a gate, or of no gate, which refuses nothing.

    Args:
        gate: The gate, or None.
        manifold: Manifold of the measured configurations.
        innovation: Measured minus expected configuration (n,).
        spread: Covariance (n, n) of the innovation.
        present: Which components (n,) are measured.
        refused: Field `refused` (n,) of the previous verdict.
        scale: Field `scale` (n,) of the previous verdict.

    Returns:
        The verdict of `Gate.judge`; without a gate, one that refuses nothing and changes neither `refused` nor `scale`.
    """
    if gate is None:
        return Judged(jnp.zeros_like(present), jnp.zeros((), bool), refused, scale)
    return gate.judge(manifold, innovation, spread, present, refused, scale)


def open_gate(v: Vector) -> tuple[Int[Array, "n"], Vector]:
    """What a gate remembers at the start.

    Args:
        v: A vector of n velocities, of which only shape and precision count.

    Returns:
        `refused` (n,), zeros, and `scale` (n,), ones.
    """
    return jnp.zeros(v.shape, jnp.int32), jnp.ones_like(v)
