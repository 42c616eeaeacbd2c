"""Types of arguments that several modules of the package share."""

from jaxtyping import Array, Float

Matrix = Float[Array, "n n"]
