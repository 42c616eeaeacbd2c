"""Coulomb friction that turns over a distance, as a state of a filter: Dahl's law.

At a reversal the force of Coulomb friction does not jump. The contact is a spring at first, and the force F turns over
the presliding displacement δ = F_c/σ₀, for the stiffness σ₀ of the contact. Dahl's law `F' = σ₀ r (1 − F sgn(r)/F_c)`,
for the rate r of the joint, is the same as `F' = (|r|/δ) (F_c sgn(r) − F)`: per distance, the force relaxes to sliding
friction. With noise it is a Gauss–Markov process over the distance, which `gauss_markov` solves for a constant rate.

Source: Dahl 1968, A solid friction model, Aerospace Corporation TOR-0158(3107-18)-1; Canudas de Wit, Olsson, Åström &
Lischinsky 1995, A new model for control of systems with friction, IEEE TAC 40(3).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from covariant._functional import Functional
from covariant._typing import Numbers, Vector
from covariant.models import MechanicalSystem, Parametric, input_count, resistance
from covariant.observers.base import as_numbers
from covariant.observers.sensors._slow import SlowVariables
from scalargraph.errors import InputError

COULOMB = ("coulomb", "friction")
"""Names of the parameters of a dissipation that are levels of Coulomb friction, to which it is proportional."""
FAST = 1e6
"""Speed [rad/s or m/s] at which the smoothed sign of every model has its limit."""
LEVEL_ERROR = 0.1
"""Standard deviation of the friction of a sliding joint, relative to its Coulomb friction."""


class DahlLaw(Functional):
    """Sliding friction (k,) of joints, and the rates (k,) at which their friction turns to it.

    Attributes:
        axes: Rates (k, n) of the joints per unit of each velocity.
        displacement: Presliding displacements (k,).
        levels: The levels of Coulomb friction in the model's dissipation, whose other parts are None.
        gain: Sliding friction (k,) [N m or N] per unit of the level.
        places: Position of the level of each joint among all levels.
    """

    axes: Float[Array, "k n"]
    displacement: Float[Array, "k"]
    levels: Any
    gain: Float[Array, "k"]
    places: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, v: Vector) -> tuple[Vector, Vector]:
        rates, levels = self.axes.astype(v.dtype) @ v, ravel_pytree(self.levels)[0]
        sliding = (self.gain * levels[np.array(self.places)]).astype(v.dtype)
        # Not `sign` and `abs`: at rest the slope in the velocity must be that of a spring.
        way = jnp.where(rates < 0, -1.0, 1.0).astype(v.dtype)
        return way * sliding, way * rates / self.displacement.astype(v.dtype)

    def without(self, model: MechanicalSystem) -> MechanicalSystem:
        """The model without the Coulomb friction of these joints."""
        _, levels, changed = _levels(model)
        return changed(levels.at[np.array(self.places)].set(0.0))


def presliding_friction(model: MechanicalSystem, displacement: Numbers) -> SlowVariables:
    """Friction force of each joint with Coulomb friction, which turns over a distance at a reversal: Dahl's law.

    In the filter it replaces the Coulomb friction of the model, which jumps at zero speed. Use it where velocities at
    reversals matter and the friction is fitted. The joints must have their own level, and each the same axis at all
    configurations. A joint whose displacement is zero keeps the friction of the model.

    Args:
        model: The model, in whose dissipation the levels are parameters called `coulomb` or `friction`.
        displacement: Distance δ [rad or m] over which the force turns: one number, or one for each velocity (n,).

    Returns:
        A group with a state for each of these joints, the force against its motion [N m or N].

    Raises:
        ValueError: A displacement is not finite and ≥ 0, or no joint with a displacement has Coulomb friction.

    Example:
        >>> from covariant import models, observers
        >>> arm = models.pendulum_chain(coulomb=(0.0, 0.2))
        >>> observers.presliding_friction(arm, 1e-3).names
        ('friction2',)
    """
    q = model.manifold.origin()
    n = len(model.manifold.zero(q))
    distances = as_numbers("presliding_friction", "displacement", displacement, n, 0.0)
    stored, levels, changed = _levels(model)
    t, u, v = jnp.zeros(()), jnp.zeros(input_count(model, n)), FAST * (1 + np.arange(n) / np.pi)

    def slopes(q: Array, v: np.ndarray) -> np.ndarray:
        return np.asarray(jax.jacfwd(lambda each: resistance(changed(each), t, q, jnp.asarray(v), u))(levels)).T

    force, other = slopes(q, v), slopes(model.manifold.retract(q, jnp.ones(n)), v * (-1.0) ** np.arange(n))
    gain, last = np.abs(force).max(axis=1, initial=0.0), [int(np.flatnonzero(f)[-1]) if f.any() else 0 for f in force]
    at = np.flatnonzero((np.asarray(levels) > 0) & (gain > 0) & (distances[last] > 0))
    if not at.size:
        raise InputError("presliding_friction: no coordinate with a displacement has Coulomb friction; fit it first")
    if not np.allclose(np.abs(force[at]), np.abs(other[at]), rtol=1e-6):
        raise InputError("presliding_friction: each level of Coulomb friction must be that of one fixed axis")
    axes = -force[at] / gain[at, None]
    sliding, turns = jnp.asarray(gain[at]), jnp.asarray(distances[last][at])
    law = DahlLaw(jnp.asarray(axes), turns, stored, sliding, tuple(at.tolist()))
    cov = jnp.diag(jnp.square(law.gain * levels[at]))
    names, against = tuple(f"friction{i + 1}" for i in at), Parametric(_against, axes=axes)
    return SlowVariables(names, jnp.zeros(len(at)), cov, LEVEL_ERROR**2 * cov, force=against, law=law)


def _against(q, v, s, axes):
    # By virtual work axesᵀ converts the forces of the joints.
    return -axes.T @ s


def _levels(model: MechanicalSystem) -> tuple[Any, Vector, Callable[[Vector], MechanicalSystem]]:
    """The levels of Coulomb friction of a model, as stored and as a vector, and the model with other levels."""

    def is_level(path: Any, leaf: Any) -> bool:
        return bool(path) and getattr(path[-1], "key", None) in COULOMB and eqx.is_inexact_array(leaf)

    stored, rest = eqx.partition(model.dissipation, jax.tree_util.tree_map_with_path(is_level, model.dissipation))
    levels, whole = ravel_pytree(stored)
    return stored, levels, lambda each: eqx.tree_at(lambda m: m.dissipation, model, eqx.combine(whole(each), rest))
