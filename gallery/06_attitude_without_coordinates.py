"""A tumbling body seen by a star camera: angular velocity from rotation matrices, with no coordinates to go wrong.

A body spun about its middle axis turns over again and again. A camera measures its attitude ten times a second, with a
noise of half a degree, and loses sight of the stars for two seconds. In Euler angles the rates are infinite at pitch
90°, where the body passes many times; on the group that is no event. Three observers share the measurements: the
intrinsic one with constant gains, the multiplicative Kalman filter that spacecraft carry, and Salcudean's, which has a
Lyapunov function but no metric. The differences of successive attitudes show what there is without a model.

Figure: 0.0082 rad/s for the intrinsic observer after 8 s, 0.0108 for Salcudean, 0.0062 for the multiplicative EKF,
whose gains begin high and fall.
"""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant.geometry.lie import SO3
from covariant.models import Motion, free_body
from covariant.observers import EKF, Intrinsic, Salcudean, run
from covariant.report import PALETTE, new_figure, save_figure
from covariant.signals import Record, StepCode
from covariant.simulation import simulate

FIGURE = Path(__file__).parent / "out" / "06_attitude_without_coordinates.png"
RATE, NOISE, SILENT = 10.0, np.radians(0.5), (12.0, 14.0)

body = free_body((1.0, 2.0, 3.5))
t = jnp.arange(0.0, 30.0, 1 / RATE)
truth = eqx.filter_jit(simulate)(body, Motion(jnp.eye(3), jnp.array([0.02, 1.5, 0.03])), t)
noise = NOISE * jax.random.normal(jax.random.key(1), (len(t), 3))
y = jax.vmap(lambda g, e: g @ SO3.exp(e))(truth.y, noise)
y = jnp.where(((t > SILENT[0]) & (t < SILENT[1]))[:, None, None], jnp.nan, y)
record = Record(t, truth.u, y)

alpha, beta, inertia = 1.5, 1.2, 2.0
observers = {
    "intrinsic, on the group": Intrinsic(body, alpha, beta),
    "multiplicative EKF": EKF(body, 1e-6 * jnp.eye(3), NOISE**2 * jnp.eye(3), initial_velocity_std=2.0),
    "Salcudean": Salcudean(body, 4 * inertia**2 * beta, 2 * inertia * alpha),
}
runs = {name: run(observer, record) for name, observer in observers.items()}

pitch = np.degrees(np.arcsin(np.clip(-np.asarray(truth.y)[:, 2, 0], -1, 1)))
titles = (
    "Pitch of the body: it passes ±90° again and again",
    "Angular velocity about the axes of the body",
    "Error of the estimates",
)
figure, axes = new_figure(3, 1, panel=(8.4, 2.1), titles=titles)
top, middle, bottom = axes[:, 0]
top.plot(t, pitch, PALETTE.truth)
top.set(ylabel="[degree]", yticks=(-90, 0, 90))
estimate = runs["intrinsic, on the group"].estimate.v
for i, color in zip(range(3), (PALETTE.covariant, PALETTE.sky, PALETTE.navy), strict=True):
    middle.plot(t, truth.x.v[:, i], PALETTE.truth, linewidth=3.5, label="true" if i == 0 else None)
    middle.plot(t, estimate[:, i], color=color, label=f"intrinsic, axis {i + 1}")
middle.set(ylabel="[rad/s]")
middle.legend(ncols=4, loc="lower left")
turned = jax.vmap(SO3.between)(y[:-1], y[1:]) * RATE
bottom.semilogy(
    t[1:],
    np.linalg.norm(turned - truth.x.v[1:], axis=1),
    PALETTE.amber,
    linewidth=0.8,
    label="differences of attitudes",
)
for name, result in runs.items():
    error = np.linalg.norm(result.estimate.v - truth.x.v, axis=1)
    settled = np.sqrt(np.mean(error[np.asarray(t) > 8] ** 2))
    color = PALETTE.ekf if "EKF" in name else PALETTE.sky if name == "Salcudean" else PALETTE.covariant
    bottom.semilogy(t, error, color=color, label=f"{name}: {settled:.2g} rad/s after 8 s")
    coasted = int((result.info.result == StepCode.COASTED).sum())
    print(f"{name}: {settled:.4f} rad/s RMSE after 8 s, {coasted} samples coasted")
for ax in (middle, bottom):
    ax.axvspan(*SILENT, color=PALETTE.shade, zorder=0)
bottom.text(np.mean(SILENT), 1.2, "no stars", ha="center", color=PALETTE.text)
bottom.set(ylabel="|ω̂ − ω| [rad/s]", xlabel="t [s]", ylim=(1e-4, 4))
bottom.legend(ncols=2, loc="upper right")
FIGURE.parent.mkdir(exist_ok=True)
save_figure(figure, FIGURE)
