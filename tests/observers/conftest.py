"""Machines to watch, each with its motion written plainly in numpy, and one compiled loop for every test."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plain import rk4

from covariant.models import Lagrangian, ball_and_beam, pendulum_chain
from covariant.observers import (
    EKF,
    AbstractObserver,
    FilteredDerivative,
    Geodesic,
    Intrinsic,
    LagrangianMetric,
    ModelCopy,
    SavitzkyGolay,
)

ROWS = 400


class Machine(NamedTuple):
    """A model, and the same motion `(t, x, u) -> dx/dt` written a second time, without the library."""

    model: Lagrangian
    motion: Callable[[float, np.ndarray, np.ndarray], np.ndarray]

    def truth(self, t: np.ndarray, x0: np.ndarray, u: np.ndarray | None = None, substeps: int = 20) -> np.ndarray:
        """States (T, 2n) at the stamps, each input held from its row to the next; a plain Runge–Kutta integration."""
        u = np.zeros((len(t), len(x0) // 2)) if u is None else u
        states = [np.asarray(x0, float)]
        for k in range(len(t) - 1):
            x, h = states[-1], (t[k + 1] - t[k]) / substeps
            x = np.append(x, t[k])
            for _ in range(substeps):
                x = rk4(lambda x, k=k: np.append(self.motion(x[-1], x[:-1], u[k]), 1.0), x, h)
            states.append(x[:-1])
        return np.array(states)


@pytest.fixture(scope="session")
def pendulum() -> Machine:
    """One link with friction, a constant torque and a torque that depends on time; a circle joint."""
    chain = pendulum_chain((1.2,), (0.5,), com=(0.3,), inertia=(0.02,), viscous=(0.05,), offset=(0.1,))
    inertia = 0.02 + 1.2 * 0.3**2

    def motion(t, x, u):
        torque = u[0] + 0.1 + 0.3 * np.sin(2 * t) - 1.2 * 9.81 * 0.3 * np.sin(x[0]) - 0.05 * x[1]
        return np.array([x[1], torque / inertia])

    model = Lagrangian(
        chain.metric,
        chain.potential,
        lambda t, q, u: chain.force(t, q, u) + 0.3 * jnp.sin(2 * t),
        chain.dissipation,
        circles=(0,),
    )
    return Machine(model, motion)


@pytest.fixture(scope="session")
def beam() -> Machine:
    """Ball and beam: curved, two coordinates."""

    def motion(t, x, u):
        r, angle, r_dot, rate = x
        spin = (u[0] - 2 * r * r_dot * rate - r * np.cos(angle)) / (1 + r**2)
        return np.array([r_dot, rate, r * rate**2 - np.sin(angle), spin])

    return Machine(ball_and_beam(), motion)


@pytest.fixture(scope="session")
def regular() -> np.ndarray:
    """Stamps at 250 Hz; a log need not begin at zero."""
    return 3.0 + 0.004 * np.arange(ROWS)


@pytest.fixture(scope="session")
def irregular() -> np.ndarray:
    """Stamps with steps of 1 to 9 ms, and one long one."""
    step = np.random.default_rng(3).uniform(0.001, 0.009, ROWS)
    step[200] = 0.05
    return 3.0 + np.cumsum(step)


def _with_gains(kind: Callable[..., AbstractObserver]) -> Callable[[Lagrangian], AbstractObserver]:
    # Gains are arrays, so that other gains need no new compilation.
    return lambda model: kind(model, jnp.array(20.0), jnp.array(150.0))


MODEL_BASED = {
    "intrinsic": _with_gains(Intrinsic),
    "geodesic": _with_gains(Geodesic),
    "lagrangian-metric": _with_gains(LagrangianMetric),
    "copy": _with_gains(ModelCopy),
    "ekf": lambda model: EKF(model, jnp.array([[4.0]]), jnp.array([[1e-6]])),
}
FILTERS = {
    "filtered-derivative": lambda model: FilteredDerivative(jnp.array(60.0), model.circles),
    "savitzky-golay": lambda model: SavitzkyGolay(9, 2, model.circles),
}


@pytest.fixture(params=MODEL_BASED)
def model_based(request, pendulum) -> AbstractObserver:
    """Each observer that knows the pendulum."""
    return MODEL_BASED[request.param](pendulum.model)


@pytest.fixture(params=["intrinsic", "geodesic", "copy"])
def with_gains(request, pendulum) -> AbstractObserver:
    """Each kind of observer that has gains α and β."""
    return MODEL_BASED[request.param](pendulum.model)


@pytest.fixture(params=FILTERS)
def filter_only(request, pendulum) -> AbstractObserver:
    """Each filter that knows no model."""
    return FILTERS[request.param](pendulum.model)


@pytest.fixture(params=MODEL_BASED | FILTERS)
def observer(request, pendulum) -> AbstractObserver:
    """Every observer, on the pendulum."""
    return (MODEL_BASED | FILTERS)[request.param](pendulum.model)


class Followed(NamedTuple):
    """What a loop over `step` gave, rows 1 and later; `x` are the estimates (T − 1, 2n)."""

    state: Any
    x: np.ndarray
    info: Any


@eqx.filter_jit
def _follow(observer, state, t, u, y):
    def step(state, sample):
        state, info = observer.step(state, *sample)
        return state, (state, observer.estimate(state), info)

    return jax.lax.scan(step, state, (u[:-1], y[1:], jnp.diff(t)))[1]


def _loop(observer, t, y, *, v0=None, u=None) -> Followed:
    t, y = jnp.asarray(t), jnp.asarray(y)
    state = observer.init(y[0], t[0])
    if v0 is not None:
        state = state._replace(v=jnp.asarray(v0))
    u = jnp.zeros_like(y) if u is None else jnp.asarray(u)
    state, x, info = _follow(observer, state, t, u, y)
    return Followed(state, np.asarray(x), info)


@pytest.fixture(scope="session")
def follow() -> Callable[..., Followed]:
    """`follow(observer, t, y, v0=…, u=…)`: step along the rows from the state at y[0] with velocity v0."""
    return _loop
