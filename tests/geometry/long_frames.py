"""What takes long of `test_frames.py`."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_frames import MIXED, ROBOTS, SPACES, at, bent, both, close, energy, sample, uneven

from covariant.geometry import AbstractManifold, Budget, Metric, derivative, lie
from covariant.observers import second_order
from covariant.signals import StepCode

BUDGET = Budget(steps=12)


SOUGHT = ("uneven, SO(3), by its energy", "uneven, SE(2) x coordinates", "coordinates", "robot, joints")
"""Where geodesics are searched for: by what is the same on every space, and takes long to compile on the others."""


@pytest.mark.exhaustive("uneven, SE(2) x coordinates")
def test_the_velocity_of_a_curve_is_that_of_its_array(at):
    y, rate = jax.jvp(lambda s: at.manifold.retract(at.x, s), (at.a,), (at.b,))
    close(at.manifold.frame_velocity(at.x, at.a, at.b), at.manifold.components(y, rate))
    close(at.manifold.local_rate(at.x, at.a, at.manifold.frame_velocity(at.x, at.a, at.b)), at.b)


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


@pytest.mark.exhaustive(*ROBOTS, "uneven, SE(2) x coordinates")
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


@pytest.mark.exhaustive(*ROBOTS, "uneven, SE(2) x coordinates", "uneven, SO(3), by its energy")
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
