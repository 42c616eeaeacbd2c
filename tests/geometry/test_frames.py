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
from covariant.geometry import (
    AbstractManifold,
    Budget,
    Coordinates,
    KineticEnergy,
    Metric,
    ProductManifold,
    derivative,
    lie,
)
from covariant.observers import second_order
from covariant.signals import StepCode

BUDGET = Budget(steps=12)


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
    "arm, SE(3) x joints": lambda: models.satellite_arm().space,
    "coordinates": lambda: models.ball_and_beam().space,
    "robot, joints": lambda: models.robots.load("scara").space,
    "robot, planar base": lambda: models.robots.load("biped", lock={"left_knee": 0.4, "right_knee": 0.7}).space,
    "robot, SE(3) x joints": lambda: models.robots.load("quadruped", lock=STILL).space,
    "robot, ball joint x joints": lambda: models.robots.load(Path(__file__).parents[1] / "models/ball_arm.xml").space,
}
ROBOTS = tuple(name for name in SPACES if name.startswith("robot"))
SOUGHT = ("uneven, SO(3), by its energy", "uneven, SE(2) x coordinates", "coordinates", "robot, joints")
"""Where geodesics are searched for: by what is the same on every space, and takes long to compile on the others."""


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


@pytest.mark.exhaustive("arm, SE(3) x joints", "uneven, SE(2) x coordinates", "uneven, SO(3), by its energy")
def test_the_retraction_starts_along_the_frame(at):
    slope = jax.jvp(lambda t: at.manifold.retract(at.x, t * at.a), (jnp.zeros(()),), (jnp.ones(()),))[1]
    close(slope, at.manifold.tangent(at.x, at.a))
    close(at.manifold.components(at.x, slope), at.a)


@pytest.mark.exhaustive("arm, SE(3) x joints", "uneven, SE(2) x coordinates", "uneven, SO(3), by its energy")
def test_local_undoes_the_retraction(at):
    close(at.manifold.local(at.x, at.manifold.retract(at.x, at.a)), at.a)


@pytest.mark.exhaustive("uneven, SE(2) x coordinates")
def test_the_velocity_of_a_curve_is_that_of_its_array(at):
    y, rate = jax.jvp(lambda s: at.manifold.retract(at.x, s), (at.a,), (at.b,))
    close(at.manifold.frame_velocity(at.x, at.a, at.b), at.manifold.components(y, rate))
    close(at.manifold.local_rate(at.x, at.a, at.manifold.frame_velocity(at.x, at.a, at.b)), at.b)


@pytest.mark.exhaustive("uneven, SE(2) x coordinates")
def test_the_bracket_is_that_of_the_frames_fields(at):
    def along(one, two):
        return jax.jvp(lambda y: at.manifold.tangent(y, two), (at.x,), (at.manifold.tangent(at.x, one),))[1]

    close(at.manifold.bracket(at.x, at.a, at.b), at.manifold.components(at.x, along(at.a, at.b) - along(at.b, at.a)))


@pytest.mark.exhaustive("uneven, SE(2) x coordinates")
def test_how_a_retraction_bends_is_the_change_of_its_velocity(at):
    """`Q(a, a)`, by differences of the velocity along `t ↦ retract(x, t a)`."""

    def velocity(t):
        y, rate = jax.jvp(lambda t: at.manifold.retract(at.x, t * at.a), (t,), (jnp.ones(()),))
        return at.manifold.components(y, rate)

    change = (velocity(jnp.asarray(1e-4)) - velocity(jnp.asarray(-1e-4))) / 2e-4
    close(at.manifold.retraction_acceleration(at.x, at.a), change, 1e-7)


@pytest.mark.exhaustive("uneven, SE(2) x coordinates", "uneven, SO(3), by its energy")
def test_a_momentum_that_is_carried_keeps_its_work_on_a_common_motion(at):
    """Of the velocities that a motion of the whole space, seen from both ends, has there."""
    y = at.manifold.retract(at.x, at.a)
    moved = at.manifold.carried_momentum(at.x, at.a, at.b)
    close(at.manifold.carried_momentum(y, -at.a, moved), at.b)
    if at.manifold.commuting:
        close(moved, at.b)


@pytest.mark.exhaustive("0")
@pytest.mark.parametrize("n", [0, 3, 9, 10])
def test_what_is_missing_of_a_product_is_missing_of_its_factor(n):
    """The pose as a whole, a coordinate alone."""
    x = MIXED.retract(MIXED.origin(), jnp.arange(5.0) / 10)
    y = MIXED.retract(x, jnp.array([0.1, -0.2, 0.3, 6.0, 0.4])).at[n].set(jnp.nan)
    gone = np.array([n < 9] * 3 + [n == 9, n == 10])
    np.testing.assert_array_equal(MIXED.missing(y), gone)
    expected = np.where(gone, 0.0, [0.1, -0.2, 0.3, 6.0 - 2 * np.pi, 0.4])
    close(MIXED.towards(x, y), expected, 1e-13)
    close(MIXED.retract(x, jnp.asarray(expected)), MIXED.measured(x, y), 1e-13)


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


@pytest.mark.exhaustive(*ROBOTS, "arm, SE(3) x joints", "uneven, SE(2) x coordinates")
def test_the_connection_has_the_frames_torsion(both):
    at, b, _ = both
    close(b(at.x, at.a, at.b) - b(at.x, at.b, at.a), at.manifold.bracket(at.x, at.a, at.b))


@pytest.mark.exhaustive(*ROBOTS, "arm, SE(3) x joints", "uneven, SE(2) x coordinates")
def test_the_connection_is_metric(both):
    at, b, _ = both

    @jax.jit
    def changes(x, a, one, two, along_one, along_two):
        change = derivative(at.manifold, lambda y: at.space.inner(y, one, two), x, a)
        return change, at.space.inner(x, along_one, two) + at.space.inner(x, one, along_two)

    close(*changes(at.x, at.a, at.b, at.c, b(at.x, at.a, at.b), b(at.x, at.a, at.c)))


@pytest.mark.exhaustive(*ROBOTS, "uneven, SE(2) x coordinates")
def test_free_motion_is_hamels(both):
    """`M B(v, v) = (∂_v M)v − ½∂<v, v> − ad*_v M v`, as the momentum's equation has it."""
    at, b, _ = both

    @jax.jit
    def forces(x, v, bent):
        momentum, change = jax.jvp(lambda y: at.space.lower(y, v), (x,), (at.manifold.tangent(x, v),))
        turned = jax.linear_transpose(lambda w: at.manifold.bracket(x, v, w), v)(momentum)[0]
        return at.space.lower(x, bent), change - at.space.kinetic_force(x, v) - turned

    close(*forces(at.x, at.a, b(at.x, at.a, at.a)))


@pytest.mark.exhaustive(*ROBOTS, "arm, SE(3) x joints", "uneven, SE(2) x coordinates", "uneven, SO(3), by its energy")
def test_the_curvature_is_that_of_the_connection(both):
    """`R(a, b)c = ∇_a∇_b c − ∇_b∇_a c − ∇_[a, b] c` of fields that are constant in the frame."""
    at, _, curvature = both

    @jax.jit
    def commutator(x, one, two, c):
        def twice(one, two):
            change = derivative(at.manifold, lambda y: at.space.connection(y, two, c), x, one)
            return change + at.space.connection(x, one, at.space.connection(x, two, c))

        return twice(one, two) - twice(two, one) - at.space.connection(x, at.manifold.bracket(x, one, two), c)

    close(curvature(at.x, at.a, at.b, at.c), commutator(at.x, at.a, at.b, at.c), 1e-10)


@cache
def carried(name):
    """Two vectors along the geodesic of half the first one: there, and at its end."""
    at = sample(name)
    w = jnp.stack([at.a, at.b])
    return w, jax.jit(lambda x: at.space.transport_along(x, 0.5 * at.a, w, BUDGET))(at.x)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", SPACES)
def test_transport_is_an_isometry(name):
    at, (w, end) = sample(name), carried(name)
    gram = jax.jit(at.space.gram)
    close(gram(end.q, end.w), gram(at.x, w), 1e-9)
    close(end.velocity, 0.5 * end.w[0], 1e-9)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", SOUGHT)
def test_geodesics_are_found_again(name):
    at, (_, end) = sample(name), carried(name)
    shot = jax.jit(lambda x, y: at.space.shoot(x, y, None, Budget(newton=4, steps=12)))(at.x, end.q)
    assert shot.result == StepCode.OK
    close(shot.velocity, 0.5 * at.a, 1e-6)
    close(shot.arrival, end.velocity, 1e-6)


# A retraction that bends: of no group's exponential


class Apart(AbstractManifold):
    """The poses of the plane, whose position goes straight on while they turn: `(R, p) ↦ (R exp(ω), p + Rv)`.

    Its one-parameter curves are no motions of constant twist, so that `Q(a, a) = (−ω × v, 0)`.
    """

    @property
    def shape(self):
        return (3, 3)

    def origin(self, dtype=float):
        return jnp.eye(3, dtype=dtype)

    def zero(self, x):
        return jnp.zeros(3, x.dtype)

    def tangent(self, x, a):
        return lie.SE2.tangent(x, a)

    def components(self, x, rate):
        return lie.SE2.components(x, rate)

    def bracket(self, x, a, b):
        return lie.SE2.bracket(x, a, b)

    def turn(self, s):
        return lie.SO2.exp(s[2:])

    def retract(self, x, s):
        moved = jnp.concatenate([x[:2, :2] @ self.turn(s), (x[:2, 2] + x[:2, :2] @ s[:2])[:, None]], axis=1)
        return jnp.concatenate([moved, x[2:]])

    def local(self, x, y):
        turned = lie.SO2.log(x[:2, :2].T @ y[:2, :2])
        return jnp.concatenate([x[:2, :2].T @ (y[:2, 2] - x[:2, 2]), turned])

    def frame_velocity(self, x, s, rate):
        return jnp.concatenate([self.turn(s).T @ rate[:2], rate[2:]])

    def local_rate(self, x, s, velocity):
        return jnp.concatenate([self.turn(s) @ velocity[:2], velocity[2:]])

    def carried_momentum(self, x, s, mu):
        return lie.SE2.coadjoint_action(lie.SE2.inverse(x) @ self.retract(x, s), mu)

    def missing(self, y):
        return lie.SE2.missing(y)

    def towards(self, x, y):
        return self.local(x, y)

    def measured(self, x, y):
        return y


@pytest.mark.exhaustive
def test_the_error_to_second_order_counts_how_the_retraction_bends():
    """`e − ½(B + Q)(e, e)` approaches −log_q̂ q one order faster than e; without Q it does not."""
    space = Metric(uneven(3), manifold=Apart())
    x, direction = lie.SE2.exp(jnp.array([0.3, -0.2, 0.5])), jnp.array([0.5, -0.7, 0.6])
    v, w = direction[:2], direction[2]
    expected = jnp.stack([w * v[1], -w * v[0], jnp.zeros(())])
    close(space.manifold.retraction_acceleration(x, direction), expected)

    @jax.jit
    def rests(size):
        e = size * direction
        y = space.manifold.retract(x, -e)
        exact = -space.shoot(x, y, None, Budget(newton=6, steps=12)).velocity
        without = e - space.connection(x, e, e) / 2
        return jnp.stack([jnp.linalg.norm(a - exact) for a in (e, without, second_order(space, x, e))])

    sizes = np.geomspace(3e-3, 3e-2, 4)
    found = np.array([rests(jnp.asarray(size)) for size in sizes])
    slopes = [np.polyfit(np.log(sizes), np.log(column), 1)[0] for column in found.T]
    assert slopes == pytest.approx([2.0, 2.0, 3.0], abs=0.1)
