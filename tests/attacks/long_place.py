"""What takes long of `test_place.py`."""

import jax.numpy as jnp
import pytest
from systems import verdict, wheel


@pytest.mark.parametrize(
    "force",
    [
        lambda t, g, u: u + 3 * g[1, :1],
        lambda t, g, u: u + 3 * jnp.sin(5 * t) * g[0, :1],
        lambda t, g, u: u * (1 + g[0, 0]),
    ],
    ids=["place", "time", "effect of the input"],
)
def test_forces_may_depend_on_place_and_time(force):
    """Truth and estimate get the same force, that of the measured place."""
    assert verdict(wheel(lambda xp, g, v: -v, force), velocity=1.0, error=0.3, input=1.0, times=(0.0, 3.0)) == "holds"


def test_potentials_may_depend_on_place():
    observer = wheel(lambda xp, g, v: -v, potential=lambda g: 40 * g[0, 0] ** 3)
    assert verdict(observer, velocity=1.0, error=0.3, input=1.0) == "holds"


@pytest.mark.exhaustive
def test_friction_without_the_place_is_proved():
    for law in (lambda xp, g, v: -v, lambda xp, g, v: -2 * v * xp.abs(v), lambda xp, g, v: -v + 0 * g[0, 0]):
        assert verdict(wheel(law), velocity=1.0, error=0.3, input=1.0) == "holds"
