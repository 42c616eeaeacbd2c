"""One machine, two descriptions of it: the exact intrinsic observer gives the same velocities in both.

One ball-and-beam bench reports the ball's position r; on another the ball is seen by an infrared sensor, whose voltage s
goes like 1/distance, and the model is written in that voltage. An engineer expects the same velocities from both. The
exact observer (`Geodesic`) delivers them, to the accuracy of the integration, since it is made of geometry alone. The
explicit observer (`Intrinsic`) agrees to second order in its error, so ever better as it arrives. A Kalman filter takes
noise and slopes as they are in its coordinates, and its estimates depend on them for good.
"""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant.geometry import Budget
from covariant.models import Lagrangian, ball_and_beam
from covariant.observers import EKF, Geodesic, Intrinsic, run
from covariant.report import new_figure, save_figure
from covariant.signals import Record
from covariant.simulation import simulate

FIGURE = Path(__file__).parent / "out" / "02_same_in_all_coordinates.png"

AWAY = 0.4
"""Distance of the infrared sensor from the middle of the beam [m]."""

bench = ball_and_beam()


def reading(q):
    """What the other bench measures: (s, θ)."""
    return jnp.stack([1 / (AWAY + q[0]), q[1]])


def position(z):
    """(r, θ), the inverse of `reading`."""
    return jnp.stack([1 / z[0] - AWAY, z[1]])


def slope(z):
    """The derivative of `position`, a number for each coordinate."""
    return jnp.stack([-1 / z[0] ** 2, jnp.ones_like(z[1])])


def state(x):
    """(r, θ) and their velocities from those of the other bench."""
    z, w = jnp.split(x, 2)
    return jnp.concatenate([position(z), slope(z) * w])


other = Lagrangian(
    metric=lambda z: slope(z)[:, None] * bench.metric(position(z)) * slope(z),
    potential=lambda z: bench.potential(position(z)),
    force=lambda t, z, u: slope(z) * bench.force(t, position(z), u),
    coordinates=("s", "theta"),
    units=("1/m", "rad"),
    inputs=1,
)

alpha, beta = 4.0, 8.0
middle = jnp.diag(1 / slope(reading(jnp.zeros(2))))  # noise of r as noise of s: right in the middle of the beam


def ekf(model, scale):
    """Noise that asks for about the same gains, the same at both benches."""
    return EKF(model, 0.64 * scale @ scale.T, 0.01 * scale @ scale.T, 1.0, substeps=4)


observers = {
    "Geodesic": [Geodesic(model, alpha, beta, Budget(steps=3), substeps=4) for model in (bench, other)],
    "Intrinsic": [Intrinsic(model, alpha, beta, substeps=4) for model in (bench, other)],
    "EKF": [ekf(bench, jnp.eye(2)), ekf(other, middle)],
}


def torque(s, x):
    """What keeps the ball swinging about the middle."""
    return (-20 * x[1] + 101 * x[0])[None]


t = jnp.linspace(0.0, 6.0, 301)
truth = eqx.filter_jit(simulate)(bench, jnp.array([0.02, 0.0, 0.1, 0.0]), t, torque)
read = [truth, Record(t, truth.u, jax.vmap(reading)(truth.y))]  # the same motion as both benches report it

titles = ("Velocity of the ball, computed on two benches", "How far the two benches' velocities are apart")
figure, axes = new_figure(1, 2, panel=(5.6, 3.6), titles=titles, sharex=False)
velocity, apart = axes[0]
velocity.plot(t, truth.x[:, 2], color="0.7", linewidth=3.5, label="true")
for i, (name, pair) in enumerate(observers.items()):
    first, second = (run(observer, record).estimate for observer, record in zip(pair, read, strict=True))
    second = jax.vmap(state)(second)
    difference = np.linalg.norm((second - first)[:, 2:], axis=1)
    velocity.plot(t, first[:, 2], f"C{i}", label=f"{name}, from r")
    velocity.plot(t, second[:, 2], f"C{i}--", linewidth=2.5, alpha=0.6, label=f"{name}, from s")
    apart.semilogy(t[1:], difference[1:], label=name)
    print(f"{name}: velocities from the two benches are at most {difference.max():.1e} apart")
velocity.set(xlabel="t [s]", ylabel="dr/dt [m/s]")
apart.set(xlabel="t [s]", ylabel="|difference| of (dr/dt, dθ/dt) [m/s, rad/s]")
velocity.legend(fontsize=8)
apart.legend(fontsize=8, loc="upper right")
FIGURE.parent.mkdir(exist_ok=True)
save_figure(figure, FIGURE)
