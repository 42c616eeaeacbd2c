"""What takes long of `test_left_invariant.py`."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_left_invariant import GROUPS, SAMPLES, close, inertias, make_space, space, together

from covariant import geometry
from covariant.geometry import lie
from covariant.geometry._geodesics import Transported
from covariant.signals import StepCode


def koszul(space):
    """`2<∇_i e_j, e_k> = <[e_i, e_j], e_k> − <[e_j, e_k], e_i> + <[e_k, e_i], e_j>` of left-invariant fields."""
    lower = np.einsum("ijm,smk->sijk", space.constants, space.inertia)
    lower = (lower - lower.transpose(0, 3, 1, 2) + lower.transpose(0, 2, 3, 1)) / 2
    return np.einsum("sijm,smk->sijk", lower, np.linalg.inv(space.inertia))


@pytest.mark.exhaustive("SE2", "SE3", "SU3")
def test_connection_is_koszuls(space):
    expected = np.einsum("sijk,si,sj->sk", koszul(space), space.x, space.y)
    close(space.b(space.x, space.y), expected)


@pytest.mark.exhaustive("SE2", "SE3", "SU3")
def test_curvature_is_its_definition(space):
    b, c = koszul(space), space.constants
    r = np.einsum("sjkm,siml->sijkl", b, b)
    r = r - r.swapaxes(1, 2) - np.einsum("ijm,smkl->sijkl", c, b)
    close(space.r(space.x, space.y, space.z), np.einsum("sijkl,si,sj,sk->sl", r, space.x, space.y, space.z))


@pytest.mark.exhaustive("SE2", "SU3")
def test_a_connection_is_its_force_raised(space):
    force = together(space.group, lie.LeftInvariant.connection_force)(space.inertia, space.x, space.y)
    close(np.einsum("kij,kj->ki", np.linalg.inv(space.inertia), force), space.b(space.x, space.y), 1e-12)


BATCH = 64


class Flights(NamedTuple):
    """Unit-time geodesics from the identity, with their velocities and two vectors carried along."""

    group: lie.AbstractGroup
    inertia: np.ndarray
    velocity: np.ndarray
    w: np.ndarray
    end: Transported


@pytest.fixture(scope="module")
def fly():
    return {name: together(GROUPS[name], lie.LeftInvariant.transport_along) for name in ("SO3", "SE3")}


@pytest.fixture(scope="module")
def shoot():
    return together(lie.SO3, lie.LeftInvariant.shoot)


def make_flights(fly, name):
    group, rng = GROUPS[name], np.random.default_rng(4)
    n = group.dimension
    inertia = np.resize(inertias(rng, n), (BATCH, n, n))
    velocity, *w = rng.normal(size=(3, BATCH, n))
    velocity *= (np.linspace(0, 0.8, BATCH) / np.linalg.norm(velocity, axis=1))[:, None]
    w = np.stack([velocity, *w], axis=1)
    return Flights(group, inertia, velocity, w, fly[name](inertia, velocity, w))


@pytest.fixture(scope="module", params=["SO3", "SE3"])
def flights(request, fly) -> Flights:
    return make_flights(fly, request.param)


@pytest.mark.exhaustive("SE3")
def test_momentum_in_space_is_conserved(flights):
    body = np.einsum("kij,kj->ki", flights.inertia, flights.end.velocity)
    space = jax.vmap(lambda g, mu: flights.group.coadjoint_action(flights.group.inverse(g), mu))(flights.end.q, body)
    close(space, np.einsum("kij,kj->ki", flights.inertia, flights.velocity), 1e-10)


def test_transport_is_an_isometry_and_carries_the_velocity_along(flights):
    """So that energy is conserved, too."""
    end, start = (np.einsum("kai,kij,kbj->kab", w, flights.inertia, w) for w in (flights.end.w, flights.w))
    close(end, start, 1e-10)
    close(flights.end.w[:, 0], flights.end.velocity, 1e-10)


@pytest.mark.exhaustive
def test_shooting_undoes_exp(fly, shoot):
    flights = make_flights(fly, "SO3")
    shot = shoot(flights.inertia, flights.end.q)
    assert (shot.result == StepCode.OK).all()
    close(shot.velocity, flights.velocity, 1e-9)
    close(shot.arrival, flights.end.velocity, 1e-9)


@pytest.mark.exhaustive
def test_se3_with_one_mass_is_a_product(fly, shoot):
    """With I = diag(M, M, M, I_b) positions and attitudes go their own ways: the logarithm at the identity of (R, b) is
    (b, that of SO(3)), and the gradient of half the squared distance, the arrival, is (Rᵀb, that of SO(3))."""
    rng = np.random.default_rng(5)
    body = np.resize(inertias(rng, 3), (BATCH, 3, 3))
    inertia = np.zeros((BATCH, 6, 6))
    inertia[:, :3, :3], inertia[:, 3:, 3:] = 2.5 * np.eye(3), body
    omega, b = rng.normal(size=(2, BATCH, 3))
    omega *= (np.linspace(0, 1, BATCH) / np.linalg.norm(omega, axis=1))[:, None]
    turn = np.asarray(jax.vmap(lie.SO3.exp)(omega))
    part = shoot(body, turn)
    log = np.concatenate([b, part.velocity], axis=1)
    end = fly["SE3"](inertia, log, np.stack([log] * 3, axis=1))
    close(end.q[:, :3, :3], turn, 1e-9)
    close(end.q[:, :3, 3], b, 1e-9)
    close(end.velocity, np.concatenate([np.einsum("kji,kj->ki", turn, b), part.arrival], axis=1), 1e-9)


@pytest.mark.exhaustive
def test_float32_stays_float32():
    vector, matrix = (jax.ShapeDtypeStruct(shape, np.float32) for shape in ((3,), (3, 3)))

    def everything(inertia, x):
        metric, here = lie.LeftInvariant(lie.SO3, inertia), jnp.eye(3, dtype=x.dtype)
        along = metric.transport_along(here, x, x[None])
        pointwise = metric.connection(here, x, x), metric.curvature(here, x, x, x), metric.norm(here, x)
        return pointwise, along, metric.shoot(here, along.q)[:3], metric(here), metric.kinetic_force(here, x)

    assert {a.dtype for a in jax.tree.leaves(jax.eval_shape(everything, matrix, vector))} == {np.dtype(np.float32)}
