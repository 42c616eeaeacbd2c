"""Aghannan & Rouchon 2003, reproduced: figure 4, the basin of attraction, the tutorial example."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant import models
from covariant.geometry import Budget
from covariant.observers import AbstractFlowObserver, Copy, Geodesic, Intrinsic
from covariant.papers._errata import PrintedBallAndBeam
from covariant.simulation import observe

ALPHA, BETA = 2**0.5, 0.5
"""Gains of figure 4: α = 2ω0, β = ω0², ω0 = √2/2."""
TRUTH = (0.02, 0.0, 0.05, 0.0)
ESTIMATE = (0.021, 0.2, 0.525, 2.0)
"""Initial (r, θ, v_r, v_θ) of plant and observers in figure 4."""
STAMPS = (0.0, 5.0, 10.0, 20.0, 40.0)
SCALES = (0.05, 0.5, 1.0, 2.0, 4.0, 8.0)


class Trajectory(NamedTuple):
    """Stamps t (T,) [s], true states x (T, 4), measurements y (T, 2) and estimates (T, 4) of one observer."""

    t: np.ndarray
    x: np.ndarray
    y: np.ndarray
    estimate: np.ndarray

    @property
    def error(self) -> np.ndarray:
        """Euclidean norm (T,) of (q̂ − q, v̂ − v); not finite once the observer has escaped."""
        return np.linalg.norm(self.estimate - self.x, axis=1)


def figure4_observers() -> dict[str, AbstractFlowObserver]:
    """The observers compared on figure 4, by their key in the results."""
    plant = models.ball_and_beam()
    return {
        "exact": Geodesic(plant, ALPHA, BETA, Budget()),
        "approximate": Intrinsic(plant, ALPHA, BETA),
        "corrected14": Intrinsic(plant, ALPHA, BETA, coefficients="estimated"),
        "printed14": PrintedBallAndBeam(ALPHA, BETA),
        "copy": Copy(plant, ALPHA, BETA),
        "no_curvature": Intrinsic(plant, ALPHA, BETA, curvature=False),
    }


def feedback(t, x):
    """The torque of figure 4, u = −20θ + 101r, which keeps the ball swinging near the unstable equilibrium."""
    return (-20 * x[1] + 101 * x[0])[None]


def noise(t):
    """The high-frequency disturbance of figure 4 on (r, θ)."""
    return jnp.stack([0.01 * jnp.sin(50 * t), 0.05 * jnp.sin(40 * t)])


def figure4(
    observer: AbstractFlowObserver, t, noisy: bool = False, scale: float = 1.0, rtol: float = 1e-11
) -> Trajectory:
    """Run one observer on the scenario of figure 4, its initial error multiplied by `scale`."""
    x, estimate, y = _figure4(observer, jnp.asarray(t), noisy, jnp.asarray(scale), rtol)
    return Trajectory(np.asarray(t), *(np.asarray(a) for a in (x, y, estimate)))


@eqx.filter_jit
def _figure4(observer, t, noisy, scale, rtol):
    plant = models.ball_and_beam()
    x0 = jnp.array(TRUTH)
    start = x0 + scale * (jnp.array(ESTIMATE) - x0)
    state0 = observer.init(start[:2])._replace(v=start[2:])

    def measure(s, q):
        return q + noise(s) if noisy else q

    x, state = observe(plant, observer, x0, state0, t, feedback, measure, rtol=rtol, atol=rtol / 100)
    return x, jnp.concatenate([state.q, state.v], axis=1), jax.vmap(measure)(t, x[:, :2])


def tutorial() -> dict[str, Any]:
    """Section III-B: the same oscillator in q and in r = e^q.

    `geodesic_difference` and `intrinsic_difference` are the largest relative distances, over time, between the two
    charts' estimates mapped to q, for an initial error ξ; `intrinsic_slope` is the order of the second in |ξ|.
    """
    errors = (0.4, 0.2, 0.1, 0.05)
    t = jnp.linspace(0.0, 10.0, 41)
    exact = [_chart_difference(lambda m: Geodesic(m, ALPHA, BETA, Budget()), e, t) for e in errors]
    approximate = [_chart_difference(lambda m: Intrinsic(m, ALPHA, BETA), e, t) for e in errors]
    slope = np.polyfit(np.log(errors), np.log([e * d for e, d in zip(errors, approximate, strict=True)]), 1)[0]
    return {
        "initial_error": list(errors),
        "geodesic_difference": exact,
        "intrinsic_difference": approximate,
        "intrinsic_slope": float(slope),
    }


def _chart_difference(build: Callable[[models.Lagrangian], AbstractFlowObserver], error: float, t) -> float:
    in_q, in_r = models.oscillator("q"), models.oscillator("r")
    x0, start = jnp.array([0.3, 0.0]), jnp.array([0.3 + error, error])

    def chart_r(x):
        return jnp.array([jnp.exp(x[0]), jnp.exp(x[0]) * x[1]])

    def run(model, x, first):
        observer = build(model)
        state = observer.init(first[:1])._replace(v=first[1:])
        return observe(model, observer, x, state, t, rtol=1e-12, atol=1e-14)[1]

    q, r = eqx.filter_jit(run)(in_q, x0, start), eqx.filter_jit(run)(in_r, chart_r(x0), chart_r(start))
    mapped = np.concatenate([np.log(r.q), np.asarray(r.v) / np.asarray(r.q)], axis=1)
    plain = np.concatenate([q.q, q.v], axis=1)
    return float(np.abs(mapped - plain).max() / error)


def reproduce(progress: Callable[[str], None] = lambda stage: None) -> dict[str, Any]:
    """Everything of the paper that is a number; not finite values become None.

    Keys: `fig4` and `fig4_noise` (per observer `t` and `error`), `basin` (final error of the exact and the approximate
    observer by scale of the initial error), `tutorial`, and `seconds`, the time it took.
    """
    began = time.perf_counter()
    results: dict[str, Any] = {"fig4": {}, "fig4_noise": {}, "basin": {"scale": list(SCALES)}}
    for key, noisy in (("fig4", False), ("fig4_noise", True)):
        for name, observer in figure4_observers().items():
            progress(f"figure 4{' with noise' if noisy else ''}: {name}")
            run = figure4(observer, STAMPS, noisy, rtol=1e-9 if noisy else 1e-11)
            results[key][name] = {"t": list(STAMPS), "error": _finite(run.error)}
    for name in ("exact", "approximate"):
        progress(f"basin of attraction: {name}")
        observer = figure4_observers()[name]
        final = [figure4(observer, STAMPS, scale=scale, rtol=1e-8).error[-1] for scale in SCALES]
        results["basin"][name] = _finite(final)
    progress("tutorial example")
    results["tutorial"] = tutorial()
    results["seconds"] = round(time.perf_counter() - began, 1)
    return results


def _finite(values) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


STAGES = 2 * len(figure4_observers()) + 4
"""Number of times `reproduce` and the drawing that may follow report progress."""


def figure4_runs(duration: float = 20.0) -> dict[str, Trajectory]:
    """The noisy runs that figure 4 shows, finely sampled: by key, without the exact observer."""
    t = np.linspace(0.0, duration, int(100 * duration) + 1)
    observers = figure4_observers()
    return {name: figure4(observers[name], t, True, rtol=1e-8) for name in ("approximate", "printed14", "copy")}


def draw_figure4(runs: dict[str, Trajectory], path: Path) -> Path:
    """Panels a–f of figure 4: positions as measured, as they are, and velocities; returns the path."""
    from covariant.report import new_figure, save_figure

    titles = ("a) r, measured", "b) θ, measured", "c) r", "d) θ", "e) dr/dt", "f) dθ/dt")
    labels = ("r [m]", "θ [rad]", "r [m]", "θ [rad]", "dr/dt [m/s]", "dθ/dt [rad/s]")
    figure, axes = new_figure(3, 2, titles=titles)
    real = next(iter(runs.values()))
    shown = {"approximate": "intrinsic observer (5)", "copy": "copy observer (15)", "printed14": "(14) as printed"}
    for k, ax in enumerate(axes.flat):
        truth = real.y[:, k] if k < 2 else real.x[:, k - 2]
        ax.plot(real.t, truth, color="0.65", linewidth=2.5, label="real system")
        for name, label in shown.items():
            ax.plot(runs[name].t, runs[name].estimate[:, k % 2 if k < 2 else k - 2], linewidth=1, label=label)
        reach = 4 * np.abs(truth).max()
        ax.set_ylim(-reach, reach)
        ax.set_ylabel(labels[k])
        ax.set_xlabel("t [s]" if k > 3 else "")
    axes[0, 0].legend(loc="lower left", fontsize=7, ncols=2)
    return save_figure(figure, path)
