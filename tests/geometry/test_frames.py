"""Spaces in a frame that no coordinates have: where the arguments of a connection do not commute, and a metric varies.

The laws are those of every space; what they are held against is derivatives along the frame, not another formula.
"""

from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import geometry, models
from covariant.geometry import Coordinates, KineticEnergy, Metric, ProductManifold, lie


def uneven(n):
    """A metric that changes with every entry of the configuration."""
    rng = np.random.default_rng(7)
    weights = jnp.asarray(0.15 * rng.normal(size=(n, n, 40)))

    def matrix(x):
        flat = x.ravel()
        factor = jnp.eye(n) + weights[:, :, : flat.shape[0]] @ jnp.sin(flat)
        return factor.T @ factor

    return matrix


def energy(matrix):
    """The kinetic energy that goes with the matrix of a metric."""
    return lambda x, v: v @ matrix(x) @ v / 2


MIXED = ProductManifold((lie.SE2, Coordinates((0,), 2)))
STILL = {f"{leg}_{joint}": 0.3 for leg in ("FL", "FR", "HL", "HR") for joint in ("HAA", "HFE", "KFE")}
"""Joints of the quadruped that are locked: all but two of one leg."""
del STILL["FL_HFE"], STILL["FL_KFE"]
SPACES = {
    "uneven, SO(3), by its energy": lambda: KineticEnergy(energy(uneven(3)), manifold=lie.SO3),
    "uneven, SE(2) x coordinates": lambda: Metric(uneven(5), manifold=MIXED),
    "coordinates": lambda: models.ball_and_beam().space,
    "robot, joints": lambda: models.robots.load("scara").space,
    "robot, planar base": lambda: models.robots.load("biped", lock={"left_knee": 0.4, "right_knee": 0.7}).space,
    "robot, SE(3) x joints": lambda: models.robots.load("quadruped", lock=STILL).space,
    "robot, ball joint x joints": lambda: models.robots.load(Path(__file__).parents[1] / "models/ball_arm.xml").space,
}
ROBOTS = tuple(name for name in SPACES if name.startswith("robot"))


class Sample(NamedTuple):
    """A space, a configuration, and three vectors there."""

    space: geometry.AbstractSpace
    manifold: geometry.AbstractManifold
    x: jax.Array
    a: jax.Array
    b: jax.Array
    c: jax.Array


@cache
def sample(name) -> Sample:
    space = SPACES[name]()
    manifold = space.manifold
    n = manifold.zero(manifold.origin()).shape[0]
    s, *vectors = 0.5 * np.random.default_rng(1).normal(size=(4, n))
    return Sample(space, manifold, manifold.retract(manifold.origin(), jnp.asarray(s)), *map(jnp.asarray, vectors))


MANIFOLDS = tuple(SPACES)[:4]
"""Whose manifolds are not those of the others."""


@pytest.fixture(params=MANIFOLDS)
def at(request) -> Sample:
    return sample(request.param)


def close(found: Any, expected: Any, tolerance: float = 1e-11):
    scale = max(1.0, np.abs(np.asarray(expected)).max())
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * scale)


# Manifolds


@pytest.mark.exhaustive("uneven, SE(2) x coordinates", "uneven, SO(3), by its energy")
def test_the_retraction_starts_along_the_frame(at):
    slope = jax.jvp(lambda t: at.manifold.retract(at.x, t * at.a), (jnp.zeros(()),), (jnp.ones(()),))[1]
    close(slope, at.manifold.tangent(at.x, at.a))
    close(at.manifold.components(at.x, slope), at.a)


@pytest.mark.exhaustive("uneven, SE(2) x coordinates", "uneven, SO(3), by its energy")
def test_local_undoes_the_retraction(at):
    close(at.manifold.local(at.x, at.manifold.retract(at.x, at.a)), at.a)


@pytest.mark.core(1)
@pytest.mark.exhaustive("uneven, SE(2) x coordinates")
def test_the_bracket_is_that_of_the_frames_fields(at):
    def along(one, two):
        return jax.jvp(lambda y: at.manifold.tangent(y, two), (at.x,), (at.manifold.tangent(at.x, one),))[1]

    close(at.manifold.bracket(at.x, at.a, at.b), at.manifold.components(at.x, along(at.a, at.b) - along(at.b, at.a)))


@pytest.mark.parametrize(
    ("manifold", "y", "word"),
    [
        (Coordinates(dimension=2), np.zeros(3), r"\(2\); got \(3,\)"),
        (Coordinates(), np.zeros((3, 1)), r"\(n\); got \(3, 1\)"),
        (lie.SO3, np.zeros(4), r"\(3, 3\); got \(4,\)"),
        (MIXED, np.zeros((4, 4)), r"\(11\); got \(4, 4\)"),
    ],
)
def test_what_is_no_configuration_is_named(manifold, y, word):
    with pytest.raises(ValueError, match=word):
        manifold.checked(jnp.asarray(y))


def test_a_product_needs_to_know_its_factors():
    with pytest.raises(ValueError, match="dimension"):
        ProductManifold((lie.SO3, Coordinates()))
    with pytest.raises(ValueError, match="at least one"):
        ProductManifold(())


# Metrics


@pytest.fixture(scope="module")
def bent():
    """Connection and curvature of the samples, compiled once."""

    @cache
    def operations(name):
        space = sample(name).space
        return eqx.filter_jit(space.connection), eqx.filter_jit(space.curvature)

    return operations


@pytest.fixture(params=SPACES)
def both(request, bent):
    return sample(request.param), *bent(request.param)


@pytest.mark.core(1)
@pytest.mark.exhaustive(*ROBOTS, "uneven, SE(2) x coordinates")
def test_lowering_is_symmetric_and_raising_undoes_it(both):
    at, _, _ = both

    @jax.jit
    def operations(x, a):
        lowered = at.space.lower(x, a)
        return at.space(x), lowered, at.space.raise_(x, lowered)

    g, lowered, raised = operations(at.x, at.a)
    close(g, np.asarray(g).T)
    assert np.linalg.eigvalsh(g).min() > 0
    close(lowered, g @ at.a)
    close(raised, at.a)


def test_an_energy_is_the_metric_of_its_matrix():
    at = sample("uneven, SO(3), by its energy")
    close(at.space(at.x), uneven(3)(at.x))


@pytest.mark.exhaustive(*ROBOTS, "uneven, SE(2) x coordinates")
def test_the_connection_has_the_frames_torsion(both):
    at, b, _ = both
    close(b(at.x, at.a, at.b) - b(at.x, at.b, at.a), at.manifold.bracket(at.x, at.a, at.b))


# A retraction that bends: of no group's exponential
