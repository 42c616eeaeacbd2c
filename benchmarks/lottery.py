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

from test_intrinsic_kalman import LOTTERIES, draws, isotropic, player, recorded

from covariant.geometry import Budget
from covariant.models import Motion
from covariant.observers import EKF

SIZES = [(0.3, 0.02), (0.3, 0.1), (1.0, 0.1), (1.0, 0.3), (2.0, 0.3)]
"""First error and noise of a sample [rad, in metric units of the frame]."""
PROCESS, SPEED = 0.5, 3.0
SETTLED, END = 20, 5


def intrinsic_kalman(model, noise):
    """With a budget that finds geodesics of a radian and more to four digits, whatever the chart."""
    budget = Budget(newton=4, steps=6)
    return isotropic(model, PROCESS, noise, SPEED, gate=None, budget=budget, substeps=4)


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
    print("| machine | first error, noise [rad] | intrinsic Kalman | EKF: best, median, worst | diverged |")
    print("|---|---|--:|--:|--:|")
    for name, case in LOTTERIES.items():
        players = player(case, intrinsic_kalman), player(case, ekf(case.z))
        for first, noise in SIZES:
            true, y = recorded(case._replace(first_error=first, noise=noise))
            (own, lost), (other, also_lost) = (
                errors(np.stack([play(y, jnp.asarray(noise), draw) for draw in draws(case)]), true) for play in players
            )
            words = f"{np.min(own):.3g} to {np.max(own):.3g}"
            three = ", ".join(f"{value:.3g}" for value in (np.min(other), np.median(other), np.max(other)))
            print(f"| {name} | {first}, {noise} | {words} | {three} | {lost}, {also_lost} |", flush=True)
