"""Defines the sample that a gate judges, the memory of the gate, and its verdict."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from covariant._typing import Code, Flag, Matrix, Scalar, Vector
from covariant.signals import StepCode

BEND = 0.1
"""Change of the slope along a line, as a fraction of the slope, that is allowed for an accelerating motion."""


class Line(NamedTuple):
    """The line through the last refused readings and a new one, all relative to the last used reading.

    Attributes:
        refused: Number (n,) of readings before the new one that were refused in a row.
        change: Innovation (n,) of the new reading, minus the one that remained after the last used reading.
        latest: Slope (n,) between the last two readings.
        slope: Slope (n,) of the line, a velocity relative to that of the estimate: between the last two readings if
            one was refused before, and over the last three if there were more.
        bend: Distance (n,) of the new reading from the line through the two before it, 0 if only one was refused.
        step: Time (n,) [s] from the previous reading to the new one.
        length: Time (n,) [s] from the last used reading to the new one.
    """

    refused: Int[Array, "n"]
    change: Vector
    latest: Vector
    slope: Vector
    bend: Vector
    step: Vector
    length: Vector

    @property
    def gap(self) -> Vector:
        """Time (n,) [s] without readings before the first refused one, assuming evenly spaced readings since then."""
        return self.length - self.refused.astype(self.step.dtype) * self.step

    def slope_cov(self, noise: Matrix, scale: Vector) -> Matrix:
        """Covariance (n, n) of the slope."""
        factor = jnp.sqrt(jnp.where(self.refused > 1, scale / 2, 2 * scale)) / self.step
        # The bends of joints that are hit at the same time are treated as uncorrelated.
        return noise * jnp.outer(factor, factor) + jnp.diag((self.bend / self.step) ** 2 + (BEND * self.slope) ** 2)


class GateMemory(NamedTuple):
    """Data that a gate remembers from sample to sample, for each of n components.

    Attributes:
        refused: Number (n,) of samples refused in a row.
        scale: Average (n,) of the ratio of actual to expected squared innovations.
        left: Innovation (n,) that remained after the correction by the last used reading.
        last: Innovation (n,) of the last refused reading, minus `left`; meaningless if none was refused since.
        slope: Velocity (n,) between the last two refused readings, relative to that of the estimate; meaningless if
            fewer than two were refused since.
        idle: Time (n,) [s] since the last reading, used or not.
        unused: Time (n,) [s] since the last used reading.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.observers.base import GateMemory
        >>> memory = GateMemory.at_start(jnp.zeros(2)).advanced(0.01)
        >>> memory.refused.tolist(), memory.idle.tolist()
        ([0, 0], [0.01, 0.01])
    """

    refused: Int[Array, "n"]
    scale: Vector
    left: Vector
    last: Vector
    slope: Vector
    idle: Vector
    unused: Vector

    @classmethod
    def at_start(cls, like: Vector) -> "GateMemory":
        """The memory of a gate that has seen one measurement and used it.

        Args:
            like: A vector of n components; only its shape and precision are used.

        Returns:
            The memory.
        """
        zero = jnp.zeros_like(like)
        return cls(jnp.zeros(like.shape, jnp.int32), jnp.ones_like(like), *(zero,) * 5)

    def advanced(self, dt: Scalar) -> "GateMemory":
        """The memory after a prediction over dt [s]."""
        return self._replace(idle=self.idle + dt, unused=self.unused + dt)

    def line(self, innovation: Vector) -> Line:
        """The line through the last refused readings and the new one, whose innovation (n,) is the argument."""
        change = innovation - self.left
        # A repeated stamp changes no state, so a zero divisor may be replaced by any positive number.
        step = jnp.where(self.idle > 0, self.idle, 1.0)
        latest, several = (change - self.last) / step, self.refused > 1
        slope = jnp.where(several, (latest + self.slope) / 2, latest)
        bend = jnp.where(several, (latest - self.slope) * step, 0.0)
        return Line(self.refused, change, latest, slope, bend, step, self.unused)

    def judged(self, line: Line, present: Bool[Array, "n"], far: Bool[Array, "n"], scale: Vector) -> "GateMemory":
        """The memory after a verdict, before `used` accounts for the correction.

        Args:
            line: The line through the last refused readings and the new one.
            present: Which components (n,) are measured.
            far: Which components (n,) are refused.
            scale: The new average (n,).

        Returns:
            The memory.
        """
        return self._replace(
            refused=self.refused + far.astype(self.refused.dtype),
            scale=scale,
            last=jnp.where(far, line.change, self.last),
            slope=jnp.where(far, line.latest, self.slope),
            idle=jnp.where(present, 0.0, self.idle),
        )

    def used(self, used: Bool[Array, "n"], left: Vector) -> "GateMemory":
        """The memory after a correction.

        Args:
            used: Which components (n,) of the measurement were used, by a correction or by a restart.
            left: Difference (n,) from the new estimate to the measurement.

        Returns:
            The memory.
        """
        # The next line starts at this used reading.
        return self._replace(
            refused=jnp.where(used, 0, self.refused),
            left=jnp.where(used, left, self.left),
            unused=jnp.where(used, 0.0, self.unused),
        )


class Sample(NamedTuple):
    """An innovation that a gate judges, with its covariances.

    Attributes:
        innovation: Measured minus expected configuration (n,), in the frame, 0 where it is missing.
        cov: Covariance (n, n) of the innovation.
        noise: Covariance (n, n) of the noise of the measurement alone.
        present: Which components (n,) are measured.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.observers.base import Sample
        >>> Sample(jnp.array([0.1]), jnp.eye(1), jnp.eye(1), jnp.ones(1, bool)).innovation.shape
        (1,)
    """

    innovation: Vector
    cov: Matrix
    noise: Matrix
    present: Bool[Array, "n"]


class Velocity(NamedTuple):
    """A velocity and its covariance.

    Attributes:
        mean: Velocity (n,), in the frame.
        cov: Its covariance (n, n).

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.observers.base import Velocity
        >>> Velocity(jnp.zeros(2), jnp.eye(2)).cov.tolist()
        [[1.0, 0.0], [0.0, 1.0]]
    """

    mean: Vector
    cov: Matrix


class Judged(NamedTuple):
    """Verdict of a gate on a measurement of n components.

    Attributes:
        far: Which components (n,) are refused: no ordinary correction uses them.
        moved: Which of these (n,) show a velocity with which the estimate has to restart.
        restart: Whether the estimate has to restart from this measurement, because of `moved` or because too many
            samples were refused in a row.
        anew: Which components (n,) a restart takes from this measurement. Missing ones, and outliers of joints that
            are no reason to restart, stay as predicted. Without a restart, the components that are used.
        velocity: Velocity of a restart: shown by readings where possible, otherwise predicted.
        memory: Memory of the gate after the verdict.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import StepCode, models, observers
        >>> from covariant.observers.base import GateMemory, Sample, Velocity
        >>> sample = Sample(jnp.array([40.0]), jnp.eye(1), jnp.eye(1), jnp.ones(1, bool))
        >>> memory, rest = GateMemory.at_start(jnp.zeros(1)), Velocity(jnp.zeros(1), jnp.eye(1))
        >>> verdict = observers.Gate().judge(models.oscillator().manifold, sample, memory, rest)
        >>> StepCode(verdict.result(jnp.asarray(0)).item()).name
        'OUTLIER'
    """

    far: Bool[Array, "n"]
    moved: Bool[Array, "n"]
    restart: Flag
    anew: Bool[Array, "n"]
    velocity: Velocity
    memory: GateMemory

    def result(self, otherwise: Code) -> Code:
        """Result code of the step.

        Args:
            otherwise: Code of the step without the gate.

        Returns:
            `RESTARTED`, `OUTLIER` or `OK` by what the gate did, or `otherwise` if that is worse.
        """
        code = jnp.where(self.restart, int(StepCode.RESTARTED), jnp.where(jnp.any(self.far), int(StepCode.OUTLIER), 0))
        return jnp.maximum(code, otherwise)
