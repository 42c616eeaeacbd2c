"""What takes long of `test_group_systems.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_group_systems import SYSTEMS, state_of

from covariant import models
from covariant._integrate import rk8
from covariant.geometry.lie import SE2, SE3, SO3
from covariant.models import Lagrangian, Motion, acceleration, advance, energy
from covariant.simulation import simulate


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", SYSTEMS)
def test_equations_of_motion_are_those_of_lagrange_in_coordinates(name):
    """Along g = g₀ exp(q) the Euler–Lagrange equations of the energy, with the forces as one-forms."""
    system = SYSTEMS[name]
    (g0, _), (_, w) = state_of(system), state_of(system, 2)
    group, zero = system.group, jnp.zeros(system.group.dimension)
    q = 0.3 * state_of(system, 3)[1]
    u, t = jnp.linspace(0.5, 1.0, system.inputs), jnp.zeros(())

    @jax.jit
    def both(q, w):
        lagrangian = Lagrangian(
            lambda p: jacobian(p) @ system.space(g0) @ jacobian(p).T,
            lambda p: system.potential(g0 @ group.exp(p)),
            lambda s, p, now: pulled_back(p, system.force(s, g0 @ group.exp(p), now)),
            lambda p, rate: pulled_back(p, system.dissipation(g0 @ group.exp(p), group.right_jacobian(p, rate))),
        )
        in_chart = acceleration(lagrangian, t, q, w, u)
        # The body's acceleration is the time derivative of J_r(q)q'.
        _, moved = jax.jvp(group.right_jacobian, (q, w), (w, in_chart))
        return moved, acceleration(system, t, g0 @ group.exp(q), group.right_jacobian(q, w), u)

    def jacobian(p):
        return jax.vmap(lambda e: group.right_jacobian(p, e))(jnp.eye(len(p)))

    def pulled_back(p, covector):
        return jax.linear_transpose(lambda y: group.right_jacobian(p, y), zero)(covector)[0]

    chart, direct = both(q, w)
    np.testing.assert_allclose(chart, direct, rtol=1e-9, atol=1e-9)
    assert float(w @ system.dissipation(g0, w)) <= 0


@eqx.filter_jit
def moved(system, g, v, duration, steps, rule_of_eight=False):
    u = jnp.linspace(0.1, 0.2, system.inputs)
    if rule_of_eight:
        return advance(system, jnp.zeros(()), Motion(g, v), u, duration, steps, rk8)
    return advance(system, jnp.zeros(()), Motion(g, v), u, duration, steps)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["top", "satellite", "hovercraft"])
def test_advancing_is_of_fourth_order_and_stays_on_the_group(name):
    system = SYSTEMS[name]
    g, v = state_of(system)
    exact = moved(system, g, v, 0.5, jnp.asarray(200), rule_of_eight=True)
    steps = np.array([10, 20, 40])
    ends = [moved(system, g, v, 0.5, jnp.asarray(k)) for k in steps]
    gaps = [np.abs(end.q - exact.q).max() + np.abs(end.v - exact.v).max() for end in ends]
    assert np.polyfit(np.log(steps), np.log(gaps), 1)[0] == pytest.approx(-4.0, abs=0.2)
    assert max(float(system.group.defect(end.q)) for end in ends) < 1e-14


@pytest.mark.exhaustive
def test_a_million_steps_leave_the_group_by_less_than_1e_12():
    """Rᵀ R = 1 without any projection; the free body's momentum in space keeps its length too."""
    system = models.free_body()
    start = Motion(jnp.eye(3), jnp.array([0.4, 2.0, -0.3]))
    end = moved_freely(system, start, jnp.asarray(1_000_000))
    assert float(system.group.defect(end.q)) < 1e-12
    before, after = (np.linalg.norm(system.metric.inertia(m.v)) for m in (start, end))
    assert abs(after / before - 1) < 1e-11


@eqx.filter_jit
def moved_freely(system, start, steps):
    return advance(system, jnp.zeros(()), start, jnp.zeros(3), 1e-2 * steps, steps)


@eqx.filter_jit
def free_motion(system, x0, t):
    return simulate(system, x0, t).x


@pytest.mark.exhaustive
def test_satellite_keeps_its_momentum_whatever_its_wheels_do():
    system = SYSTEMS["satellite"]
    g, v = state_of(system)
    x = eqx.filter_jit(simulate)(system, Motion(g, v), jnp.linspace(0.0, 5.0, 26), motors).x
    momentum = jax.vmap(lambda g, v: g[:3, :3] @ system.metric.inertia(v)[:3])(x.q, x.v)
    np.testing.assert_allclose(momentum, np.broadcast_to(momentum[0], momentum.shape), atol=1e-12)
    assert np.abs(np.asarray(x.v[-1] - x.v[0])).max() > 0.1


@pytest.mark.exhaustive
def test_underwater_vehicle_rights_itself_and_hovers_when_neutral():
    system = models.underwater_vehicle(buoyancy=12.0 * 9.81)
    start = Motion(SE3.exp(jnp.array([0.0, 0.0, 0.0, 1.2, 0.4, 0.0])), jnp.zeros(6))
    x = free_motion(system, start, jnp.linspace(0.0, 120.0, 61))
    upright = np.asarray(x.q)[:, 2, 2]
    assert upright[0] < 0.5
    assert upright[-1] > 0.999
    assert np.abs(np.asarray(x.v)[-1]).max() < 0.02
    energies = np.asarray(jax.vmap(lambda g, v: energy(system, g, v))(x.q, x.v))
    assert (np.diff(energies) < 1e-9).all()


@pytest.mark.exhaustive
def test_hovercraft_goes_where_its_fans_push():
    system = models.hovercraft(drag=(0.0, 0.0, 0.0))
    x = eqx.filter_jit(simulate)(system, Motion(jnp.eye(3), jnp.zeros(3)), jnp.linspace(0.0, 2.0, 3), both_fans).x
    np.testing.assert_allclose(x.q[-1, :2, 2], [2.0 * 1.0 / 5.0 * 2.0, 0.0], atol=1e-12)  # ½ (2 N / 5 kg) t²
    np.testing.assert_allclose(SE2.log(x.q[-1])[2], 0.0, atol=1e-12)


def motors(s, x):
    return 1e-3 * jnp.stack([jnp.sin(s), jnp.cos(s), jnp.ones_like(s)])


def both_fans(s, x):
    return jnp.ones(2)


@pytest.mark.exhaustive
def test_a_system_works_in_float32():
    system = models.heavy_top()
    g, v = (jnp.asarray(a, jnp.float32) for a in state_of(system))
    light = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32) if eqx.is_array(a) else a, system)
    end = advance(light, jnp.zeros((), jnp.float32), Motion(g, v), jnp.zeros(3, jnp.float32), jnp.float32(0.1), 10)
    assert end.q.dtype == end.v.dtype == jnp.float32
    exact = moved_freely(system, Motion(*state_of(system)), jnp.asarray(10))
    np.testing.assert_allclose(end.q, exact.q, atol=2e-6)
