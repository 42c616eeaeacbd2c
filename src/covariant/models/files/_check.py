"""Checks the metric of a model numerically, beyond the types and shapes of its functions."""

import numpy as np
from jaxtyping import Float

from covariant.models._mechanical import MechanicalSystem
from scalargraph import evaluate_batch
from scalargraph.errors import InputError


def check_metric(model: MechanicalSystem, points: Float[np.ndarray, "k n"]) -> None:
    """Check that the inertia matrix of a model is symmetric and, if the chart is valid there, positive definite.

    A chart may be singular at some of the points, as polar coordinates are at r = 0. Therefore points at which the
    matrix is singular or not finite are skipped, unless all points are.

    Args:
        model: Mechanical system in coordinates.
        points: Configurations (k, n) at which the matrix is evaluated.

    Raises:
        ValueError: The matrix is asymmetric or indefinite at a point, or singular or not finite at all points.

    Example:
        >>> import numpy as np
        >>> from covariant import models
        >>> models.check_metric(models.ball_and_beam(), np.zeros((1, 2)))
    """
    usable = [_is_usable(g, q) for g, q in zip(evaluate_batch(model.space, points), points, strict=True)]
    if not any(usable):
        raise InputError(
            f"metric is singular or not finite at all {len(points)} points tried, such as q = {_text(points[0])}"
        )


def _is_usable(g: np.ndarray, q: np.ndarray) -> bool:
    """Whether g (n, n) is positive definite at q (n,), well beyond rounding errors."""
    if not np.isfinite(g).all():
        return False
    # By Weyl, entry errors of eps · max move an eigenvalue by at most n times that. Integer matrices have no eps.
    roundoff = len(g) * np.finfo(np.result_type(g, np.float32)).eps * np.abs(g).max()
    asymmetry, smallest = np.abs(g - g.T).max(), np.linalg.eigvalsh((g + g.T) / 2)[0]
    # Entries (i, j) and (j, i) may come from different sums, hence the factor 100.
    if asymmetry > 100 * roundoff or smallest < -roundoff:
        raise InputError(
            f"metric is not symmetric positive definite at q = {_text(q)}: smallest eigenvalue {smallest:.3g}, "
            f"largest asymmetry {asymmetry:.3g}; look at the signs and units of its parameters"
        )
    # Within ±roundoff the sign of the eigenvalue is unknown: the chart may be singular here, which is not a fault.
    return bool(smallest > roundoff)


def _text(q: np.ndarray) -> str:
    return f"({', '.join(f'{x:.3g}' for x in q)})"
