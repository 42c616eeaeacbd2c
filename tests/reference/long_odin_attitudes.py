"""ODIN's observer of Jouffroy & Fossen 2004 with a quaternion: the sets on which (101)–(102) are proved to contract."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.certificates import at_corners, contraction, crossed_metric, virtual
from covariant.geometry.lie import SO3, rotation_from_quaternion
from covariant.models import marine, state_space
from covariant.observers import craft_observer
from covariant.papers import jouffroy_fossen as paper
from covariant.simulation import observe
from scalargraph.proofs import Box

K1, K2 = np.diag([1.7] * 3 + [3.0] * 4), np.diag([240.0] * 3 + [600.0] * 4)
CROSS = np.diag([140.0] * 3 + [26.0] * 3)  # a quaternion's entries are half angles: four times the 6.5 of those
RNG = np.random.default_rng(0)


def error_system(craft, cross):
    return virtual(craft_observer(craft, K1, K2), crossed_metric(craft, K2, cross))


def certificate(rate, speed, spin, turn, cross):
    """At the attitude q = 1 and turning rates up to `turn` [rad/s]; the slope of the drag is affine in ν ≥ 0."""
    square = np.diag(marine.odin().damping(jnp.ones(6)))
    craft = eqx.tree_at(
        lambda c: c.damping, marine.odin(quaternion=True), lambda nu: jnp.diag(jnp.asarray(square) * nu)
    )
    system = error_system(craft, cross)
    high = dict(zip(craft.velocities, [speed] * 3 + [spin] * 3, strict=True)) | {"z_qw": 1.0}
    low = {"z_qw": 1.0}
    for name in ("zdot_qx", "zdot_qy", "zdot_qz"):
        low[name], high[name] = -turn / 2, turn / 2
    low, high = (np.array([values.get(name, 0.0) for name in system.names]) for values in (low, high))
    affine = (*craft.velocities, "zdot_qx", "zdot_qy", "zdot_qz")
    return at_corners(contraction(system, rate), Box(system.names, system.units, low, high), affine, "contracts")


def points(system, attitudes, turns, velocities):
    """Values of the variables of the error system at attitudes (k, 4), turning rates (k, 3) and velocities (k, 6)."""
    craft, rows = marine.odin(quaternion=True), np.zeros((len(attitudes), len(system.names)))
    at = [system.names.index(name) for name in craft.velocities]
    z, zdot = (system.names.index(f"{kind}_north") for kind in ("z", "zdot"))
    rows[:, at], rows[:, z + 3 : z + 7] = velocities, attitudes
    eta = rows[:, z : z + 7]
    twists = np.concatenate([RNG.normal(size=turns.shape), turns], axis=1)
    rows[:, zdot : zdot + 7] = jax.vmap(lambda e, nu: craft.transform(e) @ nu)(jnp.asarray(eta), jnp.asarray(twists))
    return jnp.asarray(rows)


def unit(k):
    q = RNG.normal(size=(k, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def test_all_attitudes_are_one():
    """At q the matrix of the proof is that at q = 1, turned: positions by R(q), quaternions by q itself."""
    system = error_system(marine.odin(quaternion=True), CROSS)
    matrix = jax.jit(jax.vmap(contraction(system, 0.8)))
    q, turns, velocities = unit(20), RNG.normal(size=(20, 3)), RNG.normal(size=(20, 6))
    one = np.tile([1.0, 0.0, 0.0, 0.0], (20, 1))
    here, level = (np.asarray(matrix(points(system, a, turns, velocities))) for a in (q, one))
    for each, expected, (w, *v) in zip(here, level, q, strict=True):
        v = np.array(v)
        left = np.block([[w, -v[None]], [v[:, None], w * np.eye(3) + np.asarray(SO3.hat(jnp.asarray(v)))]])
        turned = np.eye(13)
        turned[:3, :3], turned[3:7, 3:7] = rotation_from_quaternion(jnp.array([w, *v])), left
        np.testing.assert_allclose(turned.T @ each @ turned, expected, atol=1e-9)


# rate [1/s], speed [m/s], spin and turning rate [rad/s], and by what the cross term is divided
PROVED = [(0.8, 4.0, 4.0, 0.4, 1.0), (0.1, 100.0, 100.0, 2.0, 10.0), (0.01, 900.0, 900.0, 5.0, 10.0)]


@pytest.mark.parametrize(("rate", "speed", "spin", "turn", "less"), PROVED)
def test_observer_with_a_quaternion_is_proved_to_contract_at_all_attitudes(rate, speed, spin, turn, less):
    assert certificate(rate, speed, spin, turn, CROSS / less).statement.verdict == "holds"


@pytest.mark.exhaustive
@pytest.mark.parametrize(("pitch", "verdict"), [(0.7, "holds"), (0.8, "fails")])
def test_in_euler_angles_the_claim_ends_between_40_and_46_degrees_of_pitch(pitch, verdict):
    found = paper.odin_certificate(0.01, paper.odin_box(pitch=pitch, roll=3.15))
    assert found.statement.verdict == verdict


@pytest.mark.parametrize(("speed", "turn"), [(4.4, 0.4), (0.5, 0.6)])
def test_one_cross_term_ends_at_some_speed(speed, turn):
    """Speed multiplies the drag linearly, and the square of its product with the cross term by the square."""
    assert certificate(0.8, speed, 4.0, turn, CROSS).statement.verdict == "fails"


def test_without_a_cross_term_distances_never_grow_at_any_attitude_speed_or_turning_rate():
    system = error_system(marine.odin(quaternion=True), np.zeros((6, 6)))
    matrix = jax.jit(jax.vmap(contraction(system, 0.0)))
    sizes = 10.0 ** RNG.uniform(-3, 3, (500, 1))
    values = np.asarray(
        matrix(points(system, unit(500), sizes * RNG.normal(size=(500, 3)), sizes * RNG.normal(size=(500, 6))))
    )
    least = np.linalg.eigvalsh(values)[:, 0]
    assert (least >= -1e-9 * np.abs(values).max(axis=(1, 2))).all()
    # Drag that is linear too makes it exponential, everywhere.
    linear = error_system(marine.odin(quaternion=True, drag=(20.0,) * 6), np.zeros((6, 6)))
    rate = 2 * 20.0 / 187.5
    matrix = jax.jit(jax.vmap(contraction(linear, 0.999 * rate)))
    values = np.asarray(matrix(points(linear, unit(500), sizes * RNG.normal(size=(500, 3)), np.zeros((500, 6)))))
    assert (np.linalg.eigvalsh(values)[:, 0] > 0).all()


def test_it_converges_from_far_away_and_its_lyapunov_function_never_grows():
    """A vehicle that tumbles, an estimate that is upside down, 30 m away and 20 m/s wrong."""
    robot = marine.odin(quaternion=True)
    observer = craft_observer(robot, K1, K2)
    x0 = jnp.zeros(13).at[3].set(1.0)
    far = jnp.array([30.0, -20.0, 10.0, -1.0, 0.5, 0.0, 0.5, 20.0, -10.0, 5.0, 3.0, -4.0, 5.0])
    t = jnp.linspace(0.0, 30.0, 301)
    start = observer.init(x0[:7])._replace(x=far)
    x, state = observe(
        state_space(robot), observer, x0, start, t, lambda s, x: jnp.array([20.0, 0.0, 5.0, 30.0, 60.0, 5.0])
    )
    error = np.asarray(x - state.x)
    metric = np.diag([*np.diag(K2), *np.diag(robot.mass)])
    lyapunov = np.einsum("ti,ij,tj->t", error, metric, error)
    assert (np.diff(lyapunov) <= 1e-9 * lyapunov[:-1] + 1e-15).all()
    assert lyapunov[-1] < 1e-12 * lyapunov[0]


@pytest.mark.parametrize(("speed", "proved"), [(0.3, True), (0.35, False)])
def test_coriolis_forces_end_the_claim_at_a_third_of_a_metre_per_second(speed, proved):
    system = error_system(marine.odin(quaternion=True, coriolis=True), CROSS)
    matrix = jax.jit(jax.vmap(contraction(system, 0.0)))
    velocities = RNG.normal(size=(4000, 3))
    velocities *= speed / np.linalg.norm(velocities, axis=1, keepdims=True)
    rows = points(system, unit(4000), np.zeros((4000, 3)), np.concatenate([velocities, 0 * velocities], axis=1))
    assert (np.linalg.eigvalsh(np.asarray(matrix(rows)))[:, 0].min() > 0) == proved
