"""Array types by their role. Leading batch axes come from `jax.vmap`, never from the functions themselves."""

from collections.abc import Callable, Sequence
from typing import Any

from jaxtyping import Array, ArrayLike, Bool, Float, Inexact, Int

Scalar = Float[Array, ""]
Vector = Float[Array, "n"]
Vectors = Float[Array, "*k n"]
Matrix = Float[Array, "n n"]
State = Float[Array, "two_n"]
Number = Scalar | float
Element = Inexact[Array, "N N"]
"""A group element, or a matrix of its Lie algebra."""
Flag = Bool[Array, ""]
Code = Int[Array, ""]

MatrixField = Callable[[Array], Array]
"""A metric written in coordinates: `q (n,) -> (n, n)`, symmetric positive definite."""
StateField = MatrixField | Callable[[Scalar, Array], Array]
"""A metric on states: `x (n,) -> (n, n)`, or `(t, x) -> (n, n)` where it depends on time."""

Bounds = tuple[Float[Array, "n"], Float[Array, "n"]]
"""Lower and upper bounds of coordinates."""
Controller = Callable[[Array, Array, Any], Array]
"""`(t, y, estimate) -> u (m,)`: the input as a function of the measurement and of an observer's estimate."""

Numbers = ArrayLike | Sequence[float] | Sequence[Sequence[float]] | Sequence[Sequence[Sequence[float]]]
"""Types that are accepted for an array of numbers, which is converted at once."""
