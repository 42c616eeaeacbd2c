"""Velocity errors of a smoother, of its filter and of slopes, with a right and a wrong model, and in holes at full
motion: the tables in docs/smoothing.md.

    python benchmarks/smoothing.py [RUNS]
"""

import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import covariant
from covariant import models, observers
from covariant.geometry import lie
from covariant.models import Motion
from covariant.observers.base import predict

MODEL = """
system = "pendulum_chain"
[parameters]
mass = [1.0]
length = [0.5]
viscous = [0.05]
[columns]
t = "t"
q = ["q1"]
u = ["u1"]
[measurement]
std = 2e-3
[uncertainty]
acceleration = 0.5
"""
TICK = 2 * np.pi / 2**16
ENCODER = {"measurement.quantum": TICK}
TRUSTING = {"measurement.std": TICK / 12**0.5, "uncertainty.acceleration": 0.005}
WRONG = {"parameters.mass": [0.95], "parameters.viscous": [0.065]}
CASES = (
    ("100 Hz, noise of 2 mrad", {"rate": 100.0, "noise": 2e-3}, {}),
    ("100 Hz, no noise", {"rate": 100.0, "noise": 1e-7}, {}),
    ("500 Hz, encoder of 16 bits", {"rate": 500.0, "quantum": TICK}, ENCODER),
    ("the same, acceleration a hundredth", {"rate": 500.0, "quantum": TICK}, TRUSTING),
)


STEP, BEFORE, AFTER = 0.01, 100, 60  # s, and rows before and after a hole
TICK_12 = 2 * np.pi / 2**12
NOISE = TICK_12**2 / 12 + 1e-8  # rad²
CORRELATION = 0.3  # s, of the acceleration that no model has


class Plant(NamedTuple):
    """A machine, the model of it with 5 % less gravity or inertia and 30 % less friction, and its usual motion.

    Attributes:
        true, model: Both models.
        slowest, fastest: Sizes of the first velocities.
        unmodelled: Standard deviation of the unmodelled accelerations.
    """

    true: models.MechanicalSystem
    model: models.MechanicalSystem
    slowest: np.ndarray
    fastest: np.ndarray
    unmodelled: float


def pendulum(wrong: bool) -> models.Lagrangian:
    gravity, friction = (20.0, 0.3) if wrong else (21.0, 0.39)
    return models.Lagrangian(
        lambda q: jnp.eye(1), lambda q: -gravity * jnp.cos(q[0]), dissipation=lambda q, v: -friction * v, circles=(0,)
    )


def chain(wrong: bool) -> models.MechanicalSystem:
    gravity, friction = (9.81, 0.01) if wrong else (1.05 * 9.81, 0.013)
    return models.pendulum_chain((1.0, 0.7), (0.5, 0.4), viscous=(friction, friction), gravity=gravity)


def cart_pole(wrong: bool) -> models.Lagrangian:
    gravity, friction = (9.81, 0.1) if wrong else (1.05 * 9.81, 0.13)
    return models.Lagrangian(
        lambda q: jnp.stack(
            [jnp.stack([1.5 + 0 * q[1], 0.25 * jnp.cos(q[1])]), jnp.stack([0.25 * jnp.cos(q[1]), 0.125 + 0 * q[1]])]
        ),
        lambda q: 0.25 * gravity * jnp.cos(q[1]),
        dissipation=lambda q, v: -friction * jnp.array([1.0, 0.05]) * v,
        circles=(1,),
    )


def body(wrong: bool) -> models.GroupSystem:
    inertia, friction = ((1.0, 2.0, 3.5), 0.1) if wrong else ((1.05, 2.0, 3.3), 0.13)
    return models.GroupSystem(lie.SO3, jnp.diag(jnp.array(inertia)), dissipation=lambda g, v: -friction * v)


PLANTS = {
    "pendulum": Plant(pendulum(False), pendulum(True), np.array([6.0]), np.array([12.0]), 6.0),
    "double pendulum": Plant(chain(False), chain(True), np.array([4.0, 4.0]), np.array([8.0, 8.0]), 3.0),
    "cart-pole": Plant(cart_pole(False), cart_pole(True), np.array([0.2, 6.0]), np.array([1.0, 12.0]), 3.0),
    "body on SO(3)": Plant(body(False), body(True), np.full(3, 2.0), np.full(3, 5.0), 2.0),
}


@eqx.filter_jit
def simulated(true: models.MechanicalSystem, start: Motion, u: jax.Array, extra: jax.Array) -> Motion:
    """Motion at each row, with an acceleration for each of the parts of a row in addition to the model's."""

    def row(motion, inputs):
        u, extra = inputs
        now = motion
        for acceleration in extra:
            motion = predict(true, 0.0, motion.q, motion.v, u, STEP / len(extra), 1)
            motion = Motion(motion.q, motion.v + acceleration * STEP / len(extra))
        return motion, now

    return jax.lax.scan(row, start, (u, extra))[1]


def log_with_hole(plant: Plant, rows: int, seed: int) -> covariant.Record:
    """A log with a hole of so many rows; `x` is the true motion."""
    rng, count = np.random.default_rng(seed), BEFORE + rows + AFTER
    n = len(plant.slowest)
    v = rng.uniform(plant.slowest, plant.fastest) * rng.choice([-1, 1], n)
    group = not plant.model.manifold.commuting
    q = lie.SO3.exp(jnp.asarray(rng.normal(size=3))) if group else jnp.asarray(rng.uniform(-3, 3, n))
    t, parts = STEP * np.arange(count), 4
    u = np.sin(3 * t[:, None] + rng.uniform(0, 6, n)) * (8.0 if n == 1 else 1.0)
    extra, forget = [plant.unmodelled * rng.normal(size=n)], STEP / parts / CORRELATION
    for _ in range(parts * count - 1):
        extra.append(extra[-1] * (1 - forget) + plant.unmodelled * np.sqrt(2 * forget) * rng.normal(size=n))
    x = simulated(plant.true, Motion(q, jnp.asarray(v)), jnp.asarray(u), jnp.asarray(extra).reshape(count, parts, n))
    if group:
        y = np.asarray(
            jax.vmap(lambda g, e: g @ lie.SO3.exp(e))(x.q, NOISE**0.5 * jnp.asarray(rng.normal(size=(count, 3))))
        )
    else:
        wide = np.round(np.asarray(x.q) / TICK_12) * TICK_12
        y = np.where(np.isin(np.arange(n), plant.model.manifold.circles), (wide + np.pi) % (2 * np.pi) - np.pi, wide)
    y = np.array(y)
    y[BEFORE : BEFORE + rows] = np.nan
    return covariant.Record(t, u, y, x)


def holes(runs: int) -> None:
    """Print the errors in holes, of the filter and the smoother."""
    for name, plant in PLANTS.items():
        density = 2 * CORRELATION * plant.unmodelled**2
        speed = np.diag(plant.fastest**2)
        n = len(speed)
        # Accelerations that are equally likely in every direction of the coordinates.
        kalman = observers.IntrinsicKalman(plant.model, density * np.eye(n), NOISE * np.eye(n), speed, substeps=1)
        for seconds in (0.5, 1.0):
            rows, errors, within, right, sure, wrong = round(seconds / STEP), [], [], 0, 0, 0
            for seed in range(runs):
                record = log_with_hole(plant, rows, seed)
                result = observers.smooth(kalman, record)
                hole, end = slice(BEFORE, BEFORE + rows), BEFORE + rows
                true = np.asarray(record.x.v)
                v, filtered = (_velocities(run.estimate, n) - true for run in (result.run, result.filtered))
                errors.append([np.mean(v[hole] ** 2), np.mean(filtered[hole] ** 2)])
                within.append(np.abs(v[hole]) < 1.96 * np.asarray(result.run.info.velocity_std)[hole])
                if plant.model.manifold.commuting:
                    q = np.asarray(result.run.estimate)[:, :n]
                    moved = np.abs((q[end] - q[BEFORE - 1]) - np.asarray(record.x.q[end] - record.x.q[BEFORE - 1]))
                    good, certain = (moved < 1).all(), all(each.probability > 0.95 for each in result.holes)
                    right, sure, wrong = right + good, sure + certain, wrong + (certain and not good)
            smoother, filtered = np.sqrt(np.mean(errors, axis=0))
            print(
                f"{name}, hole of {seconds:g} s: filter {filtered:.2f}, smoother {smoother:.2f} rad/s; "
                f"ratio {smoother / filtered:.2f}; {100 * np.mean(within):.0f} % within 95 % bands; turns right in "
                f"{right} of {runs}, sure in {sure}, of these wrong {wrong}",
                flush=True,
            )


def _velocities(estimate, n: int) -> np.ndarray:
    return np.asarray(estimate.v if isinstance(estimate, Motion) else estimate[:, n:])


def main() -> None:
    """Print the tables."""
    holes(int(sys.argv[1]) if len(sys.argv) > 1 else 30)
    with tempfile.TemporaryDirectory() as folder:
        model, log = Path(folder) / "pendulum.toml", Path(folder) / "log.csv"
        model.write_text(MODEL)
        for name, sensor, overrides in CASES:
            simulated = covariant.simulate(model, duration=10.0, q0=[1.0], amplitude=[1.0], seed=1, **sensor)
            simulated.save(log)
            true = simulated.columns["true_v1"]
            for which, change in (("right", {}), ("wrong", WRONG)):
                result = covariant.smooth(model, log, overrides=overrides | change, score=True)
                slopes = result.smoothed.loaded.reference.v
                errors = (
                    np.sqrt(np.mean((v[50:-50, 0] - true[50:-50]) ** 2))
                    for v in (result.filtered.velocity, result.velocity, slopes)
                )
                print(
                    f"{name}, model {which}: filter, smoother, slopes",
                    *(f"{error:.2g}" for error in errors),
                    f"rad/s; the smoother says {np.median(result.velocity_std):.2g}, NIS {result.summary['nis']:.4g}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
