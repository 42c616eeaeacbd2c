"""Detects 16-bit sign-magnitude words, which serial-bus servos send, that were logged as plain numbers."""

import numpy as np
from jaxtyping import Float

SIGN_BIT = 1 << 15
"""The sign bit of such a word; the other bits are the magnitude."""


def has_sign_bit(values: Float[np.ndarray, "T"]) -> bool:
    """Whether numbers are 16-bit sign-magnitude words that were read as plain numbers.

    When such a word changes sign, the number jumps by half of its range while the magnitude changes little. A word in
    two's complement jumps by the whole range, and a counter that passes this number changes by one; neither counts.

    Args:
        values: Numbers (T,) as logged.

    Example:
        >>> import numpy as np
        >>> from covariant.logs import has_sign_bit
        >>> has_sign_bit(np.array([3.0, 1.0, 32770.0, 32775.0])), has_sign_bit(np.array([3.0, 1.0, 65534.0, 65529.0]))
        (True, False)
    """
    values = values[np.isfinite(values)]
    if len(values) < 2 or values.min() < 0 or not SIGN_BIT <= values.max() < 2 * SIGN_BIT or (values % 1 != 0).any():
        return False
    crossing = np.flatnonzero(np.diff(values >= SIGN_BIT))
    signed = np.where(values >= SIGN_BIT, SIGN_BIT - values, values)
    plain, magnitude = (np.abs(np.diff(each))[crossing] for each in (values, signed))
    return bool(len(crossing)) and bool(np.median(plain) > SIGN_BIT // 2 and np.median(magnitude) < SIGN_BIT // 4)


def sign_bit_fault(name: str) -> str:
    """Message of an error for a column of sign-magnitude words.

    Example:
        >>> from covariant.logs import sign_bit_fault
        >>> sign_bit_fault("present_speed").partition(":")[0]
        "column 'present_speed' holds 16-bit words whose highest bit is a sign, as serial-bus servos send them"
    """
    return (
        f"column {name!r} holds 16-bit words whose highest bit is a sign, as serial-bus servos send them: numbers from "
        f"{SIGN_BIT} on are negative; decode it in the log, as numpy.where(x >= {SIGN_BIT}, {SIGN_BIT} - x, x)"
    )
