"""What pushes my robot: the torque of somebody's hand on a joint, from encoders and a model, without a force sensor.

A double pendulum is driven by its motors, and pushed twice at its first joint. A Kalman filter estimates the push as a
torque that comes and goes, with a band that says how far it may be trusted. A momentum observer takes a filtered
derivative for the velocity. Where the model lacks the friction of the joints, the filter takes friction for a push;
where it estimates the friction along with the motion, it does not.
"""

import dataclasses
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from covariant import models, simulation
from covariant.observers import (
    FilteredDerivative,
    IntrinsicKalman,
    MomentumObserver,
    external_force,
    observed_forces,
    run,
    uncertain_parameters,
)
from covariant.report import PALETTE, new_figure, save_figure
from covariant.signals import Record

FIGURE = Path(__file__).parent / "out" / "15_what_pushes_my_robot.png"
PUSH, BEGIN, LENGTH = 0.6, (3.0, 6.0), 1.0
NOISE, FRICTION = 2e-4, (0.1, 0.05)

arm = {"mass": (1.0, 0.7), "length": (0.5, 0.4), "viscous": (0.05, 0.02)}
t = np.arange(0.0, 9.0, 0.005)


def motors(s):
    """Torques of the motors."""
    return jnp.stack([jnp.sin(jnp.pi * s), 0.5 * jnp.sin(4.3 * s)])


def push(s):
    """Torques of the hand: a push and a pull, each for a second."""
    (first, second), within = BEGIN, lambda begin: jnp.clip((s - begin) / LENGTH, 0.0, 1.0)
    height = (jnp.cos(2 * jnp.pi * within(second)) - jnp.cos(2 * jnp.pi * within(first))) / 2
    return jnp.stack([PUSH * height, 0.0 * s])


def torques(s, x):
    return motors(s) + push(s)


def recorded(coulomb):
    """A log of the machine: encoders with noise, and the torques of its motors."""
    machine = models.pendulum_chain(**arm, coulomb=coulomb)
    q = np.asarray(
        eqx.filter_jit(simulation.simulate)(machine, jnp.array([1.0, 0.5, 0.0, 0.0]), jnp.asarray(t), torques).x
    )[:, :2]
    middle = np.asarray(motors(t + 0.0025)).T  # in the middle of the time until the next row
    return Record(t, middle, q + NOISE * np.random.default_rng(0).normal(size=q.shape))


rough = recorded(FRICTION)
numbers = {f"parameters.{name}": list(values) for name, values in arm.items()} | {"parameters.coulomb": [0.03, 0.03]}
# The friction of a joint is estimated as a factor exp(z) of a first value, which may be wrong by as much as itself.
estimated = uncertain_parameters(models.family("pendulum_chain", ["coulomb"], numbers), 1.0)
exact = {"first_cov": jnp.zeros((2, 2))}
known = dataclasses.replace(estimated, first=jnp.log(jnp.array(FRICTION) / 0.03), **exact)
lacking = dataclasses.replace(estimated, first=jnp.full(2, -12.0), **exact)
hand = external_force(std=(0.2, 0.1), time=0.3)


def filtered(friction):
    covs = 5e-5 * jnp.eye(2), NOISE**2 * jnp.eye(2), jnp.eye(2)
    model = models.pendulum_chain(**arm)
    return run(IntrinsicKalman(model, *covs, (hand, friction), substeps=1), rough, ("result", "slow", "slow_std")).info


motion = np.asarray(run(FilteredDerivative(100.0, circles=(0, 1)), rough).estimate)
momentum = MomentumObserver(models.pendulum_chain(**arm, coulomb=FRICTION), gain=10.0)
upper = {
    "Kalman filter": filtered(known),
    "momentum observer": observed_forces(momentum, t, rough.u, motion[:, :2], motion[:, 2:])[:, 0],
}
lower = {"friction estimated along": filtered(estimated), "friction lacking": filtered(lacking)}
true = np.asarray(push(t)[0])

titles = ("The model knows the friction of the joints, 0.1 and 0.05 N m", "It does not know it")
figure, axes = new_figure(2, 1, panel=(8.0, 2.5), titles=titles, sharex=True)
for ax, estimates in zip(axes[:, 0], (upper, lower), strict=True):
    ax.plot(t, true, color=PALETTE.truth, linewidth=3.5, label="true push")
    for color, (name, info) in zip((PALETTE.covariant, PALETTE.purple), estimates.items(), strict=True):
        force = np.asarray(info.slow[:, 0] if hasattr(info, "slow") else info)
        off = np.sqrt(np.mean((force - true)[t > 1] ** 2))
        print(f"{name}: {off:.3f} N m off, RMS")
        if hasattr(info, "slow") and color == PALETTE.covariant:
            band = 1.96 * np.asarray(info.slow_std)[:, 0]
            ax.fill_between(t, force - band, force + band, color=color, alpha=0.2, linewidth=0, label="95 % band")
        ax.plot(t, force, color=color, linewidth=1.0, label=name)
    ax.set(ylabel="torque on joint 1 [N m]", ylim=(-0.95, 1.25), xlim=(1.0, 9.0))
    ax.legend(loc="upper right", ncols=4)
axes[1, 0].set(xlabel="t [s]")
FIGURE.parent.mkdir(exist_ok=True)
save_figure(figure, FIGURE)
