"""Systems on groups: their equations against Lagrange's in coordinates, what they conserve, the integrator's order."""

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.geometry.lie import SO3
from covariant.models import GroupSystem, friction, source

SYSTEMS = {
    "top": models.heavy_top(),
    "asymmetric top": models.heavy_top((1.0, 2.0, 3.5), 2.0, axis=(0.3, 0.2, 1.0), viscous=0.1),
    "free body": models.free_body(),
    "satellite": models.satellite(bearing=1e-5),
    "underwater vehicle": models.underwater_vehicle(),
    "hovercraft": models.hovercraft(),
}


def state_of(system, seed=1):
    random = np.random.default_rng(seed)
    n = system.group.dimension
    return system.group.exp(jnp.array(0.8 * random.normal(size=n))), jnp.array(random.normal(size=n))


def test_source_and_friction_are_raised_forces():
    system = SYSTEMS["asymmetric top"]
    g, v = state_of(system)
    arm = 2.0 * np.array([0.3, 0.2, 1.0]) / np.linalg.norm([0.3, 0.2, 1.0])
    torque = np.cross(np.asarray(g)[2], arm)  # mgl RᵀP₃ × axis, equation (32)
    inertia = np.array([1.0, 2.0, 3.5])
    np.testing.assert_allclose(source(system, jnp.zeros(()), g, jnp.zeros(3)), torque / inertia, atol=1e-14)
    np.testing.assert_allclose(friction(system, jnp.zeros(()), g, v, jnp.zeros(3)), -0.1 * v / inertia, atol=1e-14)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"inertia": np.eye(2)}, r"inertia: the group needs a matrix \(3, 3\); got \(2, 2\)"),
        ({"inertia": np.diag([1.0, 1.0, -1.0])}, "positive definite; its least eigenvalue is -1"),
        (
            {"potential": lambda g: g},
            r"potential must return shape \(\) for configurations .* of 3 dimensions; it returned \(3, 3\)",
        ),
        (
            {"force": lambda t, g, u: u[:1]},
            r"force must return shape \(3,\) for configurations .* of 3 dimensions; it returned \(1,\)",
        ),
        ({"dissipation": lambda g, v: g @ v[:2]}, "dissipation cannot be evaluated with configurations"),
        ({"velocities": ("a", "b")}, "the group has 3 velocities; got 2 names"),
        ({"inputs": 2}, r"force must return shape \(3,\) for configurations .* of 3 dimensions; it returned \(2,\)"),
    ],
)
def test_what_is_wrong_with_a_system_is_named(arguments, words):
    with pytest.raises(ValueError, match=words):
        GroupSystem(SO3, **{"inertia": np.eye(3)} | arguments)
