"""What is certified on the same box by linear matrix inequalities of Lipschitz and polytopic observers, and here.

Run `python benchmarks/certified.py` from the repository's root. Each design is to make squared distances shrink at a
rate, for all states in the box of the model: a gain K by the Lipschitz constant of what is not linear (Raghavan
and Hedrick 1994), one by the corners of the interval in which each entry of the Jacobian stays (Zemouche and Boutayeb
2013), and the observers of `certificates.reduced_order`. Lipschitz constant and intervals are those of a grid of
states, which favours the first two: theirs are no proofs. Prints the table of docs/contracting.md.
"""

import itertools
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from covariant import models
from covariant.certificates import observer_gain, reduced_order
from covariant.certificates.theory._lmi import minimise
from covariant.models import StateSpace

SYSTEMS = {
    "lorenz": (1.0, {}),
    "duffing": (1.0, {"inputs": [(-1.0, 1.0)]}),
    "van_der_pol": (1.0, {}),
    "unknown_frequency": (0.1, {"box": [(0.1, 1.0), (1.0, 1.5), (0.5, 1.5)]}),
}
"""Models, the rate [1/s] that is asked for, and bounds where they are not those of the model."""
FACTORS = 2.0 ** np.arange(-6, 7)
"""The rates that are tried, as multiples of it."""
GRID = 21


def jacobians(model: StateSpace, box: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Jacobians (k, n, n) on a grid of states, and H (p, n)."""
    axes = [np.linspace(low, high, GRID) for low, high in box]
    states = jnp.asarray(np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(box)))
    still, u = jnp.zeros(()), jnp.zeros(model.inputs or 0)
    f, h = jax.jit(jax.vmap(lambda x: model.jacobians(still, x, u)))(states)
    return np.asarray(f), np.asarray(h[0])


def lipschitz(f: np.ndarray, h: np.ndarray, rate: float) -> np.ndarray | None:
    """K of the Lipschitz observer, around the middle of the Jacobians; None where the inequality has no solution."""
    middle = (f.max(0) + f.min(0)) / 2
    constant, (p, n) = np.linalg.norm(f - middle, ord=2, axis=(1, 2)).max(), h.shape
    size, entries = max(constant, 1.0), n * (n + 1) // 2
    lower = np.tril_indices(n)

    def metric(x):
        m = np.zeros((n, n))
        m[lower] = x[:entries]
        return m + np.tril(m, -1).T

    def inequality(x):
        m, y, weight = metric(x), x[entries:-1].reshape(n, p), x[-1]
        flow = m @ middle - y @ h
        corner = -(flow + flow.T) - rate * m - weight * constant**2 * np.eye(n)
        # The metric is divided by the constant, so that entries are of one size.
        return np.block([[corner / size, -m / np.sqrt(size)], [-m / np.sqrt(size), weight * np.eye(n)]])

    x = minimise(np.eye(entries + n * p + 1)[-1], [inequality, lambda x: metric(x) - np.eye(n)])
    return None if x is None else np.linalg.solve(metric(x), x[entries:-1].reshape(n, p))


def polytopic(f: np.ndarray, h: np.ndarray, rate: float) -> np.ndarray | None:
    """K for all corners of the intervals of the entries; None where there is none."""
    low, high = f.min(0), f.max(0)
    varying = np.argwhere(high > low)
    corners = []
    for ends in itertools.product((0, 1), repeat=len(varying)):
        corner = low.copy()
        for (i, j), end in zip(varying, ends, strict=True):
            corner[i, j] = (low, high)[end][i, j]
        corners.append(corner)
    try:
        return observer_gain(np.array(corners), np.repeat(h[None], len(corners), 0), rate).gain
    except ValueError:
        return None


def reduced(model: StateSpace, rate: float, bounds: dict) -> np.ndarray | None:
    """L of the reduced-order observer, where it is proved."""
    try:
        design = reduced_order(model, rate, boxes=100_000, **bounds)
    except ValueError:
        return None
    return design.injection if design.statement.proved else None


def full(model: StateSpace, rate: float, bounds: dict) -> np.ndarray | None:
    """K of the full observer that belongs to it, at half of the rate it is designed for, where it is proved."""
    design = reduced_order(model, 2 * rate, boxes=100_000, full=True, **bounds)
    return design.gain * design.direction if design.full is not None and design.full.proved else None


def row(design: Callable[[float], np.ndarray | None], rate: float, factors: np.ndarray) -> str:
    """The largest rate of those tried for which there is a design, and the norm of the gain at the rate asked for."""
    began, largest = time.process_time(), 0.0
    for each in rate * factors:
        if design(each) is None:
            break
        largest = each
    gain = design(rate) if largest >= rate else None
    size = "none" if gain is None else f"{np.linalg.norm(gain, 2):.3g}"
    more = "≥ " if largest == rate * factors[-1] else ""
    return f"{more}{largest:.3g} | {size} | {time.process_time() - began:.1f}"


if __name__ == "__main__":
    print("| system | design | largest rate [1/s] | gain at the rate asked for | s |\n|---|---|---|---|---|")
    for name, (rate, bounds) in SYSTEMS.items():
        model = getattr(models, name)()
        f, h = jacobians(model, bounds.get("box", model.box))
        for what, design in {
            "Lipschitz": lambda r, f=f, h=h: lipschitz(f, h, r),
            "polytopic": lambda r, f=f, h=h: polytopic(f, h, r),
            "reduced order": lambda r, model=model, bounds=bounds: reduced(model, r, bounds),
            "its full observer": lambda r, model=model, bounds=bounds: full(model, r, bounds),
        }.items():
            factors = FACTORS if what != "its full observer" else np.ones(1)
            print(f"| {name}, asked for {rate:g} 1/s | {what} | {row(design, rate, factors)} |", flush=True)
