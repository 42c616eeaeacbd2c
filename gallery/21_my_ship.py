"""A ship from its log: surge, sway and yaw rate by GNSS and compass, and a turning circle that zig-zags predict.

The receiver is good to 1 cm and the compass to 0.3°, five times a second. `examples/ship.toml` has the numbers that
`covariant fit` found in zig-zags. With them a Kalman filter on SE(2) knows the velocities twelve to twenty times better
than a filter without a model, which has to choose between noise and delay, and a circle with the rudder at 20° follows
without having been seen.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pandas
from workboat import HULLS, NAMES, sail

import covariant
from covariant import models
from covariant.geometry.lie import SE2
from covariant.models import Motion
from covariant.report import PALETTE, new_figure, save_figure
from covariant.simulation import simulate

MODEL = str(Path(__file__).parents[1] / "examples" / "ship.toml")
FIGURE = Path(__file__).parent / "out" / "21_my_ship.png"
LABELS = ("surge [m/s]", "sway [m/s]", "yaw rate [rad/s]")

table, truth = sail(HULLS["workboat"], seed=3)
result = covariant.estimate(MODEL, pandas.DataFrame(table, columns=NAMES), observer="intrinsic-kalman")
t, late = result.t, result.t > 10.0
off = result.velocity - truth
std = result.velocity_std
inside = np.mean(np.abs(off[late]) <= 1.96 * std[late], axis=0)

# The best of some windows of past positions, for each velocity; turned into the body by the measured heading.
heading = np.unwrap(np.radians(table[:, 3]))
free, best = np.zeros(truth.shape), np.full(3, np.inf)
for rows in (4, 6, 9, 13, 19, 28):
    ages = np.arange(rows) / 5.0
    slope = np.linalg.pinv(np.stack([np.ones(rows), -ages, ages**2], axis=1))[1]  # of a parabola, at its end
    rates = [np.convolve(each, slope)[: len(t)] for each in (table[:, 1], table[:, 2], heading)]
    c, s = np.cos(heading), np.sin(heading)
    body = np.stack([c * rates[0] + s * rates[1], c * rates[1] - s * rates[0], rates[2]], axis=1)
    size = np.sqrt(np.mean((body - truth)[late] ** 2, axis=0))
    free, best = np.where(size < best, body, free), np.minimum(best, size)

circle, _ = sail(HULLS["workboat"], seed=4, circle=True, seconds=200.0)
u = np.stack([np.radians(circle[:, 4]), circle[:, 5]], axis=1)
start = Motion(SE2.exp(jnp.array([0.0, 0.0, 0.3])), jnp.array([1.0, 0.0, 0.0]))
stamps = jnp.asarray(circle[:, 0])
predicted = simulate(
    models.load(MODEL).model, start, stamps, lambda t, x: jnp.asarray(u)[jnp.searchsorted(stamps, t, side="right") - 1]
).y[:, :2, 2]

titles = ("Zig-zags", "Surge", "Its error", "Turning circle", "Sway", "Its error", "Rudder", "Yaw rate", "Its error")
figure, axes = new_figure(3, 3, panel=(4.4, 2.5), titles=titles, sharex=False)
track, turning, rudder = axes[:, 0]
track.plot(table[:, 2], table[:, 1], color=PALETTE.truth)
turning.plot(circle[:, 2], circle[:, 1], color=PALETTE.truth, label="sailed")
turning.plot(predicted[:, 1], predicted[:, 0], "--", color=PALETTE.covariant, label="predicted from zig-zags")
turning.legend(loc="center")
for ax in (track, turning):
    ax.set(xlabel="east [m]", ylabel="north [m]", aspect="equal", adjustable="datalim")
rudder.plot(t, table[:, 4], color=PALETTE.text)
rudder.set(xlim=(0, 120), xlabel="t [s]", ylabel="rudder [°]")
for (ax, below), i, label in zip(axes[:, 1:], range(3), LABELS, strict=True):
    ax.plot(t, truth[:, i], color=PALETTE.truth, label="truth")
    ax.plot(t[25:], result.velocity[25:, i], color=PALETTE.covariant, linewidth=0.9, label="estimate")
    ax.set(xlim=(0, 120), ylabel=label)
    below.plot(t, free[:, i] - truth[:, i], color=PALETTE.filter, linewidth=0.6, label="without a model")
    below.plot(t, off[:, i], color=PALETTE.covariant, linewidth=0.9, label="estimate")
    for sign in (-1, 1):
        below.plot(t, sign * 1.96 * std[:, i], color=PALETTE.text, linewidth=0.6, label="95 %" if sign > 0 else None)
    below.set(xlim=(0, 120), ylim=(-3 * best[i], 3 * best[i]), ylabel=label)
axes[2, 1].set(xlabel="t [s]")
axes[2, 2].set(xlabel="t [s]")
axes[0, 1].legend(loc="lower right", ncols=2)
axes[0, 2].legend(loc="lower right", ncols=3)
FIGURE.parent.mkdir(exist_ok=True)
save_figure(figure, FIGURE)

sizes = [np.ptp(path[len(path) // 2 :], axis=0).mean() for path in (circle[:, 1:3], np.asarray(predicted))]
rms = np.sqrt(np.mean(off[late] ** 2, axis=0))
print("RMSE", dict(zip(LABELS, rms.round(5).tolist(), strict=True)), "without a model", best.round(4).tolist())
print("inside the band of 95 %:", inside.round(3).tolist())
print(f"diameter of the circle: sailed {sizes[0]:.2f} m, predicted {sizes[1]:.2f} m")
assert (rms < best / 10).all()
assert abs(sizes[1] / sizes[0] - 1) < 0.01
