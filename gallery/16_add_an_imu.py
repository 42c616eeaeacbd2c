"""Add an IMU to an arm: encoders a hundred times a second, and a gyro on the last link a thousand times a second.

The encoders of an arm of two links are read at 100 Hz; a gyro on its last link, which has a constant bias that nobody
knows, at 1 kHz. The model's masses are five per cent wrong and its friction is unknown. Each row of the log has what
was read then: nine of ten have no positions. The bands are two standard deviations, as the filter says of itself.
"""

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from covariant import models, observers, simulation
from covariant.report import PALETTE, new_figure, save_figure
from covariant.signals import Record

FIGURE = Path(__file__).parent / "out" / "16_add_an_imu.png"
NOISE, GYRO_NOISE, BIAS = 5e-4, 0.02, np.array([0.05, -0.15, 0.1])
EVERY = 10

geometry = {"mass": (0.6, 0.4), "length": (0.3, 0.25), "com": (0.16, 0.14), "inertia": (0.005, 0.0026)}
machine = models.pendulum_chain(**geometry, viscous=(0.02, 0.02), coulomb=(0.04, 0.03), angles="relative")
model = models.pendulum_chain(**geometry | {"mass": (0.63, 0.42)}, angles="relative")

t = np.arange(0.0, 2.0, 1e-3)
motion = eqx.filter_jit(simulation.simulate)(
    machine,
    jnp.array([0.8, -0.6, 0.0, 0.0]),
    jnp.asarray(t),
    lambda s, x: jnp.array([0.6, 0.2]) * jnp.sin(jnp.array([5.0, 8.0]) * s),
)
q, v = np.split(np.asarray(motion.x), 2, axis=1)
rng = np.random.default_rng(0)
spin = np.stack([np.zeros(len(t)), v.sum(axis=1), np.zeros(len(t))], axis=1)
readings = spin + BIAS + GYRO_NOISE * rng.normal(size=spin.shape)
positions = q + NOISE * rng.normal(size=q.shape)
positions[np.arange(len(t)) % EVERY > 0] = np.nan
u = np.asarray(motion.u)

# The angles are relative, and both joints turn about the same axis. The last argument is the bias, which is estimated.
unknown = jnp.diag(jnp.full(3, 0.2**2))
bias = observers.SlowVariables(("bias_x", "bias_y", "bias_z"), jnp.zeros(3), unknown, jnp.zeros((3, 3)))
gyro = observers.Sensor("gyro", lambda now, b: b.at[1].add(jnp.sum(now.v)), jnp.full(3, GYRO_NOISE**2), bias)
# Unknown friction is a force that stays for a while, not white noise of the accelerations.
force = observers.external_force(std=(0.06, 0.05), time=0.3)
noises = 0.05 * jnp.eye(2), NOISE**2 * jnp.eye(2), 4.0 * jnp.eye(2), force
runs = {
    "encoders": (observers.IntrinsicKalman(model, *noises, substeps=1), positions),
    "encoders and gyro": (
        observers.IntrinsicKalman(model, *noises, sensors=gyro, substeps=1),
        np.concatenate([positions, readings], axis=1),
    ),
}
runs = {name: observers.run(kalman, Record(t, u, y)) for name, (kalman, y) in runs.items()}
late = t > 0.5
for name, run in runs.items():
    off = np.asarray(run.estimate)[late, 2:] - v[late]
    joints, link = np.sqrt(np.mean(off**2, axis=0)), np.sqrt(np.mean(off.sum(axis=1) ** 2))
    print(
        f"{name}: RMSE of the joints' rates {joints[0]:.3f} and {joints[1]:.3f} rad/s, of the link's {link:.3f} rad/s"
    )

titles = ("Error of the second joint's rate, and two standard deviations", "Bias of the gyro about the axis that turns")
figure, axes = new_figure(2, 1, panel=(8.0, 2.4), titles=titles, sharex=True)
error, offset = axes[:, 0]
for color, (name, run) in zip((PALETTE.sky, PALETTE.covariant), runs.items(), strict=True):
    off, band = np.asarray(run.estimate)[:, 3] - v[:, 1], 2 * np.asarray(run.info.velocity_std)[:, 1]
    error.fill_between(t, -band, band, color=color, alpha=0.2, linewidth=0, label="±2σ")
    error.plot(t, off, color=color, label=name, linewidth=1.0)
info = runs["encoders and gyro"].info
found, band = np.asarray(info.slow)[:, 3], 2 * np.asarray(info.slow_std)[:, 3]  # after two forces and the bias about x
offset.axhline(BIAS[1], color=PALETTE.truth, linewidth=3.5, label="true")
offset.fill_between(t, found - band, found + band, color=PALETTE.covariant, alpha=0.2, linewidth=0, label="±2σ")
offset.plot(t, found, color=PALETTE.covariant, label="estimated")
largest = 1.5 * np.abs(np.asarray(runs["encoders"].estimate)[late, 3] - v[late, 1]).max()
error.set(ylabel="estimate − truth [rad/s]", ylim=(-largest, largest))
offset.set(ylabel="bias [rad/s]", xlabel="t [s]", ylim=(-0.4, 0.2))
for ax in axes[:, 0]:
    ax.legend(loc="upper right", ncols=2)
FIGURE.parent.mkdir(exist_ok=True)
save_figure(figure, FIGURE)
