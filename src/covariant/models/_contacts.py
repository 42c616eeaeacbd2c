"""Models machines whose feet touch the ground: while feet stay in place, configurations are a leaf of the whole space.

One leaf serves all sets of feet, since the rows of feet in the air are zero; so the program needs no branches.

Source: Kozlov & Treshchev 1991, Billiards, for impacts as projections; Lötstedt 1984 for plastic impacts.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from covariant.geometry import Leaf
from covariant.models._mechanical import MechanicalSystem

ON_THE_GROUND = 0.5
"""Value of a contact input above which the foot counts as being on the ground."""


def contacts(u: Float[Array, "*T m"], count: int) -> Bool[Array, "*T k"]:
    """Which feet are on the ground, from the last inputs.

    Args:
        u: Inputs (..., m).
        count: Number k of feet.

    Returns:
        True for the feet on the ground (..., k).

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> models.contacts(jnp.array([3.5, 1.0, 0.0]), 2).tolist()
        [True, False]
    """
    return u[..., u.shape[-1] - count :] > ON_THE_GROUND


def standing(model: MechanicalSystem, down: Bool[Array, "k"], spots: Float[Array, "k d"]) -> MechanicalSystem:
    """The model while some of its feet stay in place.

    Args:
        model: A model with `feet`.
        down: Which feet are on the ground (k,).
        spots: Positions (k, d) of these feet [m]; the entries of the others are not used.

    Returns:
        The model on a `Leaf`. With all feet in the air it moves like the original model.

    Example:
        A leg of which the foot is held turns about it, and its body rises by no more than that allows:

        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> leg = models.hopping_leg()
        >>> q = jnp.array([0.0, 0.5, 0.5, -1.0])
        >>> held = models.standing(leg, jnp.array([True]), leg.feet(q))
        >>> v = held.space.projected(q, jnp.array([0.0, 1.0, 0.0, 0.0]))
        >>> bool(v[1] < 1), bool(abs(held.space.constraint(q)).max() < 1e-15)
        (True, True)
    """
    assert model.feet is not None
    # The assembly is not needed here, since a foot can land in one way only.
    constraint, assembly = eqx.Partial(_slipped, model.feet, down, spots), model.manifold.origin(spots.dtype)
    held = jnp.repeat(down, spots.shape[1])
    leaf = Leaf(model.space, constraint, assembly, held)
    return eqx.tree_at(lambda m: m.space, model, leaf)


def _slipped(
    feet: Callable[[Array], Array], down: Bool[Array, "k"], spots: Float[Array, "k d"], q: Array
) -> Float[Array, "k_d"]:
    """Displacements of the feet on the ground from their spots; 0 for feet in the air, so that their rows are zero."""
    return jnp.where(down[:, None], feet(q) - spots, 0.0).ravel()
