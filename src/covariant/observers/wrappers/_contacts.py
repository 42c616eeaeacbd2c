"""Wraps observers of machines with feet, for touch-downs and lift-offs at known times.

While feet stay in place, the configurations form a leaf of the whole space. At a touch-down the velocity normal to the
leaf is lost: `v⁺ = P v⁻`. Let ξ and ζ be the errors of position and velocity in a parallel frame, measured on the leaf
after the event, and n the velocity that is lost. Then

    touch-down  ξ⁺ = P ξ,  ζ⁺ = P ζ + S_n P ξ
    lift-off    ξ⁺ = ξ,    ζ⁺ = ζ + II(ξ, v)

with the second fundamental form II of the leaf, `Leaf.second_form`, and `<S_n a, b> = <II(a, b), n>`. The estimate
makes the same jump as the motion, and the covariance of a filter is transformed by its derivative.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from covariant._typing import Number, Scalar
from covariant.models import MechanicalSystem, Motion, contacts, standing
from covariant.observers.base import AbstractMechanicalObserver, AbstractWrapper, LastInput, check_whole, no_input
from covariant.observers.filters import IntrinsicKalman, apart, parallel
from covariant.observers.wrappers._gated import without_last_input
from scalargraph.errors import InputError


class ContactsState(NamedTuple):
    """State of a `Contacts` observer.

    Attributes:
        inner: State of the inner observer.
        down: Which feet are on the ground (k,).
        spots: Where they landed (k, d) [m]; for feet in the air, their present positions.
        last_input: The last finite input (m,), with the contacts in its last entries.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> observer = observers.Contacts(observers.Intrinsic(models.hopping_leg(), 30.0, 400.0))
        >>> state = observer.init(jnp.array([0.0, 0.6, 0.0, 0.0]))
        >>> state.down.tolist(), state.spots.tolist()
        ([False], [[0.0, 0.0]])
    """

    inner: Any
    down: Bool[Array, "k"]
    spots: Float[Array, "k d"]
    last_input: LastInput = None


class Contacts(AbstractWrapper):
    """An observer of a machine with feet, for touch-downs and lift-offs that the input announces.

    The last inputs of a model with `feet` are their contacts. If the contacts of a step differ from those of the
    previous step, the estimate first makes the jump of the motion: where feet land, their velocity relative to the
    ground is lost in a plastic impact. While feet stand, they are fixed where they were last measured. Without this, an
    observer would have a velocity error as large as the lost velocity, for about three time constants after each
    landing.

    Contacts are treated as known, and feet as points that do not slip. A contact that is known late causes an error
    that grows with the delay; see the page *A leg that lands*. On the ground some positions suffice, since the feet
    determine the others.

    Attributes:
        observer: An observer with constant gains, or an `IntrinsicKalman`, of a model with `feet`.

    Raises:
        ValueError: The model of the observer has no feet, or the observer is another filter, whose covariance does not
            support a leaf.

    Example:
        A mass falls for 0.2 s onto the ground, where it stays:

        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> names = {"coordinates": ("x", "z"), "units": ("m", "m"), "inputs": 1}
        >>> no_force, mass = (lambda t, q, u: jnp.zeros(2)), (lambda q: jnp.eye(2))
        >>> point = models.Lagrangian(mass, lambda q: 9.81 * q[1], no_force, **names, feet=lambda q: q[None])
        >>> t = np.arange(0.0, 0.4, 0.01)
        >>> y = np.stack([0 * t, -4.905 * np.minimum(t, 0.2) ** 2], axis=1)
        >>> observer = observers.Contacts(observers.ModelCopy(point, 10.0, 50.0, substeps=1))
        >>> run = observers.run(observer, Record(t, (t > 0.195)[:, None] * 1.0, y))
        >>> run.estimate[20:23, 3].round(2).tolist()  # m/s, before and after the impact
        [-1.96, 0.0, 0.0]
    """

    observer: Any

    def __check_init__(self):
        check_whole("Contacts", self.observer)
        named = type(self.observer).__name__
        if not isinstance(self.observer, AbstractMechanicalObserver | IntrinsicKalman):
            raise InputError(
                f"Contacts: {named} has no jump at a touch-down; take an observer with constant gains, or an "
                "IntrinsicKalman"
            )
        if self.model.feet is None:
            raise InputError(f"Contacts: the model of {named} has no feet; give it `feet`, the positions of its feet")

    @property
    def model(self) -> MechanicalSystem:
        """The model, with all feet in the air."""
        return self.observer.model

    @property
    def _filters(self) -> bool:
        """Whether the state of the inner observer has a covariance."""
        return isinstance(self.observer, IntrinsicKalman)

    def init(self, y: Array, t: Number = 0.0) -> ContactsState:
        inner = without_last_input(self.observer.init(y, t))
        spots = self._feet(inner.q)
        return ContactsState(inner, jnp.zeros(len(spots), bool), spots, no_input(self.model, inner.v))

    def estimate(self, state: ContactsState) -> Any:
        return self.observer.estimate(state.inner)

    def predict(self, state: ContactsState, u: Float[Array, "m"], dt: Scalar) -> ContactsState:
        landed = state._replace(down=contacts(u, len(state.down)))
        inner = self._jumped(state, landed)
        return landed._replace(inner=self._now(landed).predict(inner, u, dt))

    def correct(self, state: ContactsState, u: Float[Array, "m"], y: Array) -> tuple[ContactsState, Any]:
        inner, info = self._now(state).correct(state.inner, u, y)
        # A filter's estimate is better than one noisy sample, while constant gains may still be far off.
        q = inner.q if self._filters else self.model.manifold.measured(inner.q, self.configuration(y))
        spots = jnp.where(state.down[:, None], state.spots, self._feet(q))
        return state._replace(inner=inner, spots=spots), info

    def innovation(self, state: ContactsState, u: Float[Array, "m"], y: Array) -> Any:
        return self._now(state).innovation(state.inner, u, y)

    def _feet(self, q: Array) -> Float[Array, "k d"]:
        assert self.model.feet is not None
        return self.model.feet(q)

    def _now(self, state: ContactsState) -> Any:
        """The inner observer for the model with the present feet on the ground."""
        return eqx.tree_at(lambda o: o.model, self.observer, standing(self.model, state.down, state.spots))

    def _jumped(self, before: ContactsState, after: ContactsState) -> Any:
        """The state of the inner observer after a change of contacts."""
        leaf, inner = self._now(after).model.space, before.inner
        q, v = leaf.impact(inner.q, inner.v)
        jumped = inner._replace(q=q, v=v)
        if self._filters:
            errors = self._of_errors(self._now(before).model.space, leaf, Motion(inner.q, inner.v))
            jumped = self.observer.with_root(jumped, errors(self.observer.root(inner)))
        changed = jnp.any(before.down != after.down)
        return jax.tree.map(lambda new, old: jnp.where(changed, new, old), jumped, inner)

    def _of_errors(self, before: Any, after: Any, motion: Motion) -> Any:
        """The map of errors (ξ, ζ, slow) in the parallel frames before and after a jump."""
        manifold, n = self.model.manifold, motion.v.shape[0]

        def jump(e):
            q, v = after.impact(manifold.retract(motion.q, e[:n]), motion.v + e[n:])
            return jnp.concatenate([manifold.local(jax.lax.stop_gradient(q), q), v]), (q, v)

        slope, (q, v) = jax.jacfwd(jump, has_aux=True)(jnp.zeros(2 * n, motion.v.dtype))
        matrix = parallel(after, q, v) @ slope @ apart(before, *motion)
        return lambda root: root.at[: 2 * n].set(matrix @ root[: 2 * n])
