"""What takes long of `test_streams.py`."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from test_streams import BODY, GAIN, MASSES, METRIC, ONE, START, WATCHER, same

from covariant.metrics import Equation
from covariant.models import Motion, ball_and_beam, marine, pendulum_chain
from covariant.observers import (
    EKF,
    PLL,
    UKF,
    AbstractObserver,
    Contracting,
    FilteredDerivative,
    Geodesic,
    HighGain,
    InformationEKF,
    Intrinsic,
    IntrinsicKalman,
    JointKalman,
    Levant,
    ModelCopy,
    PassiveShip,
    Riccati,
    Salcudean,
    SavitzkyGolay,
    craft_observer,
    lyapunov_gains,
)
from covariant.signals import StepCode
from covariant.simulation import hold, simulate

ROWS = 400


FAULTY = slice(40, 70)
"""Rows in which faults are drawn; those after are sound, and long enough to recover in."""


class Stream(NamedTuple):
    """What arrives: the first measurement, and of every later row the input, the measurement and the step in time."""

    first: np.ndarray
    u: np.ndarray
    y: np.ndarray
    dt: np.ndarray


def stream(model, x0, rate: float, inputs: int, size: float = 0.3) -> Stream:
    """A motion of the model under inputs that change slowly, each held from its row to the next."""
    t = np.arange(ROWS + 1) / rate
    u = size * np.sin(2 * np.pi * rate * t[:, None] / 100 + np.arange(inputs))
    y = np.asarray(eqx.filter_jit(simulate)(model, x0, jnp.asarray(t), hold(jnp.asarray(t), jnp.asarray(u))).y)
    return Stream(y[0], u[:-1], y[1:], np.diff(t))


PENDULUM = pendulum_chain((1.2,), (0.5,), com=(0.3,), inertia=(0.02,), viscous=(0.05,))


BEAM = ball_and_beam()


STATION = marine.Station(marine.supply_vessel(mooring=np.diag([5e4, 5e4, 5e7])))


CRAFT = marine.supply_vessel(mooring=np.diag([5e4, 5e4, 5e7]))


pendulum = functools.cache(lambda: stream(PENDULUM, jnp.array([0.7, 4.0]), 100.0, 1))


beam = functools.cache(lambda: stream(BEAM, jnp.array([0.3, 0.1, 0.2, -0.9]), 200.0, 1))


body = functools.cache(lambda: stream(BODY, Motion(jnp.eye(3), jnp.array([0.1, 1.0, 0.2])), 50.0, 3))


masses = functools.cache(lambda: stream(MASSES, jnp.array([0.5, -0.3, 0.2, 0.4]), 20.0, 1))


ship = functools.cache(lambda: stream(STATION.model(), jnp.array([5.0, -3.0, 0.3, 0.5, -0.2, 0.004]), 1.0, 3, 1e3))


MASS = np.asarray(STATION.ship.mass)


WATCHED: dict[str, tuple[Callable[[], AbstractObserver], Callable[[], Stream], float, float]] = {
    "intrinsic": (lambda: Intrinsic(BEAM, 40.0, 600.0), beam, 0.3, 1e-5),
    "intrinsic, second order": (lambda: Intrinsic(PENDULUM, 20.0, 150.0, order=2), pendulum, 1e3, 1e-5),
    "geodesic": (lambda: Geodesic(BEAM, 40.0, 600.0), beam, 0.3, 1e-5),
    "copy": (lambda: ModelCopy(PENDULUM, 20.0, 150.0), pendulum, 1e3, 1e-5),
    "ekf": (lambda: EKF(BEAM, 10.0 * jnp.eye(2), 1e-6 * jnp.eye(2)), beam, 0.3, 1e-5),
    "intrinsic kalman": (lambda: IntrinsicKalman(BEAM, 1.0, 1e-4, 1.0, substeps=1), beam, 1e3, 1e-4),
    "intrinsic kalman, body": (lambda: IntrinsicKalman(BODY, 1e-2, 1e-4, 1.0, substeps=1), body, 1e3, 1e-3),
    "filtered derivative": (lambda: FilteredDerivative(60.0), pendulum, 1e3, 1e-5),
    "ukf": (lambda: UKF(PENDULUM, jnp.eye(1), 1e-4 * jnp.eye(1), 5.0, 1), pendulum, 1e3, 1e-4),
    "pll": (lambda: PLL(60.0), pendulum, 1e3, 1e-5),
    "high-gain": (lambda: HighGain(60.0), pendulum, 1e3, 1e-5),
    "levant": (lambda: Levant(1e4), pendulum, 1e3, 1e-5),
    "joint kalman": (lambda: JointKalman(50.0, 0.1, 1e-3), pendulum, 1e3, 1e-5),
    "savitzky-golay": (lambda: SavitzkyGolay(9, 2), pendulum, 1e3, 1e-5),
    "group": (lambda: Intrinsic(BODY, 4.0, 6.0, substeps=1), body, 1e3, 1e-4),
    "group, riemannian": (lambda: Geodesic(BODY, 4.0, 6.0, substeps=1), body, 1e3, 1e-4),
    "invariant ekf": (lambda: EKF(BODY, 1e-3 * jnp.eye(3), 1e-4 * jnp.eye(3), substeps=1), body, 1e3, 1e-4),
    "salcudean": (lambda: Salcudean(BODY, 96.0, 16.0, substeps=1), body, 0.3, 5e-3),
    "riccati": (lambda: Riccati(MASSES, lambda x: METRIC, START, 0.5), masses, 1e3, 1e-3),
    "information ekf": (lambda: InformationEKF(MASSES, Equation(1.0), START, jnp.eye(4)), masses, 1e3, 1e-2),
    "contracting": (lambda: Contracting(MASSES, GAIN, START, memory=0.1), masses, 1e3, 1e-5),
    "craft": (lambda: craft_observer(CRAFT, np.eye(3), MASS * 1e-2), ship, 1e3, 1e-2),
    "passive ship": (lambda: PassiveShip(STATION, lyapunov_gains(STATION, MASS * 1e-2, MASS * 1e-2)), ship, 1e3, 5e-2),
}


class Loop(NamedTuple):
    """An observer's compiled loop, the machine's sound stream and the estimates along it, how
    far off a measurement may be that it recovers from, and how close it returns."""

    follow: Callable[..., tuple[np.ndarray, np.ndarray]]
    stream: Stream
    sound: np.ndarray
    far: float
    close: float


@functools.cache
def loop(name: str) -> Loop:
    """`follow(first, u, y, dt)` gives the estimates (ROWS, k), flat, and the result codes (ROWS,)."""
    make, motion, far, close = WATCHED[name]
    observer, sound = make(), motion()

    @jax.jit
    def follow(first, u, y, dt):
        def step(state, row):
            state, info = observer.step(state, *row)
            return state, (jax.flatten_util.ravel_pytree(observer.estimate(state))[0], info.result)

        return jax.lax.scan(step, observer.init(first), (u, y, dt))[1]

    return Loop(follow, sound, np.asarray(follow(*sound)[0]), far, close)


INPUTS = {"u nan": np.nan, "u +inf": np.inf, "u -inf": -np.inf}


STEPS = {"dt nan": np.nan, "dt +inf": np.inf, "dt -inf": -np.inf, "dt negative": -0.7, "dt zero": 0.0}


MEASUREMENTS = {"y nan": np.nan, "y +inf": np.inf, "y -inf": -np.inf}


KINDS = [*INPUTS, *STEPS, *MEASUREMENTS, "y none", "y far"]


def spoiled(sound: Stream, faults: list[tuple[int, str, int]], far: float) -> Stream:
    """The stream with faults (row, kind, entry) in it; "y none" spoils all entries, others one, "y far" by `far`."""
    u, y, dt = sound.u.copy(), sound.y.copy(), sound.dt.copy()
    for row, kind, entry in faults:
        if kind in STEPS:
            dt[row] = STEPS[kind]
        elif kind in INPUTS:
            u[row, entry % u.shape[1]] = INPUTS[kind]
        elif kind == "y none":
            y[row] = np.nan
        elif kind == "y far":
            y[row].flat[entry % y[row].size] += far
        else:
            y[row].flat[entry % y[row].size] = MEASUREMENTS[kind]
    return Stream(sound.first, u, y, dt)


def expected(stream: Stream) -> np.ndarray:
    """The least code of every row, counted a second time and plainly."""
    codes = np.zeros(ROWS, int)
    y = stream.y.reshape(ROWS, -1)
    codes[np.isnan(y).all(1) | np.isinf(y).any(1)] = StepCode.COASTED
    codes[~np.isfinite(stream.u).all(1)] = StepCode.INPUT_HELD
    codes[stream.dt == 0] = StepCode.REPEATED
    codes[~np.isfinite(stream.dt) | (stream.dt < 0)] = StepCode.STEP_REFUSED
    return codes


FAULTS = st.lists(
    st.tuples(st.integers(FAULTY.start, FAULTY.stop - 1), st.sampled_from(KINDS), st.integers(0, 15)),
    min_size=1,
    max_size=20,
)


@pytest.mark.exhaustive(
    "filtered derivative",
    "ukf",
    "joint kalman",
    *("copy", "craft", "ekf", "geodesic", "group", "group, riemannian", "information ekf", "intrinsic"),
    *("intrinsic kalman", "intrinsic kalman, body", "intrinsic, second order", "invariant ekf", "passive ship"),
    *("riccati", "salcudean"),
)
@pytest.mark.parametrize("name", WATCHED)
def test_no_stream_spoils_an_observer(name):
    """Finite throughout, each fault said in its row, and after the last one the estimate of the sound stream again."""
    watched = loop(name)

    @settings(max_examples=20)
    @given(FAULTS)
    def holds(faults):
        stream = spoiled(watched.stream, faults, watched.far)
        x, codes = map(np.asarray, watched.follow(*stream))
        assert np.isfinite(x).all()
        least = expected(stream)
        assert (codes >= least).all()
        np.testing.assert_array_equal(codes == StepCode.STEP_REFUSED, least == StepCode.STEP_REFUSED)
        np.testing.assert_array_equal(codes[FAULTY.stop :][-100:], StepCode.OK)
        kept = least >= StepCode.REPEATED
        np.testing.assert_array_equal(x[kept], np.concatenate([x[:1], x])[:-1][kept])
        np.testing.assert_allclose(x[-1], watched.sound[-1], rtol=0, atol=watched.close)

    holds()


@pytest.mark.exhaustive
def test_a_repeated_stamp_changes_nothing_and_is_said():
    ekf = EKF(ONE, jnp.eye(1), jnp.eye(1))  # which could take a measurement in without moving on
    for observer in (WATCHER, ekf):
        state = observer.init(jnp.array([1.0]))
        after, info = eqx.filter_jit(observer.step)(state, jnp.ones(2), jnp.array([4.0]), jnp.zeros(()))
        same(after, state)
        assert info.result == StepCode.REPEATED
        assert info.innovation[0] == pytest.approx(3.0)


@pytest.mark.exhaustive
def test_on_a_group_one_entry_that_is_not_finite_makes_the_whole_missing():
    watched = loop("group")
    none, one = watched.stream.y.copy(), watched.stream.y.copy()
    none[50], one[50, 1, 2] = np.nan, -np.inf
    same(watched.follow(*watched.stream._replace(y=one)), watched.follow(*watched.stream._replace(y=none)))
