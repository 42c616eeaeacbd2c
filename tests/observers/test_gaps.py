"""Long steps: what a sample tells after a while is no more than what the model's error has become by then."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.geometry import Euclidean
from covariant.models import Motion, advance, pendulum_chain
from covariant.observers import EKF, Geodesic, Intrinsic, IntrinsicKalman, ModelCopy
from covariant.observers.base._sampled import LONGEST_GAP, sampled_correction, sampled_gains
from covariant.signals import StepCode

ALPHA, BETA = 20.0, 200.0


# The loop of one sample, in one dimension, where the model does `ξ' = ζ, ζ' = Nξ` to an error.


@jax.jit
def corrected(stiffness, dt, xi):
    zero = jnp.zeros(1)
    taken = sampled_correction(Euclidean(), Motion(zero, zero), sampled_gains(ALPHA, BETA, dt), dt, xi, -stiffness * xi)
    return taken.part, taken.velocity, taken.restarted


def loop(stiffness: float, dt: float) -> np.ndarray:
    part, velocity, _ = (float(x[0]) if x.ndim else float(x) for x in corrected(stiffness, dt, jnp.ones(1)))
    root = np.sqrt(complex(stiffness))
    c, s = np.cosh(root * dt), np.sinh(root * dt)
    alone = np.array([[c, s / root], [root * s, c]]).real
    return np.array([[1 - part, 0.0], [velocity, 1.0]]) @ alone


def wanted(dt: float) -> np.ndarray:
    return np.exp(np.roots([1.0, ALPHA, BETA]) * dt)


@pytest.mark.parametrize("stiffness", [-40.0, 40.0])
def test_the_loop_has_the_poles_of_the_law_to_second_order_in_the_step(stiffness):
    gaps = []
    for dt in (0.01, 0.02):
        found = loop(stiffness, dt)
        gaps.append(abs(np.trace(found) - wanted(dt).sum().real))
        assert np.linalg.det(found) == pytest.approx(wanted(dt).prod().real, rel=1e-12)
    assert gaps[1] < 5e-5
    assert np.log2(gaps[1] / gaps[0]) > 3.5  # (N dt²)²


@pytest.mark.parametrize("stiffness", [-100.0, -20.0, 20.0, 100.0])
@pytest.mark.parametrize("dt", np.geomspace(1e-3, 1.0, 13))
def test_it_is_stable_as_long_as_it_does_not_start_anew(stiffness, dt):
    restarted = bool(corrected(stiffness, dt, jnp.ones(1))[2])
    assert restarted == (abs(stiffness) * dt**2 > LONGEST_GAP)
    if not restarted:
        assert np.abs(np.linalg.eigvals(loop(stiffness, dt))).max() < 1


def test_without_an_error_nothing_starts_anew():
    part, velocity, restarted = corrected(100.0, 1.0, jnp.zeros(1))
    assert (float(velocity[0]), bool(restarted)) == (0.0, False)
    assert 0 < float(part) <= 1


# Rows missing from a log.

RATE = 200.0
NOISE = 5e-4
STARTS = 10
LENGTHS = {"mass": (0.6, 0.5), "length": (0.25, 0.2)}
ARM = pendulum_chain(**LENGTHS)
BELIEVED = pendulum_chain(**LENGTHS, gravity=9.81 * 1.02)
OBSERVERS = {
    "intrinsic": lambda model: Intrinsic(model, ALPHA, BETA),
    "geodesic": lambda model: Geodesic(model, ALPHA, BETA),
    "copy": lambda model: ModelCopy(model, ALPHA, BETA),
    "intrinsic-kalman": lambda model: IntrinsicKalman(
        model, 0.05 * jnp.eye(2), NOISE**2 * jnp.eye(2), 9.0 * jnp.eye(2)
    ),
    "ekf": lambda model: EKF(model, 0.05 * jnp.eye(2), NOISE**2 * jnp.eye(2), 3.0),
}


@pytest.fixture(scope="module")
def swings() -> tuple[np.ndarray, np.ndarray]:
    """States (STARTS, T, 4) of fast swings and what is measured of them (STARTS, T, 2)."""
    rng = np.random.default_rng(5)
    starts = jnp.asarray(np.concatenate([rng.uniform(-1, 1, (STARTS, 2)), rng.uniform(-4, 4, (STARTS, 2))], axis=1))

    @jax.jit
    @jax.vmap
    def swing(x):
        def step(motion, _):
            return advance(ARM, 0.0, motion, jnp.zeros(2), 1 / RATE, 4), jnp.concatenate(motion)

        return jax.lax.scan(step, Motion(x[:2], x[2:]), None, 560)[1]

    x = np.asarray(swing(starts))
    return x, x[..., :2] + NOISE * rng.normal(size=x[..., :2].shape)


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, 0, None, 0, None))
def after_the_gap(observer, y, gap, late, before):
    """State before the gap and after its first sample, with the code; then the estimates of the rows that follow."""

    def step(state, sample):
        state, info = observer.step(state, jnp.zeros(2), sample, jnp.asarray(1 / RATE))
        return state, (observer.estimate(state), info.result)

    state, (x, _) = jax.lax.scan(step, observer.init(y[0]), y[1 : before + 1])
    state, info = observer.step(state, jnp.zeros(2), late[0], gap)
    first = observer.estimate(state)
    follow = jax.lax.scan(step, state, late[1:])[1][0]
    return x[-1], first, info.result, follow


BEFORE, AFTER = 240, 60


def gap_errors(observer, swings, gap: float):
    x, y = swings
    skipped = BEFORE + round(gap * RATE)
    late = jnp.asarray(y[:, skipped : skipped + AFTER])
    seconds = jnp.asarray(round(gap * RATE) / RATE)
    last, first, codes, follow = after_the_gap(observer, jnp.asarray(y), seconds, late, BEFORE)

    @jax.jit
    @jax.vmap
    def alone(x):
        return advance(BELIEVED, 0.0, Motion(x[:2], x[2:]), jnp.zeros(2), seconds, 400).v

    true = x[:, skipped : skipped + AFTER, 2:]
    model = np.linalg.norm(np.asarray(alone(last)) - true[:, 0], axis=1)
    found = np.linalg.norm(np.asarray(first)[:, 2:] - true[:, 0], axis=1)
    rest = np.linalg.norm(np.asarray(follow)[..., 2:] - true[:, 1:], axis=2)
    return found, model, np.asarray(codes), rest


def rms(a) -> float:
    return float(np.sqrt(np.mean(np.square(a))))


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", OBSERVERS)
def test_after_a_long_gap_the_velocity_is_no_worse_than_the_model_alone(name, swings):
    found, model, codes, rest = gap_errors(OBSERVERS[name](BELIEVED), swings, 1.2)
    assert rms(found) <= 1.1 * rms(model)
    assert (found <= 1.5 * rms(model)).all() or (found <= 1.5 * model).all()
    assert np.isfinite(rest).all()
    if name in ("intrinsic", "geodesic", "copy"):
        assert (codes >= StepCode.RESTARTED).all()


@pytest.mark.long
@pytest.mark.parametrize("name", ["intrinsic", "geodesic", "intrinsic-kalman"])
def test_a_short_gap_is_corrected(name, swings):
    found, model, _, _ = gap_errors(OBSERVERS[name](BELIEVED), swings, 0.1)
    assert rms(found) < 0.9 * rms(model)
