"""Estimate afterwards: the same log, by a filter and by a smoother, through half a second without readings.

A double pendulum swings; its encoders are read 200 times a second, and for half a second their cable is loose. The
filter knows at each time only what was read before: in the gap it follows its model, whose masses are two per cent
wrong, and is corrected as readings return. The smoother knows what was read after the gap, too. The bands are two
standard deviations, as each of them says of itself.
"""

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from covariant import models, simulation
from covariant.observers import IntrinsicKalman, smooth
from covariant.report import PALETTE, new_figure, save_figure
from covariant.signals import Record

FIGURE = Path(__file__).parent / "out" / "14_estimate_afterwards.png"
GAP = 2.0, 2.5
NOISE = 1e-2

geometry = {"length": (0.3, 0.25), "com": (0.16, 0.14), "inertia": (0.005, 0.0026), "viscous": (0.02, 0.01)}
machine = models.pendulum_chain(mass=(0.6, 0.4), **geometry)
model = models.pendulum_chain(mass=(0.612, 0.392), **geometry)

t = np.arange(0.0, 4.0, 0.005)
motion = eqx.filter_jit(simulation.simulate)(
    machine,
    jnp.array([2.0, -1.0, 0.0, 0.0]),
    jnp.asarray(t),
    lambda s, x: jnp.array([0.3, 0.1]) * jnp.sin(jnp.array([4.0, 7.0]) * s),
)
q, v = np.split(np.asarray(motion.x), 2, axis=1)
y = q + NOISE * np.random.default_rng(0).normal(size=q.shape)
gap = (t > GAP[0]) & (t < GAP[1])
y[gap] = np.nan

kalman = IntrinsicKalman(model, 0.5 * jnp.eye(2), NOISE**2 * jnp.eye(2), 4.0 * jnp.eye(2), substeps=1)
smoothed = smooth(kalman, Record(t, np.asarray(motion.u), y))
runs = {"filter": smoothed.filtered, "smoother": smoothed.run}
for name, run in runs.items():
    off = np.asarray(run.estimate)[:, 2:] - v
    later = t > 0.5
    inside, outside = (np.sqrt(np.mean(off[rows] ** 2)) for rows in (gap, later & ~gap))
    print(f"{name}: velocity RMSE {outside:.3f} rad/s with readings, {inside:.3f} rad/s in the gap")

titles = ("Velocity of the second joint", "Error of the velocity, and two standard deviations")
figure, axes = new_figure(2, 1, panel=(8.0, 2.4), titles=titles, sharex=True)
velocity, error = axes[:, 0]
for ax in axes[:, 0]:
    ax.axvspan(*GAP, color=PALETTE.shade, zorder=0)
velocity.plot(t, v[:, 1], color=PALETTE.truth, linewidth=3.5, label="true")
for color, (name, run) in zip((PALETTE.sky, PALETTE.covariant), runs.items(), strict=True):
    off = np.asarray(run.estimate)[:, 3] - v[:, 1]
    band = 2 * np.asarray(run.info.velocity_std)[:, 1]
    velocity.plot(t, v[:, 1] + off, color=color, label=name)
    error.fill_between(t, -band, band, color=color, alpha=0.2, linewidth=0, label="±2σ")
    error.plot(t, off, color=color, label=name)
shown = (t > 1.7) & (t < 2.9)
low, high = v[shown, 1].min(), v[shown, 1].max()
velocity.set(xlim=(1.7, 2.9), ylim=(low - 2, high + 4), ylabel="dq₂/dt [rad/s]")
largest = 2.2 * np.asarray(smoothed.filtered.info.velocity_std)[shown, 1].max()
error.set(ylabel="estimate − truth [rad/s]", xlabel="t [s]", ylim=(-largest, largest))
velocity.legend(loc="upper left")
error.legend(loc="upper left", ncols=2)
velocity.annotate("no readings", (np.mean(GAP), velocity.get_ylim()[0]), ha="center", va="bottom", color=PALETTE.text)
FIGURE.parent.mkdir(exist_ok=True)
save_figure(figure, FIGURE)
