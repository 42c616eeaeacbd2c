"""Samples the conditioning and the curvature of a mechanical system's metric over a box."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._linalg import half_solve
from covariant.geometry import sectional_curvature
from covariant.models._mechanical import MechanicalSystem
from scalargraph import evaluate_batch
from scalargraph.errors import InputError


class Survey(NamedTuple):
    """Conditioning and curvature of a mechanical system's metric at sampled configurations; nothing is proved.

    Attributes:
        conditioning: Smallest and largest ratio (2,) of the largest to the smallest eigenvalue of the inertia matrix.
        curvature: Smallest and largest sectional curvature (2,) of random planes [1/(kg m²)], with directions
            distributed uniformly in the metric; None for a single dimension.
        samples: Number of configurations, and of planes.

    Example:
        >>> from covariant.models._survey import Survey
        >>> Survey(conditioning=(1.0, 4.0), curvature=None, samples=10).samples
        10
    """

    conditioning: tuple[float, float]
    curvature: tuple[float, float] | None
    samples: int


def survey(
    model: MechanicalSystem, box: Float[np.ndarray, "k 2"] | None = None, samples: int = 200, seed: int = 0
) -> Survey:
    """Sample conditioning and curvature of the metric of a model at random configurations.

    Args:
        model: Mechanical system.
        box: Bounds (k, 2) of the k coordinates [their units]; ±π by default. Other factors of the configuration space,
            such as ball joints, get random positions.
        samples: Number of configurations, and of planes.
        seed: Seed of the random numbers.

    Returns:
        Ranges of the conditioning and of the curvature.

    Raises:
        ValueError: The box does not fit the coordinates.

    Example:
        >>> from covariant import models
        >>> result = models.survey(models.ball_and_beam(), samples=20)
        >>> result.curvature[1] < 0  # Gaussian curvature −1/(1 + r²)² in the normalised form
        True
    """
    count = len(model.coordinates)
    box = np.tile([-np.pi, np.pi], (count, 1)) if box is None else np.asarray(box, float)
    if box.shape != (count, 2) or not np.isfinite(box).all():
        raise InputError(f"the box must be {count} pairs of finite numbers; got shape {box.shape}")
    rng = np.random.default_rng(seed)
    origin = model.manifold.origin()
    n = model.manifold.zero(origin).shape[0]
    steps = np.zeros((samples, n))
    steps[:, n - count :] = rng.uniform(box[:, 0], box[:, 1], (samples, count))
    planes = rng.normal(size=(samples, 2, n))
    # The mean length of a normal vector (3,) is about 1.6 standard deviations: rotations of 2.5 rad on average.
    steps[:, : n - count] = rng.normal(size=(samples, n - count), scale=np.pi / 2)

    def at_configuration(s, w):
        return _at_configuration(model, model.manifold.retract(origin, s), w)

    matrices, curvatures = evaluate_batch(at_configuration, steps, planes)
    eigenvalues = np.full((samples, n), np.nan)
    finite = np.isfinite(matrices).all((1, 2))  # LAPACK fails for matrices that are not finite
    eigenvalues[finite] = np.linalg.eigvalsh(matrices[finite])
    ratios = eigenvalues[:, -1] / eigenvalues[:, 0]
    return Survey(
        (float(ratios.min()), float(ratios.max())),
        (float(curvatures.min()), float(curvatures.max())) if n > 1 else None,
        samples,
    )


def _at_configuration(
    model: MechanicalSystem, x: Array, w: Float[Array, "2 n"]
) -> tuple[Float[Array, "n n"], Float[Array, ""]]:
    """The metric, and the sectional curvature of a plane; the plane is random if w is."""
    matrix = model.space(x)
    n = matrix.shape[0]
    # For a normal w, L⁻ᵀ w is distributed uniformly over the directions of the metric L Lᵀ.
    a, b = w @ half_solve(matrix, jnp.eye(n, dtype=matrix.dtype))
    return matrix, sectional_curvature(model.space, x, a, b) if n > 1 else jnp.zeros(())
