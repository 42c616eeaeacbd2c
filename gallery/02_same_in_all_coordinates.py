"""One machine, two descriptions of it: the exact intrinsic observer gives the same velocities in both.

A puck glides on an air table between springs. A camera reads its position as x and y, a scanner beside the table as
range and bearing, and the model can be written in either. An engineer expects the same velocities from both. The exact
observer (`Geodesic`) delivers them, to the accuracy of the integration, since it is made of geometry alone. The
explicit observer (`Intrinsic`) agrees to second order in its error, so the better the closer it is. A Kalman filter
takes slopes and noise as they are in its coordinates, so its estimates depend on them for good. (It starts faster than
the others because it is told to expect velocities of 1 m/s; their gains are constant.)

Figure: at most 6e-10 m/s between the two descriptions for Geodesic, 0.02 m/s for Intrinsic, 0.3 m/s for the EKF, in
the first moments.
"""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant.geometry import Budget
from covariant.models import Lagrangian
from covariant.observers import EKF, Geodesic, Intrinsic, run
from covariant.report import PALETTE, new_figure, save_figure
from covariant.signals import Record
from covariant.simulation import simulate

FIGURE = Path(__file__).parent / "out" / "02_same_in_all_coordinates.png"

MIDDLE, STIFFNESS = jnp.array([0.6, 0.2]), jnp.array([4.0, 9.0])
"""Where the springs pull to [m], seen from the scanner, and how strongly, by the mass of the puck [1/s²]."""


def springs(p):
    """Potential energy by mass at the point p = (x, y)."""
    return STIFFNESS @ (p - MIDDLE) ** 2 / 2


def scanned(p):
    """Range and bearing of a point."""
    return jnp.stack([jnp.hypot(p[0], p[1]), jnp.arctan2(p[1], p[0])])


def point(z):
    """The inverse of `scanned`."""
    return z[0] * jnp.stack([jnp.cos(z[1]), jnp.sin(z[1])])


def state(x):
    """(x, y) and their velocities from range, bearing and theirs."""
    z, w = jnp.split(x, 2)
    return jnp.concatenate(jax.jvp(point, (z,), (w,)))


camera = Lagrangian(lambda p: jnp.eye(2, dtype=p.dtype), springs)
scanner = Lagrangian(lambda z: jnp.diag(jnp.stack([jnp.ones_like(z[0]), z[0] ** 2])), lambda z: springs(point(z)))

t = jnp.linspace(0.0, 5.0, 251)
truth = eqx.filter_jit(simulate)(camera, jnp.array([1.0, 0.2, 0.0, 1.2]), t)
y = truth.y + 0.02 * jax.random.normal(jax.random.key(0), truth.y.shape)
read = [Record(t, truth.u, y), Record(t, truth.u, jax.vmap(scanned)(y))]  # the same readings in both forms

alpha, beta = 4.0, 8.0
acceleration, noise = 5e-4 * jnp.eye(2), 0.02**2 * jnp.eye(2)  # a Kalman filter that comes to the same gains,
away = jnp.diag(jnp.array([1.0, 0.6**-2]))  # and, in range and bearing, what that is at the middle of the table
observers = {
    "Geodesic": [Geodesic(model, alpha, beta, Budget(), substeps=8) for model in (camera, scanner)],
    "Intrinsic": [Intrinsic(model, alpha, beta, substeps=8) for model in (camera, scanner)],
    "EKF": [EKF(camera, acceleration, noise, substeps=8), EKF(scanner, acceleration @ away, noise @ away, substeps=8)],
}

titles = ("Velocity of the puck from both instruments", "How far the two velocities are apart")
figure, axes = new_figure(1, 2, panel=(4.5, 3.4), titles=titles, sharex=False)
velocity, apart = axes[0]
velocity.plot(t, truth.x[:, 3], color=PALETTE.truth, linewidth=3.5, label="true")
for color, (name, pair) in zip((PALETTE.covariant, PALETTE.sky, PALETTE.ekf), observers.items(), strict=True):
    from_camera, from_scanner = (run(observer, record).estimate for observer, record in zip(pair, read, strict=True))
    from_scanner = jax.vmap(state)(from_scanner)
    difference = np.linalg.norm((from_scanner - from_camera)[:, 2:], axis=1)
    apart.semilogy(t[1:], difference[1:], color, label=f"{name}: at most {difference.max():.0e} m/s")
    print(f"{name}: velocities from the two instruments are at most {difference.max():.1e} m/s apart")
    if name != "Intrinsic":  # one more pair of curves would only hide the others
        velocity.plot(t, from_camera[:, 3], color, label=f"{name}, camera")
        velocity.plot(t, from_scanner[:, 3], color, linestyle=":", linewidth=3, label=f"{name}, scanner")
velocity.set(xlim=(0, 2.2), xlabel="t [s]", ylabel="dy/dt [m/s]")
apart.set(ylim=(1e-14, 1e3), xlabel="t [s]", ylabel="|difference| [m/s]")
velocity.legend(loc="lower right")
apart.legend(loc="upper left")
FIGURE.parent.mkdir(exist_ok=True)
save_figure(figure, FIGURE)
