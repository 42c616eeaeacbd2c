"""Body velocities of an underwater vehicle from its pose, through a loop in which pitch passes 90°.

The vehicle carries no Doppler log; an acoustic and inertial reference gives its pose twenty times a second. The model
knows mass, added mass, weight, buoyancy and thrust; its drag is 10 % too low. Friction is evaluated at the estimate,
where a wrong coefficient leaves the bias αa/β, a being the acceleration it gets wrong: the Kalman filter, told to
expect such errors, has the higher gains and the smaller bias, and more noise. Position and attitude are one element
of SE(3), so surge and pitch rate need no frames of their own, and a loop is a motion like any other.
"""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant.geometry.lie import SE3
from covariant.models import Motion, underwater_vehicle
from covariant.observers import EKF, Intrinsic, run
from covariant.report import PALETTE, new_figure, save_figure
from covariant.signals import Record
from covariant.simulation import simulate

FIGURE = Path(__file__).parent / "out" / "07_pose_of_an_underwater_vehicle.png"
RATE = 20.0
NOISE = jnp.array([0.02, 0.02, 0.02, 0.01, 0.01, 0.01])  # [m] and [rad]
DRAG, QUADRATIC = np.array([4.0, 6.0, 5.0, 0.1, 0.1, 0.1]), np.array([18.0, 22.0, 37.0, 1.5, 1.5, 1.5])


def thrust(t, x):
    """Full ahead, and from 8 s to 20 s the stern thrusters pitch the vehicle over; a little sway and yaw besides."""
    loop = jnp.where((t > 8.0) & (t < 20.0), -7.0, 0.0)
    return jnp.stack([25.0 + 0 * t, 3.0 * jnp.sin(0.5 * t), 0 * t, 0 * t, loop, 0.4 * jnp.sin(0.3 * t)])


vehicle = underwater_vehicle(drag=DRAG, quadratic_drag=QUADRATIC)
believed = underwater_vehicle(drag=0.9 * DRAG, quadratic_drag=0.9 * QUADRATIC)
t = jnp.arange(0.0, 30.0, 1 / RATE)
truth = eqx.filter_jit(simulate)(vehicle, Motion(jnp.eye(4), jnp.zeros(6)), t, thrust)
noise = NOISE * jax.random.normal(jax.random.key(2), (len(t), 6))
record = Record(t, truth.u, jax.vmap(lambda g, e: g @ SE3.exp(e))(truth.y, noise))

alpha, beta = 6.0, 18.0
observers = {
    "intrinsic": Intrinsic(believed, alpha, beta),
    "left-invariant EKF": EKF(believed, 0.02 * jnp.diag(NOISE / NOISE[0]) ** 2, jnp.diag(NOISE**2)),
}
runs = {name: run(observer, record).estimate.v for name, observer in observers.items()}
differences = jax.vmap(SE3.between)(record.y[:-1], record.y[1:]) * RATE

titles = ("Path, seen from the side", "Surge", "Pitch rate")
figure, axes = new_figure(3, 1, panel=(8.4, 2.4), titles=titles, sharex=False)
side, surge, rate = axes[:, 0]
side.plot(truth.y[:, 0, 3], truth.y[:, 2, 3], color=PALETTE.truth)
for k in range(0, len(t), 24):
    nose = truth.y[k, :3, 3] + 0.8 * truth.y[k, :3, 0]
    side.plot([truth.y[k, 0, 3], nose[0]], [truth.y[k, 2, 3], nose[2]], color=PALETTE.text, linewidth=2)
side.set(xlabel="ahead [m]", ylabel="up [m]", aspect="equal")
for ax, i, unit in ((surge, 0, "m/s"), (rate, 4, "rad/s")):
    ax.plot(t[1:], differences[:, i], color=PALETTE.amber, linewidth=0.7, label="differences of poses")
    ax.plot(t, truth.x.v[:, i], color=PALETTE.truth, linewidth=4, label="true")
    for name, v in runs.items():
        ax.plot(t, v[:, i], label=name)
    ax.set(xlabel="t [s]", ylabel=f"{'surge' if i == 0 else 'pitch rate'} [{unit}]")
surge.legend(loc="upper right")
for name, v in runs.items():
    error = np.sqrt(np.mean(np.asarray(v - truth.x.v)[100:] ** 2, axis=0))
    print(f"{name}: surge {error[0]:.3f} m/s, pitch rate {error[4]:.3f} rad/s RMSE")
FIGURE.parent.mkdir(exist_ok=True)
save_figure(figure, FIGURE)
