"""Elementary functions of intervals, without trust in a library of them."""

from collections.abc import Callable
from typing import Any

import numpy as np


def _between(low: float, high: float) -> Callable:
    def bounds(a: Any, b: Any) -> tuple[Any, Any]:
        nothing = (a + b) * 0
        return nothing + low, nothing + high

    return bounds


UNKNOWN = ["tan", "asin", "acos", "sinh", "cosh", "asinh", "acosh", "atanh", "log", "log1p", "cbrt"]
ELEMENTARY: dict[str, Callable] = {
    "sin": _between(-1.0, 1.0),
    "cos": _between(-1.0, 1.0),
    "tanh": _between(-1.0, 1.0),
    "exp": _between(0.0, np.inf),
    "expm1": _between(-1.0, np.inf),
    "atan": _between(-1.58, 1.58),
    **{op: _between(np.nan, np.nan) for op in UNKNOWN},
}
"""Bounds of each function from the bounds of its argument."""
