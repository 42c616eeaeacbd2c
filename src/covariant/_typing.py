"""Array roles, named once. Leading batch axes come from `jax.vmap`, never from the functions themselves."""

from collections.abc import Callable

from jaxtyping import Array, Bool, Float, Int

Scalar = Float[Array, ""]
Vector = Float[Array, "n"]
Vectors = Float[Array, "*k n"]
Matrix = Float[Array, "n n"]
State = Float[Array, "two_n"]
Number = Scalar | float
Flag = Bool[Array, ""]
Code = Int[Array, ""]

MatrixField = Callable[[Array], Array]
"""A metric written in coordinates: `q (n,) -> (n, n)`, symmetric positive definite."""
