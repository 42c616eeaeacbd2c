"""Time of a contraction metric on a grid of 10⁵ states, beside a loop of `scipy.integrate.solve_ivp`.

Both solve equation (15) for the oscillator of unknown frequency, λ = 1, with a past so long that what came before it
changes P by less than 1e-8. The loop is what one would write down from the paper: back along the solution with dense
output, forward with the metric. It runs on a few of the states, in the same process; a line compares the times.
"""

import os
import time

import numpy as np
from scipy.integrate import solve_ivp

from covariant import metrics, models
from covariant.metrics import Equation
from covariant.papers.sanfelice_praly import analytic_metric

COUNTS = (50, 50, 40)
LOOPED = 20
RATE, TOLERANCE = 1.0, 1e-8


def loop(x: np.ndarray, length: float) -> np.ndarray:
    """The paper's three steps at one state, with its Jacobians written by hand."""
    output = np.array([[1.0, 0.0, 0.0]])

    def f(t, x):
        return np.array([x[1], -x[2] * x[0], 0.0])

    back = solve_ivp(f, (0.0, -length), x, method="DOP853", rtol=1e-10, atol=1e-12, dense_output=True)

    def forward(t, p):
        p = p.reshape(3, 3)
        x1, _, x3 = back.sol(t)
        a = np.array([[0.0, 1.0, 0.0], [-x3, 0.0, -x1], [0.0, 0.0, 0.0]])
        return (-p @ a - a.T @ p + output.T @ output - RATE * p).ravel()

    done = solve_ivp(forward, (-length, 0.0), np.eye(3).ravel(), method="DOP853", rtol=1e-10, atol=1e-12)
    return done.y[:, -1].reshape(3, 3)


def distance(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.sum(np.log(np.linalg.eigvals(np.linalg.solve(a, b)).real) ** 2)))


def test_grid_beside_a_loop(benchmark, tmp_path):
    benchmark.group = f"metric on {np.prod(COUNTS)} states, λ = {RATE:g}, error bound {TOLERANCE:g}"
    model = models.unknown_frequency()
    low, high = zip(*model.box, strict=True)
    grid = metrics.Grid(model.coordinates, model.units, low, high, COUNTS)
    runs = iter(range(100))

    def work():
        path = tmp_path / f"{next(runs)}.zarr"
        return metrics.metric_on_grid(model, Equation(RATE), grid, path, tolerance=TOLERANCE)

    path = benchmark.pedantic(work, rounds=1, warmup_rounds=0)
    store = metrics.open_grid(path, complete=True)
    exact = analytic_metric(RATE)
    chosen = np.random.default_rng(0).integers(0, COUNTS, (LOOPED, 3))
    points = [np.array([axis[i] for axis, i in zip(grid.axes, index, strict=True)]) for index in chosen]
    began = time.perf_counter()
    looped = [loop(x, float(store.horizon[tuple(i)])) for x, i in zip(points, chosen, strict=True)]
    of_loop = (time.perf_counter() - began) / LOOPED
    of_grid = benchmark.stats.stats.min / grid.size
    errors = [
        (distance(np.asarray(exact(x)), np.asarray(store.metric[tuple(i)])), distance(np.asarray(exact(x)), p))
        for x, i, p in zip(points, chosen, looped, strict=True)
    ]
    ours, theirs = np.max(errors, axis=0)
    print(
        f"\n{grid.size} states on {os.cpu_count()} cores, compiled and stored: {1e6 * of_grid:.0f} µs a state, error"
        f" {ours:.1e}; solve_ivp: {1e3 * of_loop:.1f} ms a state, error {theirs:.1e}: {of_loop / of_grid:.0f} times"
        " as fast"
    )
    assert of_loop / of_grid > 100
    assert ours < 2 * TOLERANCE
