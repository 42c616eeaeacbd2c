"""Reproduces Aghannan & Rouchon 2003: figure 4, the basin of attraction, and the tutorial example."""

import functools
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant import models
from covariant.geometry import Budget
from covariant.observers import AbstractFlowObserver, Geodesic, Intrinsic, ModelCopy
from covariant.papers._errata import PrintedBallAndBeam
from covariant.simulation import observe

ALPHA, BETA = 2**0.5, 0.5
"""Gains of figure 4: α = 2ω0, β = ω0², ω0 = √2/2."""
TRUTH = (0.02, 0.0, 0.05, 0.0)
ESTIMATE = (0.021, 0.2, 0.525, 2.0)
"""Initial (r, θ, v_r, v_θ) of plant and observers in figure 4."""
STAMPS = (0.0, 5.0, 10.0, 20.0, 40.0)
MOST_STEPS = 8_000
"""Number of integration steps after which an observer counts as escaped."""
BASINS = ("exact", "approximate")
"""Observers whose basin of attraction is explored."""
SCALES = (0.05, 0.5, 1.0, 1.5, 1.75, 2.0, 4.0, 8.0)


class Trajectory(NamedTuple):
    """Simulation of plant and one observer.

    Attributes:
        t: Stamps (T,) [s].
        x: True states (T, 4), (r, θ, v_r, v_θ).
        y: Measurements (T, 2), (r, θ).
        estimate: Estimates (T, 4).

    Example:
        >>> import numpy as np
        >>> from covariant.papers.aghannan_rouchon import Trajectory
        >>> Trajectory(np.zeros(1), np.zeros((1, 4)), np.zeros((1, 2)), np.array([[3.0, 0.0, 4.0, 0.0]])).error.tolist()
        [5.0]
    """

    t: np.ndarray
    x: np.ndarray
    y: np.ndarray
    estimate: np.ndarray

    @property
    def error(self) -> np.ndarray:
        """Euclidean norm (T,) of (q̂ − q, v̂ − v); not finite after the observer has escaped."""
        with np.errstate(invalid="ignore"):  # infinite once the observer has escaped
            return np.linalg.norm(self.estimate - self.x, axis=1)


def figure4_observers(alpha: float = ALPHA, beta: float = BETA) -> dict[str, AbstractFlowObserver]:
    """Observers compared in figure 4.

    Args:
        alpha: Gain α [1/s].
        beta: Gain β [1/s²].

    Returns:
        The observers by their key in the results.
    """
    plant = _plant()
    return {
        "exact": Geodesic(plant, alpha, beta, Budget(steps=4)),
        "approximate": Intrinsic(plant, alpha, beta),
        "corrected14": Intrinsic(plant, alpha, beta, coefficients="estimated"),
        "printed14": PrintedBallAndBeam(alpha, beta),
        "copy": ModelCopy(plant, alpha, beta),
        "no_curvature": Intrinsic(plant, alpha, beta, curvature=False),
    }


@functools.cache  # the same object at each call, so that compiled programs are reused
def _plant() -> models.Lagrangian:
    return models.ball_and_beam()


def feedback(t, x):
    """Torque of figure 4, u = −20θ + 101r, which keeps the ball swinging near the unstable equilibrium.

    Args:
        t: Time [s].
        x: State (4,).

    Returns:
        The input (1,).
    """
    return (-20 * x[1] + 101 * x[0])[None]


def noise(t):
    """High-frequency disturbance of figure 4.

    Args:
        t: Time [s].

    Returns:
        Error (2,) of the measured r and θ.
    """
    return jnp.stack([0.01 * jnp.sin(50 * t), 0.05 * jnp.sin(40 * t)])


def figure4(
    observer: AbstractFlowObserver, t, noisy: bool = False, scale: float = 1.0, rtol: float = 1e-10
) -> Trajectory:
    """Run one observer on the scenario of figure 4.

    Args:
        observer: An observer of the ball and beam.
        t: Stamps (T,) [s].
        noisy: Whether the measurements contain `noise`.
        scale: Multiple of the paper's initial error.
        rtol: Relative tolerance of the integrator.

    Returns:
        The trajectory.
    """
    return figure4_batch(observer, t, [(noisy, scale, rtol)])[0]


def figure4_batch(observer: AbstractFlowObserver, t, runs: Sequence[tuple[bool, float, float]]) -> list[Trajectory]:
    """Run one observer several times on the scenario of figure 4, in little more than the time of the longest run.

    Args:
        observer: An observer of the ball and beam.
        t: Stamps (T,) [s].
        runs: (noisy, scale, rtol) of each run, as for `figure4`.

    Returns:
        The trajectories in order.
    """
    varied = (jnp.asarray(column, float) for column in zip(*runs, strict=True))
    columns = _figure4(observer, jnp.asarray(t), *varied)
    return [Trajectory(np.asarray(t), *run) for run in zip(*map(np.asarray, columns), strict=True)]


@eqx.filter_jit
@functools.partial(jax.vmap, in_axes=(None, None, 0, 0, 0))
def _figure4(observer, t, amplitude, scale, rtol):
    plant = _plant()
    x0 = jnp.array(TRUTH)
    start = x0 + scale * (jnp.array(ESTIMATE) - x0)
    state0 = observer.init(start[:2])._replace(v=start[2:])

    def measure(s, q):
        return q + amplitude * noise(s)

    # Some runs from outside the basin escape; the limit of steps ends them.
    x, state = observe(
        plant, observer, x0, state0, t, feedback, measure, rtol=rtol, atol=rtol / 100, max_steps=MOST_STEPS
    )
    return x, jax.vmap(measure)(t, x[:, :2]), jnp.concatenate([state.q, state.v], axis=1)


def tutorial(progress: Callable[[str], None] = lambda stage: None) -> dict[str, Any]:
    """Compare observers of one oscillator in the charts q and r = e^q, section III-B.

    Args:
        progress: Called with the name of each stage.

    Returns:
        `initial_error` |ξ|; `geodesic_difference` and `intrinsic_difference`, the largest relative distances, over
        time, between the estimates in both charts mapped to q; `intrinsic_slope`, the order of the latter in |ξ|.
    """
    errors = (0.4, 0.2, 0.1, 0.05)
    progress("tutorial example: exact observer")
    exact = _chart_differences(lambda model: Geodesic(model, ALPHA, BETA, Budget()), errors)
    progress("tutorial example: approximate observer")
    approximate = _chart_differences(lambda model: Intrinsic(model, ALPHA, BETA), errors)
    # `approximate` is relative to the error, so the order is that of the absolute difference.
    slope = np.polyfit(np.log(errors), np.log(np.multiply(errors, approximate)), 1)[0]
    return {
        "initial_error": list(errors),
        "geodesic_difference": exact,
        "intrinsic_difference": approximate,
        "intrinsic_slope": float(slope),
    }


def _chart_differences(
    build: Callable[[models.Lagrangian], AbstractFlowObserver], errors: tuple[float, ...]
) -> list[float]:
    in_q, in_r = build(models.oscillator("q")), build(models.oscillator("r"))

    def chart_r(x):
        return jnp.array([jnp.exp(x[0]), jnp.exp(x[0]) * x[1]])

    differences = []
    for error in errors:
        x0, start = jnp.array([0.3, 0.0]), jnp.array([0.3 + error, error])
        q, v = np.split(_simulate_oscillator(in_q, x0, start), 2, axis=1)
        r, w = np.split(_simulate_oscillator(in_r, chart_r(x0), chart_r(start)), 2, axis=1)
        differences.append(float(max(np.abs(np.log(r) - q).max(), np.abs(w / r - v).max()) / error))
    return differences


@eqx.filter_jit
def _simulate_oscillator(observer, x0, start):
    state = observer.init(start[:1])._replace(v=start[1:])
    t = jnp.linspace(0.0, 10.0, 41)
    estimates = observe(observer.model, observer, x0, state, t, rtol=1e-11, atol=1e-13)[1]
    return jnp.concatenate([estimates.q, estimates.v], axis=1)


def reproduce(progress: Callable[[str], None] = lambda stage: None) -> dict[str, Any]:
    """Compute all reproduced numbers of the paper.

    Args:
        progress: Called with the name of each of `STAGES` stages.

    Returns:
        `fig4` and `fig4_noise` (for each observer `t` and `error`), `basin` (final error of the exact and the
        approximate observer by scale of the initial error), `tutorial`, and `seconds`, the time it took. Values that
        are not finite are None.
    """
    began = time.perf_counter()
    results: dict[str, Any] = {"fig4": {}, "fig4_noise": {}, "basin": {"scale": list(SCALES)}}
    for name, observer in figure4_observers().items():
        basin = SCALES if name in BASINS else ()
        progress(f"figure 4: {name}" + (", and its basin of attraction" if basin else ""))
        # Tolerances are looser if noise at 50 rad/s forces short steps, or if only convergence matters.
        runs = [(False, 1.0, 1e-10), (True, 1.0, 1e-7), *((False, scale, 1e-8) for scale in basin)]
        errors = [_finite(run.error) for run in figure4_batch(observer, STAMPS, runs)]
        for key, error in zip(("fig4", "fig4_noise"), errors, strict=False):
            results[key][name] = {"t": list(STAMPS), "error": error}
        if basin:
            results["basin"][name] = [error[-1] for error in errors[2:]]
    results["tutorial"] = tutorial(progress)
    results["seconds"] = round(time.perf_counter() - began, 1)
    return results


def _finite(values) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


STAGES = len(figure4_observers()) + 2
"""Number of progress reports of `reproduce`."""
LABELS = {
    "exact": "exact observer (2)",
    "approximate": "approximate observer (5)",
    "corrected14": "(14), curvature signs corrected",
    "printed14": "(14) as printed",
    "copy": "copy observer (15)",
    "no_curvature": "(5) without curvature",
}
COLORS = {
    "exact": "navy",
    "approximate": "covariant",
    "corrected14": "sky",
    "printed14": "purple",
    "copy": "amber",
    "no_curvature": "olive",
}
"""Names in the figures' palette, one colour for each observer."""


def figure4_runs(duration: float = 20.0) -> dict[str, Trajectory]:
    """The noisy runs that figure 4 shows.

    Args:
        duration: Length of the runs [s].

    Returns:
        Trajectories at 100 Hz, by the key of the observer.
    """
    t = np.linspace(0.0, duration, int(100 * duration) + 1)
    observers = figure4_observers()
    return {name: figure4(observers[name], t, True, rtol=1e-7) for name in ("approximate", "copy", "printed14")}


def draw(path: Path) -> tuple[Path, Path]:
    """Draw figure 4 and, in a second file with the suffix `_errors`, the errors without noise.

    Args:
        path: File of the first figure.

    Returns:
        The two paths.
    """
    return draw_figure4(figure4_runs(), path), draw_errors(path.with_stem(f"{path.stem}_errors"))


def draw_figure4(runs: dict[str, Trajectory], path: Path) -> Path:
    """Draw panels a–f of figure 4: measured and true positions, and velocities.

    Args:
        runs: As from `figure4_runs`.
        path: File of the figure.

    Returns:
        The path.
    """
    from covariant.report import PALETTE, new_figure, save_figure

    titles = ("a) r, real as measured", "b) θ, real as measured", "c) r", "d) θ", "e) dr/dt", "f) dθ/dt")
    labels = ("r [m]", "θ [rad]", "r [m]", "θ [rad]", "dr/dt [m/s]", "dθ/dt [rad/s]")
    figure, axes = new_figure(3, 2, titles=titles)
    real = next(iter(runs.values()))
    for k, ax in enumerate(axes.flat):
        column = k if k < 2 else k - 2
        truth = real.y[:, column] if k < 2 else real.x[:, column]
        ax.plot(real.t, truth, color=PALETTE.truth, linewidth=2.5, label="real system")
        for name, run in runs.items():
            ax.plot(
                run.t, run.estimate[:, column], linewidth=1.0, color=getattr(PALETTE, COLORS[name]), label=LABELS[name]
            )
        largest = 6 * np.abs(real.x[:, column]).max()
        ax.set_ylim(-largest, largest)
        ax.set_ylabel(labels[k])
        ax.set_xlabel("t [s]" if k > 3 else "")
    axes[0, 0].legend(loc="lower left", ncols=2)
    return save_figure(figure, path)


def draw_errors(path: Path, duration: float = 40.0) -> Path:
    """Draw the error of each observer on figure 4 without noise, on a log axis, with the theoretical e^(−ω0 t).

    Args:
        path: File of the figure.
        duration: Length of the runs [s].

    Returns:
        The path.
    """
    from covariant.report import PALETTE, new_figure, save_figure

    t = np.linspace(0.0, duration, 401)
    figure, axes = new_figure(panel=(8.0, 4.2))
    ax = axes[0, 0]
    for name, observer in figure4_observers().items():
        error = figure4(observer, t, rtol=1e-8).error
        ax.semilogy(
            t, np.where(np.isfinite(error), error, np.nan), color=getattr(PALETTE, COLORS[name]), label=LABELS[name]
        )
    # The response of a double pole at −ω, (1 + ωt)e^(−ωt).
    omega = BETA**0.5
    ax.semilogy(
        t, 2 * (1 + omega * t) * np.exp(-omega * t), ":", color=PALETTE.text, label="theory: double pole at −ω0"
    )
    ax.set_ylim(1e-11, 1e3)
    ax.set_xlabel("t [s]")
    ax.set_ylabel("|(q̂ − q, v̂ − v)|")
    ax.legend()
    return save_figure(figure, path)


def summary(results: dict[str, Any]) -> list[str | list[dict[str, str]]]:
    """Lines and tables to print, from the results of `reproduce`."""
    tutorial = results["tutorial"]
    return [
        "Figure 4, ball and beam: |(q̂ − q, v̂ − v)|",
        error_rows(results["fig4"]),
        decay_line(results["fig4"]),
        "The same with high-frequency noise on the measurements",
        error_rows(results["fig4_noise"]),
        "Error left at t = 40 s, by the initial error as a multiple of that of figure 4",
        basin_rows(results["basin"]),
        f"Tutorial: in the charts q and r the exact observer agrees to {max(tutorial['geodesic_difference']):.1e}, the"
        f" approximate one differs with slope {tutorial['intrinsic_slope']:.2f} in the initial error",
    ]


TITLE = "Aghannan & Rouchon 2003, reproduced"


def page(results: dict[str, Any], figures: tuple[Path, ...]) -> list[Any]:
    """Explanations, tables and figures, one below the other, of the results of `reproduce` and the files of `draw`."""
    return [
        "# Figure 4: ball and beam",
        "Gains α = √2, β = ½ are low on purpose: measurement noise passes little, but the negative curvature of "
        "the ball and beam must be compensated. The exact and the approximate intrinsic observer converge at the "
        "rate of the theory. The copy observer does not, nor does the observer without its curvature term.",
        "Equation (14) is printed with all four curvature terms of the wrong sign: it diverges, here as in any "
        "implementation that follows the print. With the signs of equation (5) it converges.",
        error_rows(results["fig4"]),
        decay_line(results["fig4"]) + ".",
        figures[1],
        "# The same with high-frequency noise on the measurements",
        error_rows(results["fig4_noise"]),
        figures[0],
        "# How large may the first error be?",
        "The initial error of figure 4, scaled: error left after 40 s. The approximate observer stops converging "
        "between 1.5 and 1.75 times that error; the exact one converges at every scale tried.",
        basin_rows(results["basin"]),
        "# Tutorial: one oscillator in two charts",
        "In q and in r = exp(q) the exact observer is one observer: mapped to q, its two estimates agree to "
        f"{max(results['tutorial']['geodesic_difference']):.1e} of the initial error. Those of the approximate "
        f"observer differ with slope {results['tutorial']['intrinsic_slope']:.2f} in that error.",
    ]


def error_rows(runs: dict[str, dict[str, list]]) -> list[dict[str, str]]:
    """Table rows of `fig4` or `fig4_noise`."""
    return [
        {"observer": LABELS[name]}
        | {f"t = {t:g} s": "escaped" if e is None else f"{e:.4g}" for t, e in zip(run["t"], run["error"], strict=True)}
        for name, run in runs.items()
    ]


def decay_line(runs: dict[str, dict[str, list]]) -> str:
    """Sentence that compares the decay of `fig4` from 20 to 40 s with the response of a double pole at −ω0."""
    measured = ", ".join(f"{runs[name]['error'][-1] / runs[name]['error'][-2]:.2e} ({LABELS[name]})" for name in BASINS)
    omega, (begin, end) = BETA**0.5, STAMPS[-2:]
    theory = (1 + omega * end) / (1 + omega * begin) * math.exp(-omega * (end - begin))
    return f"Error at {end:g} s over that at {begin:g} s: {measured}; of a double pole at −ω0 {theory:.2e}"


def basin_rows(basin: dict[str, list]) -> list[dict[str, str]]:
    """Table rows of `basin`."""
    return [
        {"observer": LABELS[name]}
        | {f"{s:g}×": "escaped" if e is None else f"{e:.2g}" for s, e in zip(basin["scale"], basin[name], strict=True)}
        for name in BASINS
    ]
