"""`covariant model`: what is in a robot's file and in its metric: what takes long."""

import jax.numpy as jnp
import pytest
from commands import command, leave

from covariant import geometry
from covariant.models import robots


@pytest.mark.exhaustive
def test_a_robot_is_shown_with_its_tree_and_its_geometry():
    shown = command("model", "double_pendulum", "--samples", "50")
    assert (shown["robot"], shown["coordinates"]) == ("double_pendulum", ["shoulder", "elbow"])
    assert shown["mass"] == pytest.approx(1.0)
    assert [joint["child"] for joint in shown["joints"]] == ["upper", "lower"]
    assert shown["used"]["joint/dynamics"] == 2
    low, high = shown["curvature"]
    space = robots.load("double_pendulum").space
    q, a, b = jnp.array([0.4, 1.0]), jnp.array([1.0, 0.3]), jnp.array([-0.2, 1.0])
    assert low <= float(geometry.sectional_curvature(space, q, a, b)) <= high  # in the plane there is but one plane
    assert 1 < shown["conditioning"][0] < shown["conditioning"][1]


@pytest.mark.exhaustive
def test_the_tree_is_drawn():
    code, printed, _ = leave("model", "double_pendulum", "--samples", "1")
    assert code == 0
    assert "    shoulder (continuous) -> upper, 0.6 kg\n      elbow (continuous) -> lower, 0.4 kg" in printed
