"""What takes long of `test_contracting.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import eigh
from test_contracting import ZERO, flow_of, mass_on_a_spring, station, step

from covariant.models import marine, state_space
from covariant.observers import (
    Contracting,
    PassiveShip,
    craft_observer,
    lyapunov_gains,
    lyapunov_rate,
    notch_gains,
    printed_rate,
)
from covariant.signals import StepCode
from covariant.simulation import simulate


def test_missing_samples_are_coasted_and_gains_of_any_size_are_stable():
    model = mass_on_a_spring()
    observer = Contracting(model, jnp.array([[1e4], [1e4]]), jnp.array([0.3, 0.1]))
    state = observer.init(jnp.array([1.0]))
    moved, info = step(observer, state, jnp.zeros(1), jnp.array([jnp.nan]), jnp.asarray(0.1))
    assert int(info.result) == StepCode.COASTED
    np.testing.assert_allclose(moved.unmeasured, 0.1)
    alone = simulate(model, state.x, jnp.array([0.0, 0.1])).x[-1]
    np.testing.assert_allclose(moved.x, alone, atol=1e-6)
    for _ in range(200):
        state, info = step(observer, state, jnp.ones(1), jnp.array([1.0]), jnp.asarray(0.1))  # the spring at rest
    np.testing.assert_allclose(state.x, [1.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(info.innovation, 0.0, atol=1e-9)


def test_passive_observer_is_the_printed_one():
    """(43) and (44) in letters, at another heading than the estimated one."""
    plain = station()
    mass, d, k = (np.asarray(a) for a in (plain.ship.mass, plain.ship.damping(jnp.zeros(3)), np.diag([5e4, 5e4, 5e7])))
    gains = lyapunov_gains(plain, mass * 1e-2, mass * 1e-3)
    observer = PassiveShip(plain, gains)
    z, x = jnp.array([3.0, -2.0, 1.1]), jnp.array([2.5, -1.0, 0.8, 0.3, -0.1, 0.01])
    tau = jnp.array([1e5, 2e4, -3e6])
    flow = flow_of(observer, observer.init(z)._replace(x=x), tau, z)
    turn = np.asarray(marine.yaw_rotation(z[2]))
    error, eta, nu = np.asarray(z - x[:3]), np.asarray(x[:3]), np.asarray(x[3:])
    held = np.array([eta[0], eta[1], eta[2]])
    p1, p2 = mass * 1e-2, mass
    a1 = -np.linalg.solve(mass, turn.T @ k)
    k2 = np.linalg.solve(p2, turn.T @ p1) + a1
    # The mooring pulls by the estimated place and the measured heading.
    seen = np.array([held[0], held[1], np.asarray(z)[2]])
    pulled = -np.linalg.solve(mass, turn.T @ k @ seen)
    assert np.allclose(flow[:3], turn @ nu + np.linalg.solve(p1, mass * 1e-3) @ error)
    assert not np.allclose(a1 @ held, pulled)
    np.testing.assert_allclose(
        flow[3:] + np.linalg.solve(mass, d @ nu) - np.linalg.solve(mass, np.asarray(tau)) - k2 @ error,
        a1 @ held,
        rtol=1e-9,
    )


@pytest.mark.exhaustive("False")
@pytest.mark.parametrize("own", [False, True])
def test_lyapunov_function_of_the_ship_falls_as_designed(own):
    """V' = −η̃ᵀQ1η̃ − ν̃ᵀQ2ν̃ along the virtual system, whatever the heading."""
    plain = station()
    mass = np.asarray(plain.ship.mass)
    q1, q2 = mass * 1e-3, np.diag(np.diag(mass)) * 1e-2 if own else None
    gains = lyapunov_gains(plain, mass * 1e-2, q1, q2)
    slope = jax.jit(jax.jacfwd(PassiveShip(plain, gains).contracting().virtual, 1))
    p = np.asarray(jax.scipy.linalg.block_diag(gains.stiffness, gains.inertia))
    for psi in (0.0, 1.0, -2.5):
        z = jnp.array([1.0, 2.0, psi])
        f = np.asarray(slope(ZERO, jnp.zeros(6), jnp.zeros(3), z))
        fall = -(p @ f + f.T @ p) / 2
        damping = np.asarray(plain.ship.damping(jnp.zeros(3)))
        expected = np.asarray(jax.scipy.linalg.block_diag(q1, (damping + damping.T) / 2 if q2 is None else q2))
        scale = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(fall / scale / scale[:, None], expected / scale / scale[:, None], atol=1e-9)
        # It falls at the rate, of which (47) as printed, which depends on units, is never more.
        assert eigh(fall, p, eigvals_only=True)[0] == pytest.approx(lyapunov_rate(plain, gains))
        assert lyapunov_rate(plain, gains) >= printed_rate(plain, gains) > 0


def test_a_thruster_that_lags_is_modelled_and_not_corrected():
    """The force at work follows the commanded one: no measurement of a position tells more of it."""
    lagging = station(thruster_time=5.0)
    mass = np.asarray(lagging.ship.mass)
    observer = PassiveShip(lagging, lyapunov_gains(lagging, mass * 1e-2, mass * 1e-3))
    x = jnp.array([2.5, -1.0, 0.8, 0.3, -0.1, 0.01, 1e4, -2e4, 3e5])
    tau, z = jnp.array([1e5, 2e4, -3e6]), jnp.array([3.0, -2.0, 1.1])
    state = observer.init(z)
    assert state.t == 0.0
    flow = flow_of(observer, state._replace(x=x), tau, z)
    np.testing.assert_allclose(flow[6:], (tau - x[6:]) / 5.0, rtol=1e-14)
    still = PassiveShip(station(), observer.gains)
    alone = flow_of(still, still.init(z)._replace(x=x[:6]), x[6:], z)
    np.testing.assert_allclose(flow[:6], alone, rtol=1e-12)


def test_passive_observer_does_not_mind_whole_turns_and_needs_a_first_position():
    noisy = station(waves=marine.Waves((0.8,) * 3, (0.1,) * 3, (0.5, 0.5, 0.01)), bias_time=1000.0)
    observer = PassiveShip(noisy, notch_gains(noisy, (0.1, 0.1, 0.2)))
    y = jnp.array([1.0, 2.0, 3.1])
    state = observer.init(y)
    states = [
        step(observer, state, jnp.zeros(3), y.at[2].add(2 * np.pi * k), jnp.asarray(1.0))[0].x for k in (-1, 0, 1)
    ]
    np.testing.assert_allclose(states[0], states[1], atol=1e-6)
    np.testing.assert_allclose(states[2], states[1], atol=1e-6)
    with pytest.raises(ValueError, match="the first row must hold north, east and heading"):
        observer.init(jnp.array([1.0, 2.0, jnp.nan]))
    with pytest.raises(ValueError, match="north, east and heading; this one has shape"):
        observer.init(jnp.array([1.0, 2.0]))


def test_notch_holds_back_waves_and_follows_the_bias():
    """The frequency response of the estimated position: little at the wave frequency, all at rest."""
    noisy = marine.Station(
        marine.supply_vessel(), marine.Waves((0.8,) * 3, (0.1,) * 3, (0.5, 0.5, 0.01)), bias_time=1e6
    )
    observer = PassiveShip(noisy, notch_gains(noisy, (0.1, 0.1, 0.2)))
    slope = jax.jit(jax.jacfwd(observer.contracting().virtual, 1))
    f = np.asarray(slope(ZERO, jnp.zeros(15), jnp.zeros(3), jnp.zeros(3)))
    gain = np.asarray(observer.gain(ZERO))
    assert np.linalg.eigvals(f).real.max() < 0

    def response(w):
        return np.linalg.solve(1j * w * np.eye(15) - f, gain)[:3]

    assert np.abs(response(0.8).diagonal()).max() < 0.2
    np.testing.assert_allclose(np.abs(response(1e-4).diagonal()), 1.0, atol=0.05)


def test_craft_observer_is_the_printed_one():
    craft = marine.odin()
    k1, k2 = np.diag(np.arange(1.0, 7.0)), np.diag(np.arange(10.0, 16.0))
    observer = craft_observer(craft, k1, k2)
    random = np.random.default_rng(0)
    z, x, tau = (jnp.asarray(random.normal(size=n)) for n in (6, 12, 6))
    flow = jax.jit(observer.virtual)(ZERO, x, tau, z)
    j = jax.jit(craft.transform)(z)
    np.testing.assert_allclose(flow[:6], j @ x[6:] + k1 @ (z - x[:6]), rtol=1e-12)  # (101)
    right = tau + j.T @ k2 @ (z - x[:6]) - craft.damping(x[6:]) @ x[6:] - craft.restoring(z)
    np.testing.assert_allclose(craft.mass @ flow[6:], right, rtol=1e-12)  # (102)
    drag = jax.jit(jax.jacfwd(lambda nu: craft.damping(nu) @ nu))(x[6:])
    np.testing.assert_allclose(drag, 2 * craft.damping(x[6:]), rtol=1e-12)  # the factor that F_obs lacks
    assert state_space(craft).outputs == craft.coordinates
