"""What the choice of coordinates does to Kalman filters: the same machine, motion and noise in ten random charts.

For the intrinsic filter and an EKF, both told the same noise at the start: least, median and largest velocity error of
the ten charts after settling, and the number of runs that diverged, that is, whose velocity was off by more than it was
large in the end, or not finite. First errors and noise are up to very large ones. Run `python benchmarks/lottery.py`
from the repository's root.
"""

import sys

import jax.numpy as jnp
import numpy as np

sys.path.append("tests/observers")

from test_intrinsic_kalman import DRAWS, LOTTERIES, draws, intrinsic_kalman, player, recorded

from covariant.models import Motion
from covariant.observers import EKF

SIZES = [(0.3, 0.02), (0.3, 0.1), (1.0, 0.1), (1.0, 0.3), (2.0, 0.3)]
"""First error and noise of a sample [rad, in metric units of the frame]."""
PROCESS, SPEED = 0.5, 3.0
SETTLED, END = 20, 5


def ekf(z):
    """An EKF made for a model in a chart; where it starts, its noise is that of the metric."""

    def make(model, noise):
        spread = jnp.linalg.inv(model.space(jnp.array(z)))
        return EKF(model, PROCESS**2 * spread, noise**2 * spread, SPEED, substeps=2, gate=None)

    return make


def errors(estimates: np.ndarray, true: Motion) -> tuple[np.ndarray, int]:
    """Settled velocity errors (DRAWS,), and how many runs diverged."""
    v = np.asarray(true.v)[1:]
    off = np.linalg.norm(estimates - v, axis=2)
    kept = off[:, -END:].mean(axis=1) < np.linalg.norm(v[-END:], axis=1).mean()  # False where it is not finite
    return np.sqrt(np.mean(off[:, SETTLED:] ** 2, axis=1)), int((~kept).sum())


if __name__ == "__main__":
    print(
        "| machine | first error, noise | filter | least | median | largest | diverged |\n|---|---|---|--:|--:|--:|--:|"
    )
    for name, case in LOTTERIES.items():
        played = {"intrinsic-kalman": player(case, intrinsic_kalman), "ekf": player(case, ekf(case.z))}
        for first, noise in SIZES:
            true, y = recorded(case._replace(first_error=first, noise=noise))
            for each, play in played.items():
                estimates = np.stack([play(y, jnp.asarray(noise), draw) for draw in draws(case)])
                found, lost = errors(estimates, true)
                three = " | ".join(f"{value:.3g}" for value in (np.min(found), np.median(found), np.max(found)))
                print(f"| {name} | {first}, {noise} | {each} | {three} | {lost} of {DRAWS} |", flush=True)
