"""A mechanical system rewritten in other coordinates."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._typing import Matrix, Scalar, Vector
from covariant.geometry import AbstractManifold
from covariant.models._mechanical import Lagrangian, MechanicalSystem, input_count, resistance

Chart = Callable[[Array], Any]
"""`z (n,) -> configuration`, smooth and with a derivative that is invertible."""


def in_chart(
    model: MechanicalSystem, chart: Chart, *, coordinates: Sequence[str] = (), circles: Sequence[int] = ()
) -> Lagrangian:
    """The system in coordinates z (n,), its configuration being `chart(z)`; from any space, such as SO(3).

    - `chart`: for instance `marine.euler_rotation` for a body on SO(3), whose velocities then are the rates of its
      Euler angles. Numbers in the chart are leaves of the model's pytree where the chart itself is a pytree, such as a
      `Parametric`.
    - `coordinates`, `circles`: as for `Lagrangian`. A circle of the model is none of the chart unless named here: its
      measurements are then taken as they are, and must go on over a full turn.

    Raises `ValueError` when the values of the chart are no configurations of the model.
    """

    def part(function: Callable) -> Any:
        return eqx.Partial(function, model, chart)

    n = jax.eval_shape(model.manifold.zero, jax.eval_shape(model.manifold.origin)).shape[0] if _known(model) else None
    return Lagrangian(
        part(eqx.filter_jit(_metric)),  # differentiated and batched in many places: each way traces it only once
        part(_potential),
        part(_force),
        part(_dissipation),
        tuple(circles),
        coordinates=tuple(coordinates),
        inputs=model.inputs if n is None else input_count(model, n),
    )


def chart_velocity(manifold: AbstractManifold, chart: Chart, z: Vector, rate: Vector) -> Vector:
    """The velocity (n,), in the frame at `chart(z)`, of a motion with `z' = rate`."""
    x, change = jax.jvp(chart, (z,), (rate,))
    return manifold.components(x, change)


def chart_jacobian(manifold: AbstractManifold, chart: Chart, z: Vector) -> Matrix:
    """Matrix (n, n) of the linear map `rate ↦ chart_velocity`."""
    return jax.vmap(lambda a: chart_velocity(manifold, chart, z, a), out_axes=1)(jnp.eye(z.shape[0], dtype=z.dtype))


def _known(model: MechanicalSystem) -> bool:
    return None not in model.manifold.shape


def _metric(model: MechanicalSystem, chart: Chart, z: Vector) -> Matrix:
    jacobian = chart_jacobian(model.manifold, chart, z)
    return jacobian.T @ model.space(chart(z)) @ jacobian


def _potential(model: MechanicalSystem, chart: Chart, z: Vector) -> Scalar:
    return model.potential(chart(z))


def _force(model: MechanicalSystem, chart: Chart, t: Scalar, z: Vector, u: Float[Array, "m"]) -> Vector:
    return chart_jacobian(model.manifold, chart, z).T @ model.force(t, chart(z), u)


def _dissipation(
    model: MechanicalSystem, chart: Chart, t: Scalar, z: Vector, rate: Vector, u: Float[Array, "m"]
) -> Vector:
    jacobian = chart_jacobian(model.manifold, chart, z)
    return jacobian.T @ resistance(model, t, chart(z), jacobian @ rate, u)
