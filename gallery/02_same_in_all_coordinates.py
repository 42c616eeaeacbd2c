"""One machine, two descriptions of it: the exact intrinsic observer gives the same velocities in both.

One ball-and-beam bench reports position and angle q = (r, θ) as they are. On another the signals pass logarithmic
amplifiers, z = asinh(q/c), which are fine near zero and coarse far out, and the model is written in z. An engineer
expects the same velocities from both. The exact observer (`Geodesic`) delivers them, to the accuracy of the
integration, since it is made of geometry alone. The explicit observer (`Intrinsic`) agrees to second order in its
error. A Kalman filter takes noise and slopes as they are in its coordinates, so its estimates depend on them. (It
starts faster than the others because its gain starts high.)
"""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant.geometry import Budget
from covariant.models import Lagrangian, ball_and_beam
from covariant.observers import EKF, Geodesic, Intrinsic, run
from covariant.report import PALETTE, new_figure, save_figure
from covariant.signals import Record
from covariant.simulation import simulate

FIGURE = Path(__file__).parent / "out" / "02_same_in_all_coordinates.png"

C = 0.3
"""Signal at which the amplifiers become logarithmic [m, rad]."""

bench = ball_and_beam()


def amplified(q):
    """What the other bench reads."""
    return jnp.arcsinh(q / C)


def position(z):
    """The inverse of `amplified`."""
    return C * jnp.sinh(z)


def slope(z):
    """The derivative of `position`, a number for each coordinate."""
    return C * jnp.cosh(z)


def state(x):
    """Position and velocity from those of the other bench."""
    z, w = jnp.split(x, 2)
    return jnp.concatenate([position(z), slope(z) * w])


other = Lagrangian(
    metric=lambda z: slope(z)[:, None] * bench.metric(position(z)) * slope(z),
    potential=lambda z: bench.potential(position(z)),
    force=lambda t, z, u: slope(z) * bench.force(t, position(z), u),
    inputs=1,
)

alpha, beta = 4.0, 8.0
middle = jnp.eye(2) / C  # what noise of q is as noise of z: right in the middle of the beam


def ekf(model, scale):
    """Noise that asks for about the same gains, the same at both benches."""
    return EKF(model, 0.64 * scale @ scale.T, 0.01 * scale @ scale.T, 1.0, substeps=8)


observers = {
    "Geodesic": [Geodesic(model, alpha, beta, Budget(steps=4), substeps=8) for model in (bench, other)],
    "Intrinsic": [Intrinsic(model, alpha, beta, substeps=8) for model in (bench, other)],
    "EKF": [ekf(bench, jnp.eye(2)), ekf(other, middle)],
}


def torque(s, x):
    """What keeps the ball swinging about the middle."""
    return (-20 * x[1] + 101 * x[0])[None]


t = jnp.linspace(0.0, 6.0, 301)
truth = eqx.filter_jit(simulate)(bench, jnp.array([0.02, 0.0, 0.1, 0.0]), t, torque)
read = [truth, Record(t, truth.u, jax.vmap(amplified)(truth.y))]  # the same motion as both benches report it

titles = ("Velocity of the ball from both benches", "How far the velocities of the two benches are apart")
figure, axes = new_figure(1, 2, panel=(5.6, 3.6), titles=titles, sharex=False)
velocity, apart = axes[0]
velocity.plot(t, truth.x[:, 2], color="0.7", linewidth=3.5, label="true")
for color, (name, pair) in zip(PALETTE, observers.items(), strict=False):
    plain, other_bench = (run(observer, record).estimate for observer, record in zip(pair, read, strict=True))
    logarithmic = jax.vmap(state)(other_bench)
    difference = np.linalg.norm((logarithmic - plain)[:, 2:], axis=1)
    apart.semilogy(t[1:], difference[1:], color, label=name)
    print(f"{name}: velocities from the two benches are at most {difference.max():.1e} apart")
    if name != "Intrinsic":  # it would hide the exact observer
        velocity.plot(t, plain[:, 2], color, label=f"{name}, from q")
        velocity.plot(t, logarithmic[:, 2], color, linestyle=":", linewidth=3, label=f"{name}, from z")
velocity.set(xlim=(0, 1.2), ylim=(-0.25, 0.15), xlabel="t [s]", ylabel="dr/dt [m/s]")
apart.set(ylim=(1e-13, 1), xlabel="t [s]", ylabel="|difference| of (dr/dt, dθ/dt) [m/s, rad/s]")
velocity.legend(fontsize=8, loc="lower left")
apart.legend(fontsize=8, loc="upper right", ncols=3)
FIGURE.parent.mkdir(exist_ok=True)
save_figure(figure, FIGURE)
