"""A four-bar linkage from the encoder of its motor alone.

Crank, coupler and rocker hang together by a pin, so that the crank's angle tells the angles of all. The observer of
Aghannan and Rouchon runs on the surface of the configurations in which the linkage is closed, without coordinates on
it: its estimates stay there, and no multipliers are estimated. Beside it the crank's angle is differentiated over one
sample, and the linkage's kinematics carry the rate to the other links.
"""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant import models, observers, simulation
from covariant.report import PALETTE, new_figure, save_figure
from covariant.signals import Record

FIGURE = Path(__file__).parent / "out" / "20_closed_loops.png"
NOISE, DT = 1e-3, 0.005

linkage = models.robots.load("four_bar")
space, start = linkage.space, linkage.space.assembly
t = np.arange(0.0, 4.0, DT)
motion = eqx.filter_jit(simulation.simulate)(
    linkage,
    jnp.concatenate([start, jnp.zeros(3)]),
    jnp.asarray(t),
    lambda s, x: 2.0 * jnp.sin(jnp.pi * s)[None],
)
q, v = np.split(np.asarray(motion.x), 2, axis=1)

# Coupler and rocker have no encoder.
y = np.full_like(q, np.nan)
y[:, 0] = q[:, 0] + NOISE * np.random.default_rng(0).normal(size=len(t))
run = observers.run(observers.Intrinsic(linkage, 63.0, 2000.0), Record(t, np.asarray(motion.u), y))
estimate = np.asarray(run.estimate)

slope = np.diff(y[:, 0], prepend=y[0, 0]) / DT


@jax.jit
def carried(q, rate):
    """Velocity of the linkage where its crank turns at a rate."""
    rows = space.normals(q).rows
    return rate * jnp.concatenate([jnp.ones(1), -jnp.linalg.solve(rows[:, 1:], rows[:, 0])])


differentiated = np.asarray(jax.vmap(carried)(jnp.asarray(estimate[:, :3]), jnp.asarray(slope)))
late = t > 0.2
for name, rate in (("observer", estimate[:, 3:]), ("difference", differentiated)):
    rmse = np.sqrt(np.mean((rate - v)[late] ** 2, axis=0))
    print(f"{name}: RMSE of crank {rmse[0]:.3f}, coupler {rmse[1]:.3f}, rocker {rmse[2]:.3f} rad/s")
gap = np.abs(np.asarray(jax.vmap(space.constraint)(jnp.asarray(estimate[:, :3])))).max()
print(f"the estimates leave the pin open by {gap:.0e} m at most")

figure, axes = new_figure(2, 1, panel=(8.0, 2.4), titles=("Rocker [rad/s]", "Error [rad/s]"), sharex=True)
rate, error = axes[:, 0]
rate.plot(t, v[:, 2], color=PALETTE.truth, label="true")
for color, name, found in (
    (PALETTE.sky, "difference of the crank's encoder", differentiated),
    (PALETTE.covariant, "observer, from the same encoder", estimate[:, 3:]),
):
    rate.plot(t, found[:, 2], color=color, label=name, linewidth=0.8)
    error.plot(t, found[:, 2] - v[:, 2], color=color, linewidth=0.8)
rate.set_ylim(-22, 32)
rate.legend(loc="upper right", ncols=3)
error.set_xlabel("t [s]")
FIGURE.parent.mkdir(exist_ok=True)
save_figure(figure, FIGURE)
