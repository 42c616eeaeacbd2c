"""Defines boxes, the domains of proofs: a lower and an upper bound for each named variable."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from scalargraph.errors import InputError


class Box(NamedTuple):
    """Bounds of named variables: the domain of a proof. A variable with equal bounds is fixed.

    A fixed variable is a constant, such as a mass; it appears in the statement and costs no effort. `box` builds a box
    and checks its bounds; the class itself checks nothing. Units are text for readers and have no effect.

    Attributes:
        names: Names of the d variables.
        units: Their units as text; "" for none.
        low: Lower bounds (d,), in these units.
        high: Upper bounds (d,), in these units.

    Example:
        >>> from scalargraph.proofs import box
        >>> domain = box(angle=(-1.0, 1.0, "rad"), speed=(0.0, 2.0, "m/s"))
        >>> domain.names, domain.high.tolist()
        (('angle', 'speed'), [1.0, 2.0])
        >>> print(domain)
        -1 ≤ angle ≤ 1 rad, 0 ≤ speed ≤ 2 m/s
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    low: Float[np.ndarray, "d"]
    high: Float[np.ndarray, "d"]

    @property
    def free(self) -> "Box":
        """The box of the free variables, whose bounds are distinct."""
        indices = np.flatnonzero(self.high > self.low)
        names, units = (tuple(texts[i] for i in indices) for texts in (self.names, self.units))
        return Box(names, units, self.low[indices], self.high[indices])

    def with_fixed(self, values: np.ndarray, names: tuple[str, ...] = ()) -> "Box":
        """The box with k further variables that are fixed at the values given.

        Args:
            values: Values (k,) at which they are fixed.
            names: Their k names; without them these are "". Their units are "".

        Returns:
            The box of all d + k variables, the fixed ones last.
        """
        low, high = (np.concatenate([ends, values]) for ends in (self.low, self.high))
        empty = ("",) * len(values)
        return Box((*self.names, *(names or empty)), (*self.units, *empty), low, high)

    def __str__(self) -> str:
        parts = zip(self.names, self.units, self.low, self.high, strict=True)
        # + 0.0 turns −0.0 into 0.0.
        return ", ".join(
            f"{low + 0.0:.4g} ≤ {name} ≤ {high + 0.0:.4g} {unit}".rstrip() for name, unit, low, high in parts
        )


def box(**bounds: tuple[float, float] | tuple[float, float, str]) -> Box:
    """A box from one keyword for each variable.

    Use it to write a domain by hand. The order of the keywords is the order of the variables z of the matrix. Each free
    variable can multiply the effort of a proof, so fix every variable that need not vary.

    Args:
        **bounds: `name=(low, high)` or `name=(low, high, unit)`, in the order of the variables.

    Returns:
        The box, with checked bounds.

    Raises:
        ValueError: The bounds of a variable are not finite, or the lower one exceeds the upper one; the message names
            it.

    Example:
        >>> from scalargraph.proofs import box
        >>> domain = box(x=(-1.0, 1.0, "m"), mass=(2.0, 2.0))
        >>> domain.low.tolist(), domain.units, domain.free.names
        ([-1.0, 2.0], ('m', ''), ('x',))
    """
    units = tuple(str(b[2]) if len(b) == 3 else "" for b in bounds.values())
    low = np.array([float(b[0]) for b in bounds.values()])
    high = np.array([float(b[1]) for b in bounds.values()])
    return check_box(Box(tuple(bounds), units, low, high))


def check_box(given: Box) -> Box:
    """The box, unchanged, after a check of its bounds.

    Args:
        given: The box to check.

    Returns:
        The same box.

    Raises:
        ValueError: The bounds of a variable are not finite, or the lower one exceeds the upper one; the message names
            it.

    Example:
        >>> import numpy as np
        >>> from scalargraph.proofs import Box, check_box
        >>> check_box(Box(("x",), ("m",), np.array([1.0]), np.array([0.0])))
        Traceback (most recent call last):
        scalargraph.errors.InputError: bounds of x must be finite, the lower one first; got 1 to 0
    """
    for name, low, high in zip(given.names, given.low, given.high, strict=True):
        if not (np.isfinite(low) and np.isfinite(high) and low <= high):
            raise InputError(f"bounds of {name} must be finite, the lower one first; got {low:g} to {high:g}")
    return given
