"""The geometry of a mechanical system in numbers: the conditioning of its metric, and its curvature, over a box."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._linalg import half_solve
from covariant.geometry import sectional_curvature
from covariant.models._mechanical import MechanicalSystem


class Survey(NamedTuple):
    """What samples of configurations say of the metric of a mechanical system; nothing is proved.

    - `conditioning` (2,): smallest and largest ratio of the largest to the smallest eigenvalue of the inertia matrix.
    - `curvature` (2,): smallest and largest sectional curvature of random planes [1/(kg m²)], all directions alike
      in the metric; None where there is one dimension only.
    - `samples`: number of configurations, and of planes.
    """

    conditioning: tuple[float, float]
    curvature: tuple[float, float] | None
    samples: int


def survey(
    model: MechanicalSystem, box: Float[np.ndarray, "k 2"] | None = None, samples: int = 200, seed: int = 0
) -> Survey:
    """Survey the metric of a model at random configurations.

    - `box` (k, 2): bounds of the coordinates; by default ±π. All else, such as ball joints, is turned and moved at
      random.

    Raises `ValueError` for a box that does not fit the coordinates.
    """
    count = len(model.coordinates)
    box = np.tile([-np.pi, np.pi], (count, 1)) if box is None else np.asarray(box, float)
    if box.shape != (count, 2) or not np.isfinite(box).all():
        raise ValueError(f"the box must be {count} pairs of finite numbers; got shape {box.shape}")
    rng = np.random.default_rng(seed)
    origin = model.manifold.origin()
    n = model.manifold.zero(origin).shape[0]
    steps = np.zeros((samples, n))
    steps[:, n - count :] = rng.uniform(box[:, 0], box[:, 1], (samples, count))
    planes = rng.normal(size=(samples, 2, n))
    steps[:, : n - count] = rng.normal(size=(samples, n - count), scale=np.pi / 2)
    each = jax.vmap(lambda s, w: _at(model, model.manifold.retract(origin, s), w))
    eigenvalues, curvature = jax.jit(each)(steps, planes)
    ratios = np.asarray(eigenvalues[:, -1] / eigenvalues[:, 0])
    bent = np.asarray(curvature)
    return Survey(
        (float(ratios.min()), float(ratios.max())), (float(bent.min()), float(bent.max())) if n > 1 else None, samples
    )


def _at(model: MechanicalSystem, x: Array, w: Float[Array, "2 n"]) -> tuple[Float[Array, "n"], Float[Array, ""]]:
    """Eigenvalues of the metric, and the curvature of a plane that is random if w is."""
    matrix = model.space(x)
    n = matrix.shape[0]
    # L⁻ᵀ w is equally likely in all directions of the metric L Lᵀ.
    a, b = w @ half_solve(matrix, jnp.eye(n, dtype=matrix.dtype))
    return jnp.linalg.eigvalsh(matrix), sectional_curvature(model.space, x, a, b) if n > 1 else jnp.zeros(())
