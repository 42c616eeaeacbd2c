"""What takes long of `test_group_tracking.py`: the loop through the observer, and how fast errors provably fall."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from test_group_tracking import connection

from covariant import models
from covariant.certificates import at_corners, contraction
from covariant.certificates.base import ErrorSystem, Point, in_coordinates
from covariant.geometry.lie import SE3, SO3, LeftInvariant
from covariant.models import Motion
from covariant.observers import Intrinsic
from covariant.simulation import GroupTracking, follow, observe, simulate
from scalargraph.proofs import Box


def lengths(a):
    return np.linalg.norm(np.asarray(a), axis=1)


@pytest.mark.exhaustive
def test_pose_and_velocity_errors_come_to_obey_the_linear_law():
    """SE(3), from a metre and two radians off, an observer at rest, and a reference that loops through a pitch of 90°.

    Along a constant twist w its coefficients are constant. The observer's errors are smaller by then, since they decay
    faster.
    """
    body = models.underwater_vehicle(drag=(0.0,) * 6, quadratic_drag=(0.0,) * 6)
    twist = np.array([0.3, 0.0, 0.1, 0.0, 0.6, 0.0])
    kp, kd = np.array([20.0, 20.0, 20.0, 1.0, 1.0, 1.0]), np.array([60.0, 60.0, 60.0, 3.0, 3.0, 3.0])
    c = GroupTracking(body, follow(lambda t: SE3.exp(jnp.asarray(twist) * t)), kp, kd)
    observer, t = Intrinsic(body, 8.0, 20.0), jnp.linspace(0.0, 30.0, 121)
    start = Motion(SE3.exp(jnp.array([0.6, -0.6, 0.5, 1.2, -1.2, 1.0])), jnp.array([0.2, 0.0, 0.0, 0.5, 0.0, -0.5]))
    first = observer.init(start.q @ SE3.exp(jnp.array([0.1, 0.0, -0.1, 0.3, 0.2, -0.2])))
    x, state = observe(body, observer, start, first, t, controller=c, rtol=1e-9, atol=1e-12)
    e, w, _ = jax.vmap(c.reference)(t, x.q)
    pose, velocity, estimate = lengths(e), lengths(x.v - w), lengths(state.v - x.v)
    assert pose[0] > 2
    assert max(pose[-1], velocity[-1]) < 1e-3
    assert estimate[0] > 0.7
    assert estimate[t > 8].max() < 1e-8
    assert np.arcsin(np.abs(x.q[:, 2, 0])).max() > np.radians(80)

    inertia, one = np.asarray(body.space.inertia.matrix), np.eye(6)
    gyric = np.stack([connection(inertia, twist, a) for a in one], axis=1)
    spring, damper = (np.linalg.solve(inertia, np.diag(gain)) for gain in (kp, kd))
    linear = np.block([[0 * one, one], [-spring, -damper - gyric]])
    early, late = 80, 104  # 20 and 26 s
    off = np.concatenate([e, x.v - w], axis=1)
    expected = expm(linear * float(t[late] - t[early])) @ off[early]
    assert np.linalg.norm(off[late] - expected) < 0.01 * np.linalg.norm(expected)


@pytest.mark.exhaustive
def test_energy_falls_from_almost_half_a_turn_and_the_attitude_never_turns_over():
    """With the true velocity, V = ½(s·Is + k|e|²) < ½kπ² keeps |e| below π, at which the logarithm jumps."""
    body, k = models.free_body((1.0, 2.0, 2.5)), 4.0
    path = follow(lambda t: SO3.exp(jnp.stack([jnp.sin(t), 0 * t, 0.5 * t])))
    c = GroupTracking(body, path, k, 3.0)
    t, directions = jnp.linspace(0.0, 40.0, 201), np.random.default_rng(0).normal(size=(8, 3))

    @jax.jit
    @jax.vmap
    def run(direction):
        e0 = 3.1 * direction / jnp.linalg.norm(direction)
        g = c.path(t[0]).position @ SO3.exp(e0)
        start = Motion(g, c.reference(t[0], g)[1])  # s = 0
        x = simulate(body, start, t, lambda s, x: c(s, x.q, x), rtol=1e-9, atol=1e-12).x
        e, w, _ = jax.vmap(c.reference)(t, x.q)
        s = x.v - w
        return e, (jnp.sum(s @ body.space.inertia.matrix * s, axis=1) + k * jnp.sum(e * e, axis=1)) / 2

    e, energy = map(np.asarray, run(jnp.asarray(directions)))
    assert np.diff(energy, axis=1).max() < 1e-9
    assert (energy[:, 0] < k * np.pi**2 / 2).all()
    assert np.linalg.norm(e[:, -1], axis=1).max() < 1e-6


def closed_loop(group, inertia, kp, kd, cross):
    """The error equations with the true velocity in (e, s), for a reference of velocity w; the metric is constant."""
    space, n = LeftInvariant(group, inertia), group.dimension
    metric = np.block([[np.diag(kp), cross * inertia], [cross * inertia, inertia]])

    def at(z):
        w = z[2 * n :]

        def flow(t, x):
            e, s = jnp.split(x, 2)
            spring = jax.linear_transpose(lambda a: group.right_jacobian_inverse(e, a), s)(jnp.asarray(kp) * e)[0]
            turning = space.connection(group.identity(), w + s, s)
            return jnp.concatenate(
                [group.right_jacobian_inverse(e, s), -space.inertia.solve(spring + jnp.asarray(kd) * s) - turning]
            )

        return Point(flow, in_coordinates(lambda t, x: jnp.asarray(metric)), z[: 2 * n])

    names = tuple(f"{kind}{i + 1}" for kind in "esw" for i in range(n))
    return ErrorSystem(names, ("",) * (3 * n), at)


CASES = {
    # Bounds of e, s and w, and the rate of squared lengths.
    "SO(3), errors": (SO3, np.diag([1.0, 2.0, 2.5]), [20.0] * 3, [12.0] * 3, 1.5, [0.5] * 3, [1.0] * 3, [1.0] * 3, 1.0),
    "SE(3), linear": (
        SE3,
        np.asarray(models.underwater_vehicle().space.inertia.matrix),
        [60.0] * 3 + [4.0] * 3,
        [80.0] * 3 + [3.0] * 3,
        1.0,
        [0.0] * 6,
        [0.0] * 6,
        [0.5] * 6,
        1.0,
    ),
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("case", CASES)
def test_errors_are_proved_to_contract_for_all_references_up_to_a_speed(case):
    """The inequality is affine in s and w, so that corners of these and boxes of e suffice; on SE(3) at e = s = 0."""
    group, inertia, kp, kd, cross, *bounds, rate = CASES[case]
    system = closed_loop(group, inertia, kp, kd, cross)
    high = np.concatenate(bounds)
    affine = [name for name, bound in zip(system.names, high, strict=True) if name[0] != "e" and bound]
    domain = Box(system.names, system.units, -high, high)
    found = at_corners(contraction(system, rate), domain, affine, "the error equations contract")
    assert found.statement.proved
    # A controller that pushes away does not contract.
    away = contraction(closed_loop(group, inertia, kp, [-k for k in kd], cross), rate)
    assert not at_corners(away, domain, affine, "").statement.proved
