"""Types of arguments."""

from typing import Literal

from jaxtyping import Array, Float

Matrix = Float[Array, "n n"]

Arithmetic = Literal["auto", "numpy", "c"]
"""Implementation of interval arithmetic: compiled C where it pays, or always NumPy, or always C."""
