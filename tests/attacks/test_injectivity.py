"""Errors of half a turn and more: the logarithm jumps there, and nothing may be proved across the jump."""

import numpy as np
import pytest
from systems import ALPHA, BETA, RATE, Q, line, size_of, verdict, wheel

from covariant import models
from covariant.geometry import lie
from covariant.observers import Geodesic, Intrinsic


def damped(xp, x, v):
    return -v


def beyond_half_a_turn(radius: float, error: float) -> np.ndarray:
    """The largest excess over the bound of estimates that begin within the radius, none farther off than the error.

    Position errors obey ξ' = ζ − αξ, ζ' = −βξ − ζ, with ξ wrapped to half a turn: distances are the shortest ones.
    """
    rng = np.random.default_rng(0)
    xi, zeta = rng.uniform(-1, 1, (2, 20_000)) * np.array([[error], [40.0]])
    inside = size_of(xi, zeta) <= radius
    xi, zeta = xi[inside], zeta[inside]

    def distance(xi, zeta):
        turns = 2 * np.pi * np.arange(-2, 3)[:, None]
        return size_of(xi + turns, zeta).min(axis=0)

    first, h, worst = distance(xi, zeta), 1e-3, np.ones(len(xi))
    for k in range(1, 1500):
        off = xi - 2 * np.pi * np.round(xi / (2 * np.pi))
        xi, zeta = xi + h * (zeta - ALPHA * off), zeta + h * (-BETA * off - zeta)
        worst = np.maximum(worst, distance(xi, zeta) / (first * np.exp(-RATE / 2 * k * h)))
    return worst


def test_beyond_half_a_turn_the_bound_is_broken():
    """ξ = 6 rad is a radius of 1.6 and more; within it thousands of estimates break the bound."""
    assert (beyond_half_a_turn(size_of(1.0, 0.0) * 3, 1.0) < 1.02).all()
    worst = beyond_half_a_turn(size_of(6.0, 0.0) * 0.9, 6.0)
    assert (worst > 1.05).sum() > 300


@pytest.mark.parametrize("error", [6.0, 3.2, np.nextafter(np.pi, 4), 100.0])
def test_errors_of_half_a_turn_are_never_proved(error):
    assert verdict(wheel(damped), velocity=1.0, error=error, input=1.0) != "holds"


@pytest.mark.parametrize("error", [np.nextafter(np.pi, 4), 3.2])
def test_errors_of_half_a_turn_are_never_proved_on_a_circle(error):
    observer = line(damped, circles=(0,))
    assert verdict(observer, velocity=1.0, error=error, position=(-3, 3), input=1.0) != "holds"


def on(group, error) -> str:
    n = group.dimension
    model = models.GroupSystem(group, np.eye(n), dissipation=lambda g, v: -v)
    bounds = {"velocity": 0.01, "error": error, "input": 0.01, "rate": RATE, "q": Q}
    if group not in (lie.SO2, lie.SO3):
        bounds["position"] = (-np.ones((group.order,) * 2), np.ones((group.order,) * 2))
    return verdict(Intrinsic(model, ALPHA, BETA), **bounds)


PAIR = lie.Product((lie.SO2, lie.SO2))
CORNERS = {
    "SO3 corner": (lie.SO3, 1.9),
    "SO3 long corner": (lie.SO3, np.array([3.1, 0.2, 0.5])),
    "SO3": (lie.SO3, 3.2),
    "SE2": (lie.SE2, np.array([0.1, 0.1, 3.2])),
    "SE2 all": (lie.SE2, 3.2),
    "SE3 corner": (lie.SE3, np.array([0.1, 0.1, 0.1, 1.9, 1.9, 1.9])),
    "second": (PAIR, np.array([0.1, 3.2])),
    "first": (PAIR, np.array([3.2, 0.1])),
}


@pytest.mark.parametrize(("group", "error"), CORNERS.values(), ids=CORNERS)
def test_corners_beyond_half_a_turn_are_never_proved(group, error):
    """|ω| of (1.9, 1.9, 1.9) is 3.29, though each entry is well below π."""
    assert on(group, error) != "holds"


def test_geodesic_errors_beyond_half_a_turn_are_never_proved():
    model = models.GroupSystem(lie.SO2, np.eye(1), dissipation=lambda g, v: -v)
    observer = Geodesic(model, ALPHA, BETA)
    assert verdict(observer, velocity=1.0, error=4.0, input=1.0) != "holds"


def test_the_exact_observer_across_a_cut_locus_is_never_proved():
    """Half a turn around a cylinder: two geodesics are equally short."""
    inner = line(damped, circles=(0,))
    exact = Geodesic(inner.model, ALPHA, BETA)
    assert verdict(exact, velocity=1.0, error=3.2, position=(-3, 3), input=1.0) != "holds"
