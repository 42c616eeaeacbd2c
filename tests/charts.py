"""Rewrites a mechanical system, or a space, in other coordinates, in which an intrinsic observer must be the same."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._typing import Matrix, Scalar, Vector, Vectors
from covariant.geometry import AbstractManifold, AbstractMetric, Budget
from covariant.geometry._geodesics import Shot, Transported
from covariant.models import Lagrangian, MechanicalSystem, input_count, resistance

Chart = Callable[[Array], Any]
"""`z (n,) -> configuration`, smooth and with a derivative that is invertible."""


def in_chart(
    model: MechanicalSystem, chart: Chart, *, coordinates: Sequence[str] = (), circles: Sequence[int] = ()
) -> Lagrangian:
    """Rewrite a mechanical system on any space, such as SO(3), in coordinates z (n,) of its configuration `chart(z)`.

    Args:
        model: Mechanical system.
        chart: Smooth map `z (n,) -> configuration` with an invertible derivative, for instance `marine.euler_rotation`
            for a body on SO(3); velocities are then the rates of its Euler angles. If the chart is a pytree, such as a
            `Parametric`, its numbers are leaves of the model's pytree.
        coordinates: Names of the entries of z.
        circles: Indices of the entries of z that are angles on a full circle [rad]. A circle of the model has to be
            named here again; otherwise its measurements are not wrapped and must continue over a full turn.

    Returns:
        The same system in coordinates.

    Raises:
        ValueError: The values of the chart are not configurations of the model.
    """

    def part(function: Callable) -> Any:
        return eqx.Partial(function, model, chart)

    n = (
        jax.eval_shape(model.manifold.zero, jax.eval_shape(model.manifold.origin)).shape[0]
        if _has_known_shape(model)
        else None
    )
    return Lagrangian(
        part(eqx.filter_jit(_metric)),  # jit, so that it is traced once, although it is differentiated in many places
        part(_potential),
        part(_force),
        part(_dissipation),
        tuple(circles),
        coordinates=tuple(coordinates),
        inputs=model.inputs if n is None else input_count(model, n),
    )


def chart_velocity(manifold: AbstractManifold, chart: Chart, z: Vector, rate: Vector) -> Vector:
    """Velocity of a motion in chart coordinates.

    Args:
        manifold: Manifold of the configurations.
        chart: Smooth map `z (n,) -> configuration`.
        z: Chart coordinates (n,).
        rate: Their time derivative z' (n,).

    Returns:
        Velocity (n,), in the frame at `chart(z)`.
    """
    x, change = jax.jvp(chart, (z,), (rate,))
    return manifold.components(x, change)


def chart_jacobian(manifold: AbstractManifold, chart: Chart, z: Vector) -> Matrix:
    """Matrix of the linear map `rate ↦ chart_velocity`.

    Args:
        manifold: Manifold of the configurations.
        chart: Smooth map `z (n,) -> configuration`.
        z: Chart coordinates (n,).

    Returns:
        Jacobian (n, n) from the rates of the coordinates to the velocity in the frame at `chart(z)`.
    """
    return jax.vmap(lambda a: chart_velocity(manifold, chart, z, a), out_axes=1)(jnp.eye(z.shape[0], dtype=z.dtype))


def _has_known_shape(model: MechanicalSystem) -> bool:
    return None not in model.manifold.shape


def _metric(model: MechanicalSystem, chart: Chart, z: Vector) -> Matrix:
    jacobian = chart_jacobian(model.manifold, chart, z)
    # v = J z' does not change the kinetic energy, so the matrix in the chart is JᵀG J.
    return jacobian.T @ model.space(chart(z)) @ jacobian


def _potential(model: MechanicalSystem, chart: Chart, z: Vector) -> Scalar:
    return model.potential(chart(z))


def _force(model: MechanicalSystem, chart: Chart, t: Scalar, z: Vector, u: Float[Array, "m"]) -> Vector:
    # The transpose pulls covectors back: the power of the force is the same in both coordinates.
    return chart_jacobian(model.manifold, chart, z).T @ model.force(t, chart(z), u)


def _dissipation(
    model: MechanicalSystem, chart: Chart, t: Scalar, z: Vector, rate: Vector, u: Float[Array, "m"]
) -> Vector:
    jacobian = chart_jacobian(model.manifold, chart, z)
    return jacobian.T @ resistance(model, t, chart(z), jacobian @ rate, u)


class Pullback(AbstractMetric):
    """A space in other coordinates, with the operations of the original one.

    `forward` maps the new coordinates to those of `space`, and `inverse` back.
    """

    space: AbstractMetric
    forward: Callable[[Array], Array]
    inverse: Callable[[Array], Array]

    def __call__(self, x: Vector) -> Matrix:
        jacobian = jax.jacfwd(self.forward)(x)
        return jacobian.T @ self.space(self.forward(x)) @ jacobian

    def connection(self, x: Vector, a: Vector, b: Vector) -> Vector:
        """Covariant derivative `Γ̄(a, b) = Dφ⁻¹ [Γ(Dφ a, Dφ b) + D²φ(a, b)]`, φ being `forward`.

        Args:
            x: new coordinates (n,).
            a: direction (n,).
            b: components (n,) of the differentiated field.

        Returns:
            Vector (n,).
        """
        old, along_a, along_b = self.forward(x), self._pushforward(x, a), self._pushforward(x, b)
        second = jax.jvp(lambda p: self._pushforward(p, b), (x,), (a,))[1]
        return self._pulled_back(old, self.space.connection(old, along_a, along_b) + second)

    def curvature(self, x: Vector, a: Vector, b: Vector, c: Vector) -> Vector:
        old = self.forward(x)
        turned = self.space.curvature(old, self._pushforward(x, a), self._pushforward(x, b), self._pushforward(x, c))
        return self._pulled_back(old, turned)

    def transport_along(self, p: Vector, velocity: Vector, w: Vectors, budget: Budget = Budget()) -> Transported:
        pushed = jax.vmap(lambda a: self._pushforward(p, a))(w.reshape(-1, p.shape[0]))
        end = self.space.transport_along(self.forward(p), self._pushforward(p, velocity), pushed, budget)
        pulled = jax.vmap(lambda a: self._pulled_back(end.q, a))(end.w)
        return Transported(self.inverse(end.q), self._pulled_back(end.q, end.velocity), pulled.reshape(w.shape))

    def shoot(self, p: Vector, q: Vector, guess: Vector | None = None, budget: Budget = Budget()) -> Shot:
        old_p, old_q = self.forward(p), self.forward(q)
        shot = self.space.shoot(old_p, old_q, None if guess is None else self._pushforward(p, guess), budget)
        return shot._replace(
            velocity=self._pulled_back(old_p, shot.velocity), arrival=self._pulled_back(old_q, shot.arrival)
        )

    def _pushforward(self, q: Vector, x: Vector) -> Vector:
        return jax.jvp(self.forward, (q,), (x,))[1]

    def _pulled_back(self, old: Vector, x: Vector) -> Vector:
        return jax.jvp(self.inverse, (old,), (x,))[1]
