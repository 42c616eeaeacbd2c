"""The controller of a craft: its error equations, its Lyapunov function, and what it is asked to follow."""

import jax.numpy as jnp
import numpy as np
import pytest

from covariant.certificates import feedthrough, tracking
from covariant.models import marine
from covariant.simulation import Backstepping, follow, lissajous


def test_damping_compensated_at_the_wanted_velocity_still_takes_energy():
    """(95) and (96): D(ν)ν − D(ν_r)ν_r = D̄s with sᵀD̄s ≥ 0, and 0 only where both are at rest."""
    craft = marine.odin()
    random = np.random.default_rng(2)
    for nu, nu_r in random.normal(size=(100, 2, 6)):
        difference = craft.damping(jnp.asarray(nu)) @ nu - craft.damping(jnp.asarray(nu_r)) @ nu_r
        assert (nu - nu_r) @ difference > 0


def test_theorem_3_refuses_a_quaternion():
    controller = Backstepping(marine.odin(quaternion=True), lissajous(np.zeros(7), 0.1, 0.1), 1.0, 1.0, 1.0)
    for build in (tracking, feedthrough):
        with pytest.raises(ValueError, match="as many coordinates as velocities"):
            build(controller)


def test_follow_differentiates_the_path():
    path = follow(lambda t: jnp.stack([t**3, jnp.sin(2 * t)]))
    at = path(jnp.asarray(0.5))
    np.testing.assert_allclose(at.velocity, [0.75, 2 * np.cos(1.0)], rtol=1e-12)
    np.testing.assert_allclose(at.acceleration, [3.0, -4 * np.sin(1.0)], rtol=1e-12)


BAD = {
    "kp": ({"kp": -1.0, "kd": 1.0, "lam": 1.0}, "kp must be symmetric positive definite"),
    "kd shape": ({"kp": 1.0, "kd": np.ones((2, 3)), "lam": 1.0}, "kd must be a number, 6 numbers or a matrix"),
    "lam not symmetric": ({"kp": 1.0, "kd": 1.0, "lam": np.triu(np.ones((6, 6)))}, "lam must be symmetric"),
}


@pytest.mark.exhaustive("lam not symmetric")
@pytest.mark.parametrize("case", BAD)
def test_bad_gains_are_refused(case):
    gains, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        Backstepping(marine.odin(), lissajous(np.zeros(6), 1.0, 0.1), **gains)
