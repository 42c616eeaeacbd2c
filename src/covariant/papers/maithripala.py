"""Reproduces Maithripala, Berg & Dayawansa 2004: the heavy top of their figure 1, and the effect of misprints.

The paper states neither inertia nor initial state; those below are chosen. The theoretical rates depend on neither.
"""

import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant import models
from covariant.geometry.lie import SO3, LeftInvariant
from covariant.observers import AbstractFlowObserver, Intrinsic
from covariant.papers._errata import PrintedGroup
from covariant.simulation import observe, simulate

ALPHA = BETA = 10.0
"""Gains of figure 1."""
TOP, DISC = (0.2, 0.2, 0.1), (0.1, 0.1, 0.19)
"""Principal inertias [kg m²] of an elongated top and of a disc, both symmetric."""
TILT, MISALIGNED = (0.3, 0.2, 0.0), (0.1, -0.15, 0.05)
"""Rotation vectors [rad] of the initial attitude of the top, and of the initial error of the estimate."""
SPINNING, TUMBLING = (1.0, -0.5, 5.0), (10.0, 0.0, 1.0)
"""Initial angular velocities [rad/s]: about the axis, and perpendicular to it, where a disc has negative curvature."""
PRINTED = ("curvature sign", "curvature count")
"""The curvature (8) and its sign in (18) as printed, as entries of `SLIPS`."""
UNEQUAL = (1.0, 2.0, 3.5)
"""Principal inertias of a body on which the two logarithms are compared."""
POINTS = 601
"""Number of stamps of every run; it is the same for all, so that an observer is compiled once."""
STAGES = 7
"""Number of progress reports of `reproduce`."""


class Trajectory(NamedTuple):
    """Simulation of a top and one observer.

    Attributes:
        t: Stamps (T,) [s].
        v: True angular velocities (T, 3) [rad/s] in the body frame.
        estimate: Estimated angular velocities (T, 3).

    Example:
        >>> import numpy as np
        >>> from covariant.papers.maithripala import Trajectory
        >>> Trajectory(np.zeros(1), np.zeros((1, 3)), np.array([[3.0, 0.0, 4.0]])).error.tolist()
        [5.0]
    """

    t: np.ndarray
    v: np.ndarray
    estimate: np.ndarray

    @property
    def error(self) -> np.ndarray:
        """Euclidean norm (T,) of the velocity error; not finite after the observer has escaped."""
        with np.errstate(invalid="ignore"):
            return np.linalg.norm(self.estimate - self.v, axis=1)


def follow(
    inertia: tuple[float, ...], velocity: tuple[float, ...], observer: Callable[..., AbstractFlowObserver], t
) -> Trajectory:
    """Run an observer on a top in free motion; it starts at rest, with a wrong attitude.

    Args:
        inertia: Principal inertias of the top [kg m²].
        velocity: Its initial angular velocity [rad/s] in the body frame.
        observer: Builds the observer for the top.
        t: Stamps (T,) [s].

    Returns:
        The trajectory.
    """
    top = _top(inertia)
    x, v = _follow(observer(top), top, jnp.asarray(velocity), jnp.asarray(t))
    return Trajectory(np.asarray(t), np.asarray(x), np.asarray(v))


@functools.cache  # the same object at each call, so that compiled programs are reused
def _top(inertia: tuple[float, ...]) -> models.GroupSystem:
    return models.heavy_top(inertia)


@eqx.filter_jit
def _follow(observer, top, velocity, t):
    g = SO3.exp(jnp.array(TILT))
    start = observer.init(g @ SO3.exp(jnp.array(MISALIGNED)))
    x, state = observe(top, observer, models.Motion(g, velocity), start, t, rtol=1e-10, atol=1e-13, max_steps=5000)
    return x.v, state.v


def corrected(doubled: bool) -> Callable[..., AbstractFlowObserver]:
    """The corrected observer of figure 1.

    Args:
        doubled: Whether α is doubled as in the paper, or is the α of this library.

    Returns:
        A function from a top to its observer.
    """
    return lambda top: Intrinsic(top, 2 * ALPHA if doubled else ALPHA, BETA)


def printed(top: models.GroupSystem) -> AbstractFlowObserver:
    """The observer with the curvature as printed, and the doubled α."""
    return PrintedGroup(top, ALPHA, BETA, PRINTED)


def slow_rate(doubled: bool) -> float:
    """Asymptotic rate of the theory [1/s], the slow root of `s² + αs + β`.

    Args:
        doubled: As for `corrected`.

    Returns:
        The rate.

    Example:
        >>> from covariant.papers.maithripala import slow_rate
        >>> round(slow_rate(False), 3)
        1.127
    """
    alpha = 2 * ALPHA if doubled else ALPHA
    return alpha / 2 - (alpha**2 / 4 - BETA) ** 0.5


def fitted_rate(run: Trajectory, begin: float) -> float:
    """Slope of −log(error) [1/s] from a time until the error reaches the accuracy of the integration.

    Args:
        run: The trajectory.
        begin: Time [s] at which the fit begins.

    Returns:
        The rate.
    """
    used = (run.t >= begin) & (run.error > 1e-8)
    return float(-np.polyfit(run.t[used], np.log(run.error[used]), 1)[0])


def conserved(duration: float = 60.0) -> dict[str, float]:
    """Largest changes of quantities that the free top conserves; they measure the accuracy of the simulation.

    Args:
        duration: Length of the simulation [s].

    Returns:
        Changes of `energy` [J], `vertical_momentum` [N m s], and `casimir` `|Rᵀe₃|²`, which would show a drift off the
        group.
    """
    change = _invariant_drift(jnp.linspace(0.0, duration, 601))
    return dict(zip(("energy", "vertical_momentum", "casimir"), (float(a) for a in change), strict=True))


@eqx.filter_jit
def _invariant_drift(t):
    top = models.heavy_top(TOP)
    x = simulate(top, models.Motion(SO3.exp(jnp.array(TILT)), jnp.array(SPINNING)), t).x

    def invariants(g, v):
        # A row of g is gᵀe₃, the vertical in the body frame; weight has no torque about it.
        vertical = g[2]  # e₃ in the body frame
        return jnp.stack([models.energy(top, g, v), vertical @ top.space.lower(g, v), vertical @ vertical])

    values = jax.vmap(invariants)(x.q, x.v)
    return jnp.max(jnp.abs(values - values[:1]), axis=0)


def logarithm_gap(angle: float, axes: int = 200) -> dict[str, float]:
    """Compare the group logarithm with the Riemannian one, for I = diag(1, 2, 3.5) and rotations about random axes.

    Args:
        angle: Angle of the rotations [rad].
        axes: Number of axes.

    Returns:
        `too_long_…`: relative excess of the group logarithm's length over the distance, mean and largest; `degrees_…`:
        the angle between the two logarithms.
    """
    directions = np.random.default_rng(0).normal(size=(axes, 3))
    x = angle * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    length, turned = (np.asarray(a) for a in _logarithm_gap(jnp.asarray(x)))
    return {
        "too_long_mean": float(length.mean()),
        "too_long_largest": float(length.max()),
        "degrees_mean": float(turned.mean()),
        "degrees_largest": float(turned.max()),
    }


@eqx.filter_jit
def _logarithm_gap(x):
    space, here = LeftInvariant(SO3, jnp.diag(jnp.array(UNEQUAL))), SO3.identity()

    def gap(published):
        exact = space.shoot(here, SO3.exp(published)).velocity
        length, distance = space.norm(here, published), space.norm(here, exact)
        cosine = space.inner(here, published, exact) / (length * distance)
        return length / distance - 1, jnp.degrees(jnp.arccos(jnp.clip(cosine, -1.0, 1.0)))

    return jax.vmap(gap)(x)


def reproduce(progress: Callable[[str], None] = lambda stage: None) -> dict[str, Any]:
    """Compute all reproduced numbers of the paper.

    Args:
        progress: Called with the name of each of `STAGES` stages.

    Returns:
        `top` (stamps `t`, velocity errors `error_doubled` and `error`, their fitted rates `rate_doubled` and `rate`
        [1/s] with those of the `theory`, and `conserved` quantities), `printed` (final error with the curvature as
        printed and as corrected, for top and disc), `logarithm` (difference of the two logarithms by angle), and
        `seconds`. Values that are not finite are None.
    """
    began = time.perf_counter()
    progress("heavy top, doubled α")
    t = np.linspace(0.0, 30.0, POINTS)
    doubled = follow(TOP, SPINNING, corrected(True), t)
    progress("heavy top")
    single = follow(TOP, SPINNING, corrected(False), t)
    top = {
        "t": t[::20].tolist(),
        "error_doubled": _finite(doubled.error[::20]),
        "error": _finite(single.error[::20]),
        # Both fits begin after nearly eight time constants of the slow pole, when linear theory holds.
        "rate_doubled": fitted_rate(doubled, 15.0),
        "rate": fitted_rate(single, 7.0),
        "theory_doubled": slow_rate(True),
        "theory": slow_rate(False),
    }
    progress("conserved quantities")
    results: dict[str, Any] = {"top": top | {"conserved": conserved()}, "printed": {}}
    for name, (inertia, velocity) in {"top": (TOP, SPINNING), "disc": (DISC, TUMBLING)}.items():
        progress(f"the print: {name}")
        runs = {"printed": printed, "corrected": corrected(True)}
        final = {key: follow(inertia, velocity, make, np.linspace(0.0, 10.0, POINTS)) for key, make in runs.items()}
        results["printed"][name] = {key: _finite(run.error[-1:])[0] for key, run in final.items()}
    results["logarithm"] = {}
    for angle in (1.0, 2.0):
        progress(f"logarithms of rotations by {angle:g} rad")
        results["logarithm"][f"{angle:g} rad"] = logarithm_gap(angle)
    results["seconds"] = round(time.perf_counter() - began, 1)
    return results


def _finite(values) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


def draw(path: Path) -> tuple[Path, Path]:
    """Draw figure 1 and, with the suffix `_errors`, the errors with the theoretical rates, and those of the print.

    Args:
        path: File of the first figure.

    Returns:
        The two paths.
    """
    from covariant.report import PALETTE, new_figure, save_figure

    t = np.linspace(0.0, 10.0, POINTS)
    runs = {doubled: follow(TOP, SPINNING, corrected(doubled), t) for doubled in (True, False)}
    titles = [f"angular velocity about body axis {i}" for i in (1, 2, 3)]
    figure, axes = new_figure(3, 1, panel=(8.0, 1.9), titles=titles)
    for i, ax in enumerate(axes[:, 0]):
        ax.plot(t, runs[True].v[:, i], color=PALETTE.truth, linewidth=2.5, label="top")
        ax.plot(
            t,
            runs[True].estimate[:, i],
            color=PALETTE.covariant,
            linestyle="--",
            label="estimate, 2α = 20 as in the paper",
        )
        ax.plot(t, runs[False].estimate[:, i], color=PALETTE.sky, linestyle="-.", label="estimate, α = 10")
        ax.set_ylabel("[rad/s]")
    axes[-1, 0].set_xlabel("t [s]")
    axes[-1, 0].legend(loc="lower right")
    first = save_figure(figure, path)
    return first, _draw_errors(path.with_stem(f"{path.stem}_errors"))


def _draw_errors(path: Path) -> Path:
    from covariant.report import PALETTE, new_figure, save_figure

    t = np.linspace(0.0, 20.0, POINTS)
    titles = ("elongated top, spinning", "disc, tumbling")
    figure, axes = new_figure(1, 2, panel=(4.5, 3.6), titles=titles, sharex=False)
    for ax, inertia, velocity in zip(axes[0], (TOP, DISC), (SPINNING, TUMBLING), strict=True):
        for label, color, make in (
            ("2α = 20, corrected", PALETTE.covariant, corrected(True)),
            ("α = 10, corrected", PALETTE.sky, corrected(False)),
            ("2α = 20, curvature as printed", PALETTE.purple, printed),
        ):
            error = follow(inertia, velocity, make, t).error
            ax.semilogy(t, np.where(np.isfinite(error), error, np.nan), color=color, label=label)
        for doubled, style in ((True, ":"), (False, "--")):
            rate = slow_rate(doubled)
            ax.semilogy(
                t, 5 * np.exp(-rate * t), style, color=PALETTE.text, linewidth=1.0, label=f"theory: e^(−{rate:.3f} t)"
            )
        ax.set(xlabel="t [s]", ylim=(1e-7, 30.0))
    axes[0, 0].set_ylabel("|ω̂ − ω| [rad/s]")
    axes[0, 0].legend()
    return save_figure(figure, path)


def summary(results: dict[str, Any]) -> list[str | list[dict[str, str]]]:
    """Lines and tables to print, from the results of `reproduce`."""
    top, gaps = results["top"], results["logarithm"]
    rates = [
        {"observer": name, "fitted rate [1/s]": f"{top[key]:.4f}", "theory [1/s]": f"{top[theory]:.4f}"}
        for name, key, theory in (
            ("2α = 20, as in the paper", "rate_doubled", "theory_doubled"),
            ("α = 10", "rate", "theory"),
        )
    ]
    conserved_words = ", ".join(f"{key.replace('_', ' ')} {value:.1e}" for key, value in top["conserved"].items())
    printed_rows = [
        {"body": name} | {key: "escaped" if e is None else f"{e:.3g}" for key, e in errors.items()}
        for name, errors in results["printed"].items()
    ]
    gap_rows = [
        {"rotation": angle}
        | {
            "too long, mean (largest)": f"{100 * g['too_long_mean']:.1f} % ({100 * g['too_long_largest']:.1f} %)",
            "apart, mean (largest)": f"{g['degrees_mean']:.0f}° ({g['degrees_largest']:.0f}°)",
        }
        for angle, g in gaps.items()
    ]
    return [
        "Heavy top, α = β = 10: asymptotic rate of the velocity error",
        rates,
        f"Largest change over 60 s of the simulated top: {conserved_words}",
        "Velocity error after 10 s [rad/s], with the curvature (8), (18) as printed and as corrected",
        printed_rows,
        "Group logarithm (9) against the Riemannian one, I = diag(1, 2, 3.5)",
        gap_rows,
    ]


TITLE = "Maithripala, Berg & Dayawansa 2004, reproduced"


def page(results: dict[str, Any], figures: tuple[Path, ...]) -> list[Any]:
    """Explanations, tables and figures, one below the other, of the results of `reproduce` and the files of `draw`."""
    rates, conserved_line, prints, gaps = (summary(results)[i] for i in (1, 2, 4, 6))
    return [
        "# Figure 1: angular velocity of a heavy top",
        "An elongated symmetric top in a gravitational field; its attitude is measured as a rotation matrix, "
        "its angular velocity estimated, with no coordinates. The paper gives no numbers: these are chosen. "
        "Its equation (17) carries 2α where Aghannan and Rouchon have α; the rate of either is that of theory.",
        rates,
        figures[0],
        str(conserved_line) + ".",
        "# What the print does",
        "Equation (8) counts parts of the curvature twice, and (18) has the sign of the other convention. "
        "An elongated top has positive curvature: there the printed term only adds stiffness, which is why the "
        "paper's figure looks well. A tumbling disc has negative curvature, and the printed observer fails on it. "
        "Velocity error after 10 s [rad/s]:",
        prints,
        figures[1],
        "# Two logarithms",
        "The paper takes the group logarithm for the gradient of the squared distance, which it is only when the "
        "metric is bi-invariant. The difference is of second order, so the local rate is the same.",
        gaps,
    ]
