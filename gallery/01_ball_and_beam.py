"""Why curvature matters: the intrinsic observer next to a copy of the model, with low gains.

A ball rolls on a beam that a torque tilts; positions are measured, velocities wanted. Low gains let little measurement
noise through, but then the observer has to know how errors themselves move. The metric of the ball and beam has
negative curvature, which drives neighbouring motions apart. The intrinsic observer compensates it: its error falls as
the gains ask for, with the double pole −0.7071 1/s. Without its curvature term it is no better than the model with
output injection (the copy observer), and neither ever arrives.

Scenario: Aghannan & Rouchon 2003, figure 4, without noise. A second figure, `01_ball_and_beam_basin.png`, shows from
which first errors four observers converge, for gains α = 2ω, β = ω²: below ω = 0.6 1/s the exact observer, with
geodesics, may lock to a motion several metres off, where the one to first order in the error converges.

Figure: after 30 s the error of the intrinsic observer is 7e-8, as the double pole of the theory asks; without the
curvature term it is 56, for the copy 10.
"""

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from covariant.geometry import Budget
from covariant.models import ball_and_beam
from covariant.observers import Intrinsic, LagrangianMetric, ModelCopy
from covariant.papers import aghannan_rouchon as paper
from covariant.report import PALETTE, new_figure, save_figure
from covariant.simulation import observe

FIGURE = Path(__file__).parent / "out" / "01_ball_and_beam.png"

COLORS = {
    "intrinsic": PALETTE.covariant,
    "intrinsic, curvature left out": PALETTE.sky,
    "copy": PALETTE.amber,
}

alpha, beta = 2**0.5, 0.5  # double pole at −√½
plant = ball_and_beam()
observers = {
    "intrinsic": Intrinsic(plant, alpha, beta),
    "intrinsic, curvature left out": Intrinsic(plant, alpha, beta, curvature=False),
    "copy": ModelCopy(plant, alpha, beta),
}

truth = jnp.array([0.02, 0.0, 0.05, 0.0])  # r, θ, dr/dt, dθ/dt
guess = jnp.array([0.021, 0.2, 0.525, 2.0])
t = jnp.linspace(0.0, 30.0, 901)


def push(s, x):
    """A torque that keeps the ball swinging about the unstable middle of the beam."""
    return (-20 * x[1] + 101 * x[0])[None]


@eqx.filter_jit
def follow(observer):
    start = observer.init(guess[:2])._replace(v=guess[2:])
    x, state = observe(plant, observer, truth, start, t, push)
    return x, jnp.concatenate([state.q, state.v], axis=1)


runs = {name: follow(observer) for name, observer in observers.items()}
real = next(iter(runs.values()))[0]

figure, axes = new_figure(
    1, 2, panel=(4.5, 3.4), titles=("Velocity of the ball", "Error, both positions and velocities"), sharex=False
)
velocity, error = axes[0]
velocity.plot(t, real[:, 2], color=PALETTE.truth, linewidth=3.5, label="true")
for name, (x, estimate) in runs.items():
    off = np.linalg.norm(estimate - x, axis=1)
    last = off[np.isfinite(off)][-1]
    velocity.plot(t, np.where(np.isfinite(off), estimate[:, 2], np.nan), color=COLORS[name], label=name)
    error.semilogy(
        t, np.where(np.isfinite(off), off, np.nan), color=COLORS[name], label=f"{name}: {last:.1g} at the end"
    )
    print(f"{name}: error {off[0]:.2g} at first, {off[-1]:.2g} after {t[-1]:.0f} s")
omega = alpha / 2
error.semilogy(t, 2 * (1 + omega * t) * np.exp(-omega * t), ":", color=PALETTE.text, label="theory: (1 + ωt) exp(−ωt)")
velocity.set(xlim=(0, 15), ylim=(-0.6, 2.2), xlabel="t [s]", ylabel="dr/dt [m/s]")
error.set(ylim=(1e-8, 1e8), xlabel="t [s]", ylabel="|(q̂ − q, v̂ − v)|")
velocity.legend(loc="upper right")
error.legend(loc="upper left")
FIGURE.parent.mkdir(exist_ok=True)
save_figure(figure, FIGURE)

omegas = (2.0, 1.6, 1.2, 1.0, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3)
scales = np.arange(1, 16) / 10
low = 0.5
figure, axes = new_figure(
    1, 2, panel=(4.5, 3.6), titles=(f"Error at low gains, ω = {low} 1/s", "Initial errors that vanish"), sharex=False
)
error, basin = axes[0]
t = np.linspace(0.0, 80.0, 81)
for name, mark in (("exact", "o"), ("approximate", "s"), ("copy", "^"), ("lifted metric", "D")):
    look = {"color": getattr(PALETTE, paper.COLORS.get(name, "olive")), "label": paper.LABELS.get(name, name)}
    largest = []
    for omega in omegas:
        gains = 2 * omega, omega**2
        compared = paper.figure4_observers(*gains) | {"lifted metric": LagrangianMetric(plant, *gains, Budget(steps=4))}
        observer = compared[name]
        runs = paper.figure4_batch(observer, t, [(False, scale, 1e-6) for scale in scales])
        vanishes = np.array([run.error[-1] < 0.01 for run in runs])
        # Up to this one all of them vanish. Beyond, the basin may have islands.
        count = int(np.argmin([*vanishes, False]))
        largest.append(count / 10)
        islands = scales[count:][vanishes[count:]]
        basin.plot(np.full(len(islands), omega), islands, mark, fillstyle="none", color=look["color"])
        print(
            f"{name}, ω = {omega} 1/s: errors up to {largest[-1]} times that of figure 4 vanish", *islands, flush=True
        )
        if omega == low:
            off = runs[9].error
            error.semilogy(t, np.where(np.isfinite(off), off, np.nan), f"{mark}-", markevery=10, **look)
    basin.plot(omegas, largest, f"{mark}-", color=look["color"])
basin.plot([], [], "s", fillstyle="none", color=PALETTE.text, label="but a smaller one does not")
for scale, text in ((1.0, "figure 4"), (scales[-1], "largest tried")):
    basin.axhline(scale, linestyle=":", color=PALETTE.text)
    basin.annotate(text, (2.0, scale + 0.01), ha="right", va="bottom", color=PALETTE.text)
error.set(ylim=(1e-9, 1e5), xlabel="t [s]", ylabel="|(q̂ − q, v̂ − v)|")
basin.set(
    ylim=(-0.05, 1.65), xlabel="ω [1/s], for gains α = 2ω, β = ω²", ylabel="multiple of the initial error of figure 4"
)
error.legend(loc="lower left")
basin.legend(loc="center right")
save_figure(figure, FIGURE.with_stem(f"{FIGURE.stem}_basin"))
