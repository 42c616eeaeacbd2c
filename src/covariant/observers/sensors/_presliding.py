"""Coulomb friction that turns over a distance, as a state of a filter: Dahl's law.

At a reversal the force of Coulomb friction does not jump. The contact is a spring at first, and the force F turns over
the presliding displacement δ = F_c/σ₀, for the stiffness σ₀ of the contact. Dahl's law `F' = σ₀ r (1 − F sgn(r)/F_c)`,
for the rate r of the joint, is the same as `F' = (|r|/δ) (F_c sgn(r) − F)`: per distance, the force relaxes to sliding
friction. With noise it is a Gauss–Markov process over the distance, which `gauss_markov` solves for a constant rate.

Source: Dahl 1968, A solid friction model, Aerospace Corporation TOR-0158(3107-18)-1; Canudas de Wit, Olsson, Åström &
Lischinsky 1995, A new model for control of systems with friction, IEEE TAC 40(3).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
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
        levels: The levels of Coulomb friction in the model's dissipation, as they are stored there.
        gain: Sliding friction (k,) [N m or N] per unit of the level.
        places: Position of the level of each joint among all levels.
    """

    axes: Float[Array, "k n"]
    displacement: Float[Array, "k"]
    levels: tuple[Array, ...]
    gain: Float[Array, "k"]
    places: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, v: Vector) -> tuple[Vector, Vector]:
        rates = self.axes.astype(v.dtype) @ v
        sliding = (self.gain * _joined(self.levels)[np.array(self.places)]).astype(v.dtype)
        backwards = rates < 0
        pace = jnp.where(backwards, -rates, rates) / self.displacement.astype(v.dtype)
        return jnp.where(backwards, -sliding, sliding), pace

    def without(self, model: MechanicalSystem) -> MechanicalSystem:
        """The model without the Coulomb friction of these joints."""
        levels = _levels(model)
        others = np.ones(sum(np.size(level) for level in levels))
        others[list(self.places)] = 0.0
        return _with_levels(model, jnp.asarray(others) * _joined(levels))


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
    levels = _levels(model)
    first = np.asarray(_joined(levels), float)
    t, u, fast = jnp.zeros(()), jnp.zeros(input_count(model, n)), FAST * (1 + np.arange(n) / np.pi)

    def slopes(q: Array, v: np.ndarray) -> np.ndarray:
        return np.asarray(
            jax.jacfwd(lambda each: resistance(_with_levels(model, each), t, q, jnp.asarray(v), u))(jnp.asarray(first))
        ).T

    force, other = slopes(q, fast), slopes(model.manifold.retract(q, jnp.ones(n)), fast * (-1.0) ** np.arange(n))
    gain = np.abs(force).max(axis=1, initial=0.0)
    places = [i for i in np.flatnonzero((first > 0) & (gain > 0)) if distances[np.flatnonzero(force[i])[-1]] > 0]
    if not places:
        raise InputError(
            "presliding_friction: no joint with a displacement has Coulomb friction; fit it, or leave it out"
        )
    if not np.allclose(np.abs(force[places]), np.abs(other[places]), rtol=1e-6):
        raise InputError(
            "presliding_friction: one level of Coulomb friction must be that of one joint with a fixed axis"
        )
    axes = -force[places] / gain[places, None]
    moved = distances[[np.flatnonzero(axis)[-1] for axis in axes]]
    law = DahlLaw(jnp.asarray(axes), jnp.asarray(moved), levels, jnp.asarray(gain[places]), tuple(map(int, places)))
    cov = jnp.diag(jnp.asarray((gain * first)[places] ** 2))
    names = tuple(f"friction{i + 1}" for i in places)
    against = Parametric(_against, axes=axes)
    return SlowVariables(names, jnp.zeros(len(places)), cov, LEVEL_ERROR**2 * cov, force=against, law=law)


def _against(q, v, s, axes):
    # By virtual work axesᵀ converts the forces of the joints.
    return -axes.T @ s


def _levels(model: MechanicalSystem) -> tuple[Array, ...]:
    paths = jax.tree_util.tree_leaves_with_path(model.dissipation)
    return tuple(leaf for path, leaf in paths if _is_level(path, leaf))


def _with_levels(model: MechanicalSystem, levels: Vector) -> MechanicalSystem:
    ends = np.cumsum([np.size(level) for level in _levels(model)])
    parts = iter(jnp.split(levels, ends[:-1].tolist()))

    def changed(path: Any, leaf: Any) -> Any:
        return next(parts).reshape(leaf.shape) if _is_level(path, leaf) else leaf

    dissipation = jax.tree_util.tree_map_with_path(changed, model.dissipation)
    return eqx.tree_at(lambda m: m.dissipation, model, dissipation)


def _joined(levels: tuple[Array, ...]) -> Vector:
    return jnp.concatenate([jnp.zeros(0), *map(jnp.ravel, levels)])


def _is_level(path: Any, leaf: Any) -> bool:
    return bool(path) and getattr(path[-1], "key", None) in COULOMB and eqx.is_inexact_array(leaf)
