"""Sentences on the parameters that a log does not determine."""

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.identification._fit import Fit

SHOWN = 0.03
"""Weights of a combination below this fraction of the largest are not shown."""
MOVED = 0.01
"""Relative change from its first value by which a parameter counts as changed."""
ALIKE = 0.05
"""An exponent that is this close, relatively, to a whole number or a half is rounded to it."""


def relations(fit: Fit) -> tuple[str, ...]:
    """Sentences on the combinations of parameters that the log does not determine.

    Args:
        fit: The result of a fit.

    Returns:
        One sentence for each row of `fit.undetermined`, with the weights.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import Fit, relations
        >>> first, row = np.array([1.0, 2.0]), np.array([[1.0, -1.0]])
        >>> print(*relations(Fit(("mass", "length"), first, first, np.full(2, np.nan), row, np.array([1e-3]), 10.0, 5)))
        only the product mass · length is determined: mass and length cannot be told apart
    """
    changed = np.abs(fit.values - fit.first) > MOVED * np.abs(fit.first)
    return tuple(_sentence(fit.names, row, changed) for row in fit.undetermined)


def _sentence(names: tuple[str, ...], row: Float[np.ndarray, "p"], changed: Bool[np.ndarray, "p"]) -> str:
    row = row / row[np.argmax(np.abs(row))]
    parts = [(name, weight) for name, weight in zip(names, row, strict=True) if abs(weight) > SHOWN]
    parts.sort(key=lambda part: -abs(part[1]))
    if len(parts) == 1 and changed[names.index(parts[0][0])]:
        return f"{parts[0][0]} cannot be told from zero by this log; leave it out, or log a motion that shows it"
    if len(parts) == 1:
        return f"{parts[0][0]} cannot be told from this log; it keeps its first value"
    if len(parts) == 2:
        (first, _), (second, weight) = parts
        # A change e^s of the first goes with e^(s·weight) of the second, so that 1 + power · weight must vanish.
        power = -1 / weight  # the invariant is first · second^power
        expression = f"{first} · {_power(second, power)}" if power > 0 else f"{first} / {_power(second, -power)}"
        what = "product" if power > 0 else "ratio"
        return f"only the {what} {expression} is determined: {first} and {second} cannot be told apart"
    changes = ", ".join(f"{name} by {weight:+.2g} %" for name, weight in parts)
    return f"cannot be told apart: changing {changes} together changes nothing that this log shows"


def _power(name: str, power: float) -> str:
    whole = round(2 * power) / 2
    power = whole if abs(power - whole) < ALIKE * max(whole, 0.5) else power
    return name if power == 1 else f"{name}^{power:.3g}"
