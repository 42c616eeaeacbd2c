"""Simulated logs of several machines, right or with one fault, for counting what `diagnose` says of them.

A machine is integrated by Runge and Kutta's method with `STEPS` steps a row, under inputs that are held between rows or
go linearly; nothing of the library's smoothing or fitting is used.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant.models import ModelFile, acceleration, load
from covariant.signals import Record

ROWS, PERIOD, STEPS = 1500, 0.004, 8


class Machine(NamedTuple):
    """A machine: its model, the size of its inputs, and how far from zero it starts."""

    model: str
    overrides: tuple[str, ...]
    push: tuple[float, ...]
    start: float


MACHINES = {
    "pendulum": Machine("examples/dfki_simple_pendulum.toml", ("inputs.lag=0",), (3.0,), 2.0),
    "double pendulum": Machine("examples/demo_double_pendulum.toml", (), (0.4, 0.2), 2.0),
    "oscillator": Machine("oscillator", (), (1.0,), 1.0),
}


class Made(NamedTuple):
    """A log with the model file that describes it, and the exact positions at its stamps."""

    file: ModelFile
    record: Record
    exact: np.ndarray
    quantum: float
    std: float


@eqx.filter_jit
def _moved(model, t, u, slope, start):
    """States (T, 2n) at the stamps; within a row the input is u + slope (t − stamp)."""
    n = start.shape[0] // 2

    def flow(t, x, u):
        return jnp.concatenate([x[n:], acceleration(model, t, x[:n], x[n:], u)])

    def row(x, item):
        begin, h, u, slope = item

        def step(k, x):
            now, half = begin + k * h, h / 2
            acting = [u + slope * (k * h + s) for s in (0.0, half, h)]
            a = flow(now, x, acting[0])
            b = flow(now + half, x + half * a, acting[1])
            c = flow(now + half, x + half * b, acting[1])
            d = flow(now + h, x + h * c, acting[2])
            return x + h / 6 * (a + 2 * b + 2 * c + d)

        new = jax.lax.fori_loop(0, STEPS, step, x)
        return new, new

    h = jnp.diff(t) / STEPS
    return jnp.concatenate([start[None], jax.lax.scan(row, start, (t[:-1], h, u[:-1], slope))[1]])


def inputs(random: np.random.Generator, t: np.ndarray, sizes: tuple[float, ...], fast: bool) -> np.ndarray:
    """Sums of sines, or values that jump every few rows."""
    count = len(sizes)
    if fast:
        every = int(random.integers(1, 6))
        values = random.uniform(-1, 1, (len(t) // every + 1, count))
        return np.repeat(values, every, axis=0)[: len(t)] * sizes
    phases = random.uniform(0, 2 * np.pi, (3, count))
    speeds = np.array([2.0, 5.0, 11.0])[:, None]
    return sizes * np.mean(np.sin(speeds[:, None] * t[None, :, None] + phases[:, None]), axis=0)


def made(name: str, seed: int, fast: bool = False, between: str = "held", counts: float = 0, sheet=()) -> Made:
    """A log without a fault.

    Args:
        name: Key of `MACHINES`.
        seed: Seed of start, inputs, noise, jitter and missing cells.
        fast: Whether inputs jump every few rows.
        between: How inputs go from row to row, which the model file says.
        counts: Counts of the encoders a turn; 0 for noise instead.
        sheet: Further overrides of the model file.
    """
    machine, random = MACHINES[name], np.random.default_rng(seed)
    std = 10 ** random.uniform(-4.5, -2.8)
    sensor = f"measurement.quantum={2 * np.pi / counts}" if counts else f"measurement.std={std}"
    other = f'inputs.between="{between}"'
    file = load(machine.model, (*machine.overrides, sensor, other, *sheet))
    if not counts:
        file = file._replace(quantum=None)
    t = PERIOD * np.arange(ROWS)
    t = t + random.uniform(-0.05, 0.05, ROWS) * PERIOD * (seed % 2)
    u = inputs(random, t, machine.push, fast)
    slope = np.diff(u, axis=0) / np.diff(t)[:, None] * (between == "linear")
    start = random.uniform(-machine.start, machine.start, 2 * file.dimension)
    exact = np.asarray(_moved(file.model, *map(jnp.asarray, (t, u, slope, start))))[:, : file.dimension]
    y = sensed(random, exact, 2 * np.pi / counts if counts else 0.0, std)
    y[1:][random.random((ROWS - 1, y.shape[1])) < 0.02 * (seed % 3 == 1)] = np.nan
    names = [f"{letter}{i + 1}" for letter, n in (("q", y.shape[1]), ("u", u.shape[1])) for i in range(n)]
    columns = file.columns._replace(q=tuple(names[: y.shape[1]]), u=tuple(names[y.shape[1] :]))
    return Made(file._replace(columns=columns), Record(t, u, y), exact, 2 * np.pi / counts if counts else 0.0, std)


def sensed(random: np.random.Generator, exact: np.ndarray, quantum: float, std: float) -> np.ndarray:
    """Positions as encoders of this step, or sensors with this noise, read them."""
    return np.round(exact / quantum) * quantum if quantum else exact + random.normal(0, std, exact.shape)


def rows_late(y: np.ndarray, column: int, rows: int) -> np.ndarray:
    """The positions with one column moved down by some rows."""
    y = y.copy()
    y[rows:, column] = y[: len(y) - rows, column]
    return y


def seconds_late(t: np.ndarray, values: np.ndarray, columns: list[int], time: float) -> np.ndarray:
    """Values with some columns late by a time [s], interpolated linearly."""
    values = values.copy()
    for i in columns:
        seen = np.isfinite(values[:, i])
        values[:, i] = np.interp(t - time, t[seen], values[seen, i])
    return values
