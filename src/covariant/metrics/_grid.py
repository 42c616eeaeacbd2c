"""Defines grids of states, and divides them into the blocks in which they are computed."""

import math
import operator
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, SupportsFloat, SupportsIndex

import numpy as np
from jaxtyping import Float

from scalargraph.errors import InputError


@dataclass(frozen=True)
class Grid:
    """A box of n axes with equally spaced points, both ends included.

    Use it for the states at which a metric is tabulated, for example by `verbs.design_metric`. The number of points is
    the product of all counts, so it grows fast with the number of axes. Names are those of the states, in the same
    order.

    Attributes:
        names: name of each axis, an identifier; all different.
        units: unit of each axis.
        low: lower end of each axis, in its unit.
        high: upper end of each axis, above `low`, in its unit.
        counts: number of points along each axis, two at least.

    Raises:
        ValueError: an attribute is wrong; the message is one line that names the axis.

    Example:
        >>> from covariant.metrics import Grid
        >>> grid = Grid(("angle", "rate"), ("rad", "rad/s"), low=(-3.0, -5.0), high=(3.0, 5.0), counts=(7, 11))
        >>> grid.shape, grid.size, grid.axes[0].tolist()
        ((7, 11), 77, [-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0])
    """

    names: Sequence[str]
    units: Sequence[str]
    low: Sequence[SupportsFloat]
    high: Sequence[SupportsFloat]
    counts: Sequence[SupportsIndex]

    def __post_init__(self):
        if not len(self.names) == len(self.units) == len(self.low) == len(self.high) == len(self.counts) > 0:
            raise InputError(
                "a grid needs a name, a unit, a low and a high end and a count for each axis; got "
                f"{[len(part) for part in (self.names, self.units, self.low, self.high, self.counts)]} of them"
            )
        for name, low, high, count in zip(self.names, *self.ends, self.counts, strict=True):
            if not name.isidentifier():
                raise InputError(f"axis {name!r}: use a name of letters, digits and _")
            if list(self.names).count(name) > 1:
                raise InputError(f"axis {name!r}: two axes have this name")
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise InputError(f"axis {name!r}: low must be below high, both finite; got {low} and {high}")
            if not isinstance(count, SupportsIndex) or operator.index(count) < 2:
                raise InputError(f"axis {name!r}: the count must be a whole number, 2 or more; got {count}")

    @property
    def axes(self) -> tuple[Float[np.ndarray, " count"], ...]:
        """Coordinates of the points along each axis, an array (count,) each."""
        return tuple(np.linspace(low, high, n) for low, high, n in zip(*self.ends, self.shape, strict=True))

    @property
    def ends(self) -> tuple[list[float], list[float]]:
        """Lower ends and upper ends, as Python floats."""
        return [float(end) for end in self.low], [float(end) for end in self.high]

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of points along each axis."""
        return tuple(map(operator.index, self.counts))

    @property
    def size(self) -> int:
        """Number of points of the grid."""
        return math.prod(self.shape)


class Blocks(NamedTuple):
    """A grid cut into boxes of equal sides, which are also the chunks of the store; the last
    ones may extend beyond the grid.

    Attributes:
        axes: coordinates of the grid's points along each axis.
        sides: number of points of a block along each axis.

    Example:
        >>> from covariant.metrics import Grid
        >>> from covariant.metrics._grid import cut
        >>> blocks = cut(Grid(("x",), ("m",), low=(0.0,), high=(1.0,), counts=(10,)), points=4)
        >>> blocks.counts, blocks.region((2,))
        ((3,), (slice(8, 10, None),))
    """

    axes: tuple[np.ndarray, ...]
    sides: tuple[int, ...]

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of blocks along each axis."""
        return tuple(-(-len(axis) // side) for axis, side in zip(self.axes, self.sides, strict=True))

    def indices(self) -> Iterator[tuple[int, ...]]:
        """Iterator over the indices of the blocks."""
        return np.ndindex(*self.counts)

    def region(self, index: tuple[int, ...]) -> tuple[slice, ...]:
        """Slices of the grid that the block of an index covers."""
        parts = zip(index, self.sides, self.axes, strict=True)
        return tuple(slice(k * side, min((k + 1) * side, len(axis))) for k, side, axis in parts)

    def size(self, index: tuple[int, ...]) -> int:
        """Number of grid points in the block of an index."""
        return math.prod(part.stop - part.start for part in self.region(index))

    def points(self, index: tuple[int, ...]) -> Float[np.ndarray, "points n"]:
        """Coordinates of the points of a block; beyond the end of an axis its last point is repeated."""
        parts = zip(index, self.sides, self.axes, strict=True)
        lines = [axis[np.minimum(k * side + np.arange(side), len(axis) - 1)] for k, side, axis in parts]
        return np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, len(lines))


def cut(grid: Grid, points: int) -> Blocks:
    """Divide a grid into blocks that are as close to cubes as the counts allow."""
    if points < 1:
        raise InputError(f"a block needs at least one point; got {points}")
    sides, remaining, shape = [1] * len(grid.shape), points, grid.shape
    for k, axis in enumerate(sorted(range(len(shape)), key=shape.__getitem__)):
        # The small number compensates rounding: 4096 ** (1 / 3) is less than 16 in doubles.
        side = min(shape[axis], int(remaining ** (1 / (len(shape) - k)) + 1e-9))
        sides[axis] = math.ceil(shape[axis] / math.ceil(shape[axis] / side))  # no thin blocks at the edge
        remaining //= sides[axis]
    return Blocks(grid.axes, tuple(sides))
