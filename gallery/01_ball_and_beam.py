"""Why curvature matters: the intrinsic observer next to a copy of the model, with low gains.

A ball rolls on a beam that a torque tilts; positions are measured, velocities wanted. Low gains let little measurement
noise through, but then the observer has to know how errors themselves move. The metric of the ball and beam has
negative curvature, which drives neighbouring motions apart. The intrinsic observer compensates it: its error falls as
the gains ask for, with the double pole −0.7071 1/s. Without its curvature term it is no better than the model with
output injection (the copy observer), and neither ever arrives.

Scenario: Aghannan & Rouchon 2003, figure 4, without noise.

Figure: after 30 s the error of the intrinsic observer is 7e-8, as the double pole of the theory asks; without the
curvature term it is 56, for the copy 10.
"""

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from covariant.models import ball_and_beam
from covariant.observers import Intrinsic, ModelCopy
from covariant.report import PALETTE, new_figure, save_figure
from covariant.simulation import observe

FIGURE = Path(__file__).parent / "out" / "01_ball_and_beam.png"

COLORS = {
    "intrinsic": PALETTE.covariant,
    "intrinsic, curvature left out": PALETTE.sky,
    "copy": PALETTE.purple,
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
