"""What takes long of `test_spaces.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_spaces import close, derived, form

from covariant import geometry
from covariant.geometry import Budget, Metric
from covariant.geometry._functions import norm
from covariant.geometry._spaces import _NEAR, ConstantCurvature


@pytest.mark.exhaustive("plane, curved chart", "sphere x hyperbolic")
def test_log_is_that_of_the_matrix(closed, derived):
    """The derived geodesic with the closed form's velocity arrives, modulo the periods of a torus."""
    shot = closed.shoot(closed.p, closed.q)
    end = derived.fly(closed.p, shot.velocity, np.stack([closed.velocity, closed.x], 1))
    close(closed.shoot(end.q, closed.q).velocity, np.zeros_like(closed.p))
    close(end.velocity, shot.arrival)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["sphere", "hyperbolic"])
def test_shooting_finds_the_closed_log(spaces, name):
    closed, derived = spaces[name], spaces[f"numeric {name}"]
    mine, theirs = (space.shoot(derived.p, derived.q) for space in (closed, derived))
    close(theirs.velocity, mine.velocity)
    close(theirs.arrival, mine.arrival)


def lift(k, q):
    """The chart's point on the quadric `K(|X|² ± X₀²) = 1`, X₀ first, in units of the radius."""
    square = k * (q @ q)
    return jnp.concatenate([(1 - square)[None], 2 * jnp.sqrt(abs(k)) * q]) / (1 + square)


def lower(k, point):
    return point[1:] / (1 + point[0]) / jnp.sqrt(abs(k))


def quadric_exp(k, p, v):
    point, velocity = jax.jvp(lambda q: lift(k, q), (p,), (v,))
    length = jnp.sqrt(form(k, velocity, velocity))
    cos, sin = (jnp.cos, jnp.sin) if k > 0 else (jnp.cosh, jnp.sinh)
    return lower(k, cos(length) * point + sin(length) / length * velocity)


def quadric_log(k, p, q):
    a, b = lift(k, p), lift(k, q)
    across = b - np.sign(k) * form(k, a, b) * a
    sin = jnp.sqrt(form(k, across, across))
    length = jnp.arctan2(sin, form(k, a, b)) if k > 0 else jnp.arcsinh(sin)
    return jax.jvp(lambda point: lower(k, point), (a,), (length / sin * across,))[1]


SEAM = 2 * np.sqrt(_NEAR)
"""Length, in radii, at which the closed forms pass from a series to the functions themselves."""


LENGTHS = SEAM * np.array([0.5, 1 - 1e-3, 1 - 1e-9, 1 + 1e-9, 1 + 1e-3, 2.0])


FAR = np.array([0.5, 2.0, 3.0])


CURVATURES = [(1.0, 2), (-1.0, 3), (4.0, 3), (-0.25, 2)]


def flights(k, n, lengths):
    """A base point of order one in the chart, and velocities of each length in radii."""
    p, direction = jnp.array([[0.3, -0.4, 0.2], [0.6, 0.7, -0.5]])[:, :n] / np.sqrt(abs(k))
    unit = direction / norm(ConstantCurvature(k), p, direction) / np.sqrt(abs(k))
    return p, jnp.asarray(lengths)[:, None] * unit[None]


def compare(mine, theirs, p, others, tolerance):
    def both(other):
        return mine(p, other), theirs(p, other)

    jax.tree.map(lambda a, b: close(a, b, tolerance), *jax.jit(jax.vmap(both))(others))


@pytest.mark.exhaustive
@pytest.mark.parametrize(("k", "n"), CURVATURES)
def test_exp_is_that_of_the_quadric_on_both_sides_of_the_seam(k, n):
    """Value and Jacobian; the series leaves out terms of 1e-16 and 1e-11 of them."""

    def mine(p, v):
        return geometry.exp(ConstantCurvature(k), p, v)

    def theirs(p, v):
        return quadric_exp(k, p, v)

    compare(mine, theirs, *flights(k, n, LENGTHS), 1e-15)
    compare(mine, theirs, *flights(k, n, FAR), 1e-13)
    compare(jax.jacfwd(mine, (0, 1)), jax.jacfwd(theirs, (0, 1)), *flights(k, n, LENGTHS), 1e-11)


@pytest.mark.exhaustive
@pytest.mark.parametrize(("k", "n"), CURVATURES)
def test_log_is_that_of_the_quadric_on_both_sides_of_the_seam(k, n):
    """Value and Jacobian; the quadric's own rounding, relative to the length 6e-3 of the seam, is 1e-14 and 1e-10."""

    def mine(p, q):
        return geometry.log(ConstantCurvature(k), p, q)

    def theirs(p, q):
        return quadric_log(k, p, q)

    p, velocities = flights(k, n, np.concatenate([LENGTHS, FAR]))
    q = jax.vmap(lambda v: quadric_exp(k, p, v))(velocities)
    compare(mine, theirs, p, q[: len(LENGTHS)], 3e-15)
    compare(mine, theirs, p, q[len(LENGTHS) :], 1e-13)
    compare(jax.jacrev(mine, (0, 1)), jax.jacfwd(theirs, (0, 1)), p, q[: len(LENGTHS)], 1e-10)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    "turn", [0.5, pytest.param(1.0, marks=pytest.mark.xfail(reason="transport by halves is 0/0 after a whole turn"))]
)
def test_geodesic_goes_on_round_the_sphere(turn):
    """Through the antipode, back to the start and beyond, where no shortest geodesic follows."""
    sphere, derived, w = geometry.sphere(), Metric(geometry.sphere()), jnp.array([[0.7, 0.2, -0.5]])
    p, direction = jnp.array([[0.3, -0.4, 0.2], [0.6, 0.8, -0.5]])
    unit = direction / norm(sphere, p, direction)

    @jax.jit
    @jax.vmap
    def both(length):
        mine = geometry.transport_along(sphere, p, length * unit, w)
        return mine, geometry.transport_along(derived, p, length * unit, w, Budget(steps=100))

    past = np.array([-1.0, -1e-3, -1e-6, -1e-9, 0.0, 1e-9, 1e-6, 1e-3, 1.0])
    for mine, theirs in zip(*both(2 * np.pi * turn + past), strict=True):
        close(mine, theirs)


@pytest.mark.exhaustive
@pytest.mark.parametrize("length", [10.0, 20.0])
def test_exp_and_log_near_the_edge_of_the_ball(length):
    """The chart resolves the distance to the edge, `e^-length`, to 1e-16."""
    plane, p, direction = geometry.hyperbolic(), jnp.array([0.1, 0.2]), jnp.array([0.6, 0.8])
    velocity = length * direction / norm(plane, p, direction)
    there = geometry.log(plane, p, geometry.exp(plane, p, velocity))
    close(there, velocity, 1e-15 * np.exp(length))


@pytest.mark.exhaustive
def test_product_is_its_parts(spaces):
    whole, parts = spaces["sphere x hyperbolic"], (geometry.sphere(), geometry.hyperbolic())
    p, q = whole.p, whole.q
    for i, part in enumerate(parts):
        mine = slice(2 * i, 2 * i + 2)
        log = jax.vmap(lambda p, q, part=part: geometry.log(part, p, q))(p[:, mine], q[:, mine])
        close(whole.shoot(p, q).velocity[:, mine], log, 1e-15)
