"""FilterPy's extended and unscented Kalman filters beside those of this library: the same model, the same log.

The models are written again in NumPy, and FilterPy gets their Jacobians by complex steps, so that neither the equations
of motion nor their derivatives are shared. The noise of a step is that which the filters here document.

Source: Labbe, FilterPy; Squire & Trapp 1998, Using complex variables to estimate derivatives of real functions, SIAM
Review 40(1).
"""

import time
from importlib.metadata import version
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
from outcome import Outcome, command_line

from covariant import models, observers
from covariant.signals import Record

jax.config.update("jax_enable_x64", True)
ROWS, REPETITIONS, POSITION, RATE, SPREAD = 300, 5, 1e-3, 1e-2, 0.6
"""Rows of a log, timed runs, standard deviation of a measurement, density of the acceleration noise, α of the UKF."""


class Case(NamedTuple):
    """A model here, its equations again, the start of its log, and the input (m,) at a time."""

    name: str
    model: Any
    slope: Any
    start: list[float]
    inputs: int


def ball(x, u):
    """Ball and beam of Aghannan & Rouchon 2003 with unit numbers, x = (r, θ, r', θ')."""
    r, a, v, w = x
    return np.array([v, w, r * w**2 - np.sin(a), (u[0] - 2 * r * v * w - r * np.cos(a)) / (1 + r**2)])


def pendulums(x, u):
    """Two point masses of 1 kg on rods of 1 m, absolute angles."""
    a, b, v, w = x
    c, s, g = np.cos(a - b), np.sin(a - b), 9.81
    top, low = -s * w**2 - 2 * g * np.sin(a), s * v**2 - g * np.sin(b)
    return np.array([v, w, (top - c * low) / (2 - c**2), (2 * low - c * top) / (2 - c**2)])


def duffing(x, u):
    """The buckled beam of Guckenheimer & Holmes."""
    return np.array([x[1], u[0] - 0.25 * x[1] + x[0] - x[0] ** 3])


CASES = (
    Case("ball and beam", models.ball_and_beam(), ball, [0.3, 0.1, 0.2, -0.3], 1),
    Case("double pendulum", models.pendulum_chain(angles="absolute"), pendulums, [0.8, -0.4, 1.0, 0.5], 2),
    Case("Duffing oscillator", models.duffing(), duffing, [0.5, 0.8], 1),
)


def advanced(slope, x, u, h):
    """One classical Runge–Kutta step."""
    a = slope(x, u)
    b = slope(x + h / 2 * a, u)
    c = slope(x + h / 2 * b, u)
    return x + h / 6 * (a + 2 * b + 2 * c + slope(x + h * c, u))


def jacobian(slope, x, u, h):
    """Of that step, exact to rounding."""
    columns = [advanced(slope, x + 1e-30j * e, u, h).imag / 1e-30 for e in np.eye(len(x))]
    return np.array(columns).T


def log(case: Case, seed: int = 0) -> Record:
    """Irregular stamps, noisy positions, a tenth of them missing; the second half of a row's measurement at times."""
    rng = np.random.default_rng(seed)
    t = np.concatenate([[0.0], np.cumsum(rng.uniform(0.005, 0.015, ROWS - 1))])
    u = 0.3 * np.sin(np.outer(t, np.arange(2.0, 2.0 + case.inputs))) * (case.name != "double pendulum")
    x, rows = np.array(case.start), []
    for k in range(ROWS):
        rows.append(x)
        if k + 1 < ROWS:
            x = advanced(case.slope, x, u[k], t[k + 1] - t[k])
    y = np.array(rows)[:, : len(x) // 2]
    y = y + POSITION * rng.normal(size=y.shape)
    y[1:][rng.random(ROWS - 1) < 0.1] = np.nan
    return Record(t, u, y)


def ours(observer, record: Record):
    """States (T, 2n) and covariances of an observer over a log, and processor time a row [s]."""
    t, u, y = (jnp.asarray(a) for a in (record.t, record.u, record.y))

    def cov(state):
        return observer.cov(state) if isinstance(observer, observers.UKF) else state.cov

    def step(state, row):
        state, info = observer.step(state, *row)
        return state, (observer.estimate(state), cov(state), info.innovation, info.nis)

    @jax.jit
    def whole(t, u, y):
        first = observer.init(y[0], t[0])
        _, rest = jax.lax.scan(step, first, (u[:-1], y[1:], jnp.diff(t)))
        return (observer.estimate(first), cov(first)), rest

    first, rest = jax.block_until_ready(whole(t, u, y))
    spent = []
    for _ in range(REPETITIONS):
        start = time.process_time()
        jax.block_until_ready(whole(t, u, y))
        spent.append(time.process_time() - start)
    seconds = min(spent) / (ROWS - 1)
    return [np.asarray(a) for a in first], [np.asarray(a) for a in rest], seconds


def added(case: Case, kind: str, f, h):
    """Covariance of the noise of a step, as the filters here document it."""
    n = len(case.start) // 2
    if kind == "StateEKF":
        density = RATE * np.diag([0.0] * n + [1.0] * n)
        half = (np.eye(2 * n) + f) / 2
        return h / 6 * (density + 4 * half @ density @ half.T + f @ density @ f.T)
    return RATE * np.kron([[h**3 / 3, h**2 / 2], [h**2 / 2, h]], np.eye(n))


class Extended(ExtendedKalmanFilter):
    """FilterPy's filter with a nonlinear prediction, as its documentation asks for: `predict_x` is replaced."""

    def predict_x(self, u=0):
        self.x = self.ahead


def theirs(case: Case, kind: str, record: Record, first):
    """The same of FilterPy, begun with the same state and covariance."""
    size = len(case.start)
    n, r = size // 2, POSITION**2 * np.eye(size // 2)
    h_matrix = np.eye(n, size)
    if kind == "UKF":
        points = MerweScaledSigmaPoints(size, SPREAD, 2.0, 0.0)
        kalman = UnscentedKalmanFilter(
            size, n, 0.01, lambda x: x[:n], lambda x, dt, u: advanced(case.slope, x, u, dt), points
        )
    else:
        kalman = Extended(size, n)
    kalman.x, kalman.P, kalman.R = np.array(first[0]), np.array(first[1]), r
    rows, start = ([], [], [], []), time.process_time()
    for k in range(1, ROWS):
        h, u, y = record.t[k] - record.t[k - 1], record.u[k - 1], record.y[k]
        measured = None if np.isnan(y).any() else y
        if kind == "UKF":
            kalman.Q = added(case, kind, None, h)
            kalman.predict(dt=h, u=u)
            kalman.update(measured)
        else:
            kalman.ahead, kalman.F = advanced(case.slope, kalman.x, u, h), jacobian(case.slope, kalman.x, u, h)
            kalman.Q = added(case, kind, kalman.F, h)
            kalman.predict()
            if measured is not None:
                kalman.update(measured, lambda x: h_matrix, lambda x: x[:n])
        used = measured is not None
        square = kalman.y @ np.linalg.solve(kalman.S, kalman.y) if used else 0.0
        for row, value in zip(rows, (kalman.x, kalman.P, kalman.y if used else np.zeros(n), square), strict=True):
            row.append(np.array(value))
    seconds = (time.process_time() - start) / (ROWS - 1)
    return [np.array(row) for row in rows], seconds


def observer(case: Case, kind: str):
    """The filter of this library."""
    n = len(case.start) // 2
    noise = POSITION**2 * np.eye(n)
    if kind == "StateEKF":
        density = RATE * np.diag([0.0] * n + [1.0] * n)
        start_cov = np.diag([0.1] * n + [1.0] * n)
        return observers.StateEKF(case.model, density, noise, np.zeros(2 * n), start_cov, substeps=1, gate=None)
    if kind == "UKF":
        return observers.UKF(case.model, RATE * np.eye(n), noise, substeps=1, spread=SPREAD, gate=None)
    return observers.EKF(case.model, RATE * np.eye(n), noise, substeps=1, gate=None)


QUANTITIES = ("estimate", "covariance", "innovation", "normalised innovation squared")


def main() -> None:
    """Every filter on every model that it takes."""
    arguments = command_line()
    outcome = Outcome(f"filterpy {version('filterpy')}")
    rows = []
    for case in CASES:
        record = log(case)
        for kind in ("StateEKF",) if case.name == "Duffing oscillator" else ("EKF", "UKF"):
            first, mine, fast = ours(observer(case, kind), record)
            other, slow = theirs(case, kind, record, first)
            apart = []
            for name, a, b in zip(QUANTITIES, mine, other, strict=True):
                apart.append(float(np.max(np.abs(a - b)) / np.max(np.abs(b))))
                outcome.close(f"{name} of {kind}, {case.name}", apart[-1], 1e-9)
            rows.append((case.name, kind, *(f"{a:.1e}" for a in apart), f"{1e6 * fast:.1f}", f"{1e6 * slow:.0f}"))
    head = ("model", "filter", *QUANTITIES, "covariant [µs a row]", "FilterPy [µs a row]")
    note = (
        "Times are processor time: here of a compiled scan, without compiling it; FilterPy's with the model in NumPy."
    )
    outcome.table("Largest differences, relative to the largest value", head, rows, note)
    outcome.write(arguments.out)


if __name__ == "__main__":
    main()
