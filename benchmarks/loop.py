"""An arm under computed torque whose velocities come from encoders: torque ripple and tracking error against the gain.

python benchmarks/loop.py

MuJoCo moves a Panda at 1 kHz. Its masses are each off by up to 5 %, each joint has friction that nobody knows, of up
to .6 N m and .6 N m s. Torques have noise of .05 N m and act one sample late, and a load comes and goes. The controller
is `M(a + w²e + 1.6wė) + h` by the file of the robot. Its velocity comes from a filtered difference, from a tracking
loop of second or third order, or from the C that `covariant.export` writes of `IntrinsicForce`, with and without force.
Ripple is the root mean square of the torque above about 25 Hz.
"""

import importlib
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import covariant
from covariant import observers
from covariant.models import robots

RATE, STEPS, SECONDS = 1000.0, 4, 1.6
REST = np.array([0.0, 0.2, 0.0, -1.6, 0.0, 1.8, 0.5])
SWING = np.array([0.4, 0.25, 0.35, 0.3, 0.45, 0.35, 0.5])
PACE = np.array([2.1, 2.9, 2.5, 3.3, 3.7, 2.3, 4.1])
FRICTION = np.array([0.6, 0.6, 0.5, 0.5, 0.3, 0.3, 0.2])
NOISE, MASSES, LOST = 0.05, 0.05, 0.5
LOAD, LOADED = np.array([0.0, 4.0, 0.0, 2.0, 0.0, 0.0, 0.0]), (0.6, 1.1)
DAMPING, THIRD = 0.5**0.5, 0.35
"""Damping ratio of two poles, and the third one, the rate at which the force is learnt, over their frequency."""
GAINS = (60.0, 75.0, 90.0, 110.0, 130.0, 155.0, 180.0, 210.0, 240.0)


class Source:
    """An observer of the library without a model, with the methods of an exported one."""

    def __init__(self, observer: observers.AbstractObserver):
        self.state, self._init = None, observer.init
        self._step = jax.jit(lambda state, y, dt: observer.step(state, jnp.zeros(0), y, dt)[0])
        self._estimate = observer.estimate

    def step(self, y: np.ndarray, dt: float, u: np.ndarray) -> None:
        """Take a sample, or start from it."""
        self.state = self._init(jnp.asarray(y)) if self.state is None else self._step(self.state, y, dt)

    def estimate(self) -> list[np.ndarray]:
        """Positions and velocities."""
        return np.split(np.asarray(self._estimate(self.state)), 2)


class Row(NamedTuple):
    """Torque ripple [N m], tracking error [mrad] and velocity error [rad/s], root mean squares over all joints."""

    ripple: float
    tracking: float
    velocity: float

    def __str__(self) -> str:
        return f"{self.ripple:.2f} / {self.tracking:.2f}"


def exported(folder: str) -> Any:
    """The module of the observer in C, by the file of the robot."""
    tick = 2 * np.pi / 2**17
    overrides = {
        "measurement.std": tick / 12**0.5,
        "uncertainty.acceleration": 1.0,
        "uncertainty.motion_acceleration": 10.0,
        "uncertainty.motion_time": 0.2,
        "design.natural_frequency": 180.0,
        "design.force_rate": THIRD * 180.0,
    }
    names = ["alpha", "beta", "force_rate"]
    covariant.export(
        "panda", folder, rate=RATE, name="arm", python=True, parameters=names, audit=False, overrides=overrides
    )
    sys.path.insert(0, f"{folder}/python")
    return importlib.import_module("arm")


def with_force(arm: Any, frequency: float = 130.0, third: float = THIRD) -> Callable[[], Any]:
    """The exported observer with poles at a frequency [rad/s], and at `third` times it."""
    gains = {"alpha": 2 * DAMPING * frequency, "beta": frequency**2, "force_rate": third * frequency}
    return lambda: arm.Observer(gains)


def machine(masses: float = 0.0, friction: float = 0.0) -> mujoco.MjModel:
    """The robot of the file, with factors of its masses and inertias, and a share of `FRICTION`."""
    model = mujoco.MjModel.from_xml_string(robots.located("panda").read_text(encoding="utf-8"))
    model.opt.timestep, model.opt.gravity[:] = 1 / (RATE * STEPS), (0, 0, -9.81)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    factors = np.random.default_rng(7).uniform(1 - masses, 1 + masses, model.nbody)
    model.jnt_limited[:], model.dof_armature[:] = 0, 0
    model.body_mass[:] *= factors
    model.body_inertia[:] *= factors[:, None]
    model.dof_frictionloss[:], model.dof_damping[:] = friction * FRICTION, friction * FRICTION
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def run(make: Callable[[], Any], gain: float, bits: int = 17, seconds: float = SECONDS, seed: int = 0) -> Row | None:
    """A run in which the velocity comes from an observer; None where the loop is unstable."""
    plant, known, random, observer = machine(MASSES, 1.0), machine(), np.random.default_rng(seed), make()
    real, expected, inertia = mujoco.MjData(plant), mujoco.MjData(known), np.zeros((7, 7))
    dt, tick, count = 1 / RATE, 2 * np.pi / 2**bits, round(seconds * RATE)
    real.qpos[:] = REST
    mujoco.mj_forward(plant, real)
    acting, sent, rows = np.zeros(7), None, np.empty((count, 3, 7))
    for k in range(count):
        observer.step(tick * np.round(real.qpos / tick), dt, u=acting)
        q, v = observer.estimate()[:2]
        turn = PACE * k * dt
        ahead = REST + SWING * (1 - np.cos(turn)), SWING * PACE * np.sin(turn), SWING * PACE**2 * np.cos(turn)
        expected.qpos[:], expected.qvel[:] = q, v
        mujoco.mj_fwdPosition(known, expected)
        mujoco.mj_fwdVelocity(known, expected)
        mujoco.mj_fullM(known, expected, inertia)
        new = inertia @ (ahead[2] + gain**2 * (ahead[0] - q) + 1.6 * gain * (ahead[1] - v)) + expected.qfrc_bias
        rows[k] = new, ahead[0] - real.qpos, v - real.qvel
        if not (np.isfinite(rows[k]).all() and np.abs(rows[k, 1]).max() < LOST):
            return None
        # The command of a sample acts over the next one.
        acting, sent = (new if sent is None else sent), new
        loaded = LOAD if LOADED[0] < k * dt < LOADED[1] else 0.0
        real.qfrc_applied[:] = acting + NOISE * random.standard_normal(7) + loaded
        mujoco.mj_step(plant, real, nstep=STEPS)
    window = np.hanning(41) / np.hanning(41).sum()
    fast = rows[:, 0] - np.apply_along_axis(lambda u: np.convolve(u, window, "same"), 0, rows[:, 0])
    rms = [np.sqrt(np.mean(part**2)) for part in (fast[320:-40], rows[300:, 1], rows[300:, 2])]
    return Row(rms[0], 1e3 * rms[1], rms[2])


def rows(make: Callable[[], Any], bits: int, gains: Sequence[float] = GAINS) -> list[Row | None]:
    """Runs at rising gains, up to the first that is unstable."""
    found: list[Row | None] = []
    for gain in gains:
        found.append(None if found and found[-1] is None else run(make, gain, bits))
    return found


def damping_at(found: Sequence[Row | None], limit: float) -> float:
    """Largest Kd = 1.6 w [1/s] with a ripple below a limit, between those of `GAINS`; NaN where it is never below."""
    stable = [(w, row.ripple) for w, row in zip(GAINS, found, strict=True) if row is not None]
    over = next((i for i, (_, ripple) in enumerate(stable) if ripple > limit), len(stable))
    if over in (0, len(stable)):
        return np.nan if over == 0 else 1.6 * stable[-1][0]
    (w0, r0), (w1, r1) = stable[over - 1 : over + 1]
    return float(1.6 * w0 * (w1 / w0) ** (np.log(limit / r0) / np.log(r1 / r0)))


def main() -> None:
    """Print a table for two encoders, and the gain at equal ripple of each kind with its best bandwidth."""

    def differences(f: float) -> Callable[[], Any]:
        return lambda: Source(observers.FilteredDerivative(2 * np.pi * f))

    def loops(kind: Any, frequency: float) -> Callable[[], Any]:
        return lambda: Source(kind(frequency))

    with tempfile.TemporaryDirectory() as folder:
        arm = exported(f"{folder}/c")
        kinds = {
            "filtered difference, Hz": (differences, (10.0, 15.0, 20.0, 25.0, 30.0, 60.0)),
            "tracking loop of 2nd order, rad/s": (partial(loops, observers.PLL), (200.0, 250.0, 300.0, 400.0, 600.0)),
            "tracking loop of 3rd order, rad/s": (partial(loops, observers.HighGain), (150.0, 200.0, 250.0, 400.0)),
            "`IntrinsicForce`, rad/s": (partial(with_force, arm), (100.0, 130.0, 180.0, 250.0)),
            "without its force, rad/s": (partial(with_force, arm, third=0.0), (180.0, 400.0, 800.0)),
        }
        for bits, limit in ((17, 1.0), (20, 0.2)):
            print(f"\n| {bits} bits | {' | '.join(f'w = {w:g}' for w in GAINS)} | Kd at {limit:g} N m |")
            print("|---" * (len(GAINS) + 2) + "|")
            for kind, (make, bandwidths) in kinds.items():
                for bandwidth in bandwidths:
                    found = rows(make(bandwidth), bits)
                    cells = " | ".join(str(row or "unstable") for row in found)
                    print(f"| {kind} {bandwidth:g} | {cells} | {damping_at(found, limit):.0f} |", flush=True)


if __name__ == "__main__":
    main()
