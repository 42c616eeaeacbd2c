"""How large may the initial error be? Basins of observers with sampled measurements, by gain and sampling interval.

Each observer starts with an error of position and velocity that is a multiple of one direction: on the ball and beam
that of figure 4 of Aghannan & Rouchon 2003, on the double pendulum .2 rad and 2 rad/s a joint, on the heavy top .3 rad
and 2 rad/s. It converges if the error is below .01 rad, m, rad/s and m/s after a time of 25/ω. The basin is the largest
multiple, in steps of √2 up to 128, up to which all converge.

The gains are α = 2ω, β = ω², as for figure 4, with ω a multiple of the case's slowest. The Kalman filter is told the
noise for which its bandwidth is ω in the end, and a first velocity error of 2. The samples are exact, and all observers
know the model. A star marks a basin with holes, where larger errors converge too.

Run `python benchmarks/basins.py` from the repository's root, with the name of one case or none.
"""

import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant import models
from covariant.geometry import Budget
from covariant.models import MechanicalSystem, Motion
from covariant.observers import Geodesic, ImplicitGeodesic, Intrinsic, IntrinsicKalman
from covariant.papers.aghannan_rouchon import feedback

SCALES = 2.0 ** np.arange(-2, 7.1, 0.5)
"""Multiples of the first error, .25 to 128."""
FACTORS = (1, 4, 16)
"""ω as a multiple of the case's slowest."""
BUDGET = Budget(newton=3, steps=8)


class Case(NamedTuple):
    """A system, where its motion starts, its input, and the direction of the first error."""

    name: str
    model: MechanicalSystem
    start: Motion
    inputs: Callable[[Motion], Any]
    xi: Any
    zeta: Any
    slowest: float


def fig4(motion):
    """Torque of figure 4."""
    return feedback(0.0, jnp.concatenate(motion))


def nothing(motion):
    """No input."""
    return jnp.zeros_like(motion.v)


CASES = (
    Case(
        "ball and beam",
        models.ball_and_beam(),
        Motion(jnp.array([0.02, 0.0]), jnp.array([0.05, 0.0])),
        fig4,
        jnp.array([0.001, 0.2]),
        jnp.array([0.475, 2.0]),
        2**-0.5,
    ),
    Case(
        "double pendulum",
        models.pendulum_chain(),
        Motion(jnp.array([1.2, -0.4]), jnp.zeros(2)),
        nothing,
        jnp.array([0.2, 0.2]),
        jnp.array([2.0, -2.0]),
        4.0,
    ),
    Case(
        "heavy top",
        models.heavy_top(),
        Motion(jnp.eye(3), jnp.array([0.5, 0.3, 8.0])),
        nothing,
        jnp.array([0.2, -0.2, 0.1]),
        jnp.array([1.5, 1.0, -1.0]),
        2.0,
    ),
)


def kalman(model, alpha, beta, h):
    """With densities S_a = ω⁴ S_m, S_m = noise² h: the bandwidth of α and β, once it has settled."""
    n, noise = model.manifold.zero(model.manifold.origin()).shape[0], 1e-3
    cov = noise**2 * jnp.eye(n)
    return IntrinsicKalman(model, beta**2 * h * cov, cov, 4.0 * jnp.eye(n), gate=None, budget=BUDGET, substeps=4)


OBSERVERS = {
    "intrinsic": lambda model, alpha, beta, h: Intrinsic(model, alpha, beta, substeps=4),
    "geodesic": lambda model, alpha, beta, h: Geodesic(model, alpha, beta, BUDGET, substeps=4),
    "intrinsic-kalman": kalman,
    "implicit-geodesic": lambda model, alpha, beta, h: ImplicitGeodesic(model, alpha, beta, BUDGET, substeps=4),
}


@eqx.filter_jit
def final_errors(case: Case, observer, scales, h, count):
    """Error (K,) of position and velocity at the end, of observers started at multiples of the first error."""
    model = case.model
    fine = 8

    def truth(k, motion, u):
        return models.advance(model, k * h, motion, u, h, fine)

    def run(scale):
        q = model.manifold.retract(case.start.q, scale * case.xi)
        state = observer.init(q)._replace(v=case.start.v + scale * case.zeta)

        def step(k, carry):
            motion, state = carry
            u = case.inputs(motion)
            motion = truth(k.astype(float), motion, u)
            return motion, observer.step(state, u, motion.q, h)[0]

        motion, state = jax.lax.fori_loop(0, count, step, (case.start, state))
        off = jnp.concatenate([model.manifold.towards(motion.q, state.q), state.v - motion.v])
        return jnp.linalg.norm(off)

    return jax.vmap(run)(scales)


def basin(errors: np.ndarray) -> str:
    """Largest scale up to which all errors are small."""
    fine = np.isfinite(errors) & (errors < 0.01)
    held = int(np.argmin(fine)) if not fine.all() else len(fine)
    more = "*" if fine[held:].any() else ""
    return ("none" if held == 0 else f"{SCALES[held - 1]:.3g}" + (" or more" if held == len(fine) else "")) + more


if __name__ == "__main__":
    chosen = sys.argv[1:] or [case.name for case in CASES]
    for case in CASES:
        if case.name not in chosen:
            continue
        columns = [f"ω = {f * case.slowest:.3g}, ωh = {r:g}" for f in FACTORS for r in (0.05, 0.5)]
        print(f"\n| {case.name} | " + " | ".join(columns) + " |\n|---" + "|--:" * len(columns) + "|")
        for name, make in OBSERVERS.items():
            row = []
            for factor in FACTORS:
                omega = factor * case.slowest
                for ratio in (0.05, 0.5):
                    h = ratio / omega
                    observer = make(case.model, jnp.asarray(2 * omega), jnp.asarray(omega**2), h)
                    count = jnp.asarray(int(25 / ratio))
                    errors = final_errors(case, observer, jnp.asarray(SCALES), jnp.asarray(h), count)
                    row.append(basin(np.asarray(errors)))
            print(f"| {name} | " + " | ".join(row) + " |", flush=True)
