"""Time of a step for late readings in C, as a multiple of a step without delay: `python benchmarks/delayed.py`.

All of one run, on one log at a regular rate; least processor time of several repeats. Delays are in rows.
"""

import time

import jax.numpy as jnp
import numpy as np

from covariant.engine import run_log
from covariant.models import pendulum_chain
from covariant.observers import EKF, Delayed, Intrinsic, IntrinsicKalman
from covariant.signals import Record

PERIOD, ROWS, REPEATS = 0.005, 20_000, 25
DELAYS = (0.0, 0.4, 1.0, 2.5, (0.0, 2.5), (0.0, 5.0))
CHAIN = pendulum_chain((0.6, 0.4), (0.3, 0.25), com=(0.16, 0.14), inertia=(0.005, 0.0026), viscous=(0.012, 0.008))
NOISE = 0.1 * jnp.eye(2), 1e-8 * jnp.eye(2)
OBSERVERS = {
    "intrinsic": Intrinsic(CHAIN, 60.0, 1800.0, substeps=1),
    "ekf": EKF(CHAIN, *NOISE, substeps=1),
    "intrinsic-kalman": IntrinsicKalman(CHAIN, *NOISE, 4.0 * jnp.eye(2), substeps=1),
}


def log() -> Record:
    """Two angles that move, with noise, and inputs held between the stamps."""
    random, t = np.random.default_rng(0), PERIOD * np.arange(ROWS)
    y = np.stack([0.5 * np.sin(3 * t), 0.4 * np.cos(2 * t)], axis=1) + random.normal(0, 1e-4, (ROWS, 2))
    return Record(t, random.normal(0, 0.4, (ROWS, 2)), y)


def seconds(observer, record: Record) -> float:
    """Least time of a run over the log in C, once it is compiled."""
    times = []
    for _ in range(REPEATS + 1):
        start = time.process_time()
        _, engine = run_log(observer, record, ("result",), "c")
        times.append(time.process_time() - start)
        assert engine == "c", engine
    return min(times[1:])


if __name__ == "__main__":
    record = log()
    for name, observer in OBSERVERS.items():
        plain = seconds(observer, record)
        print(f"{name}: {1e9 * plain / ROWS:.0f} ns a step without delay")
        for delay in DELAYS:
            late = seconds(Delayed(observer, PERIOD * np.asarray(delay), 1 / PERIOD), record)
            print(f"  delay of {delay} rows: {late / plain:.2f}", flush=True)
