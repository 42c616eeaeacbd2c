"""Types of arguments that several modules of the package share."""

from typing import Literal

from jaxtyping import Array, Float

Matrix = Float[Array, "n n"]

Arithmetic = Literal["auto", "numpy", "c"]
"""Implementation of interval arithmetic: NumPy, compiled C, or "auto" for C as soon as compiling it saves time."""
