"""What pushes a Panda, and what a gyro on its last link is worth: prints the tables of docs/forces.md and sensors.md.

Run `python benchmarks/panda_sensors.py` from the repository's root, with MuJoCo installed. MuJoCo moves the arm, whose
masses and inertias are each off by up to 5 %; the file of the robot knows nothing of it. Torques are held from row to
row. The momentum observer has velocities by a filtered derivative; its bandwidth and gain are the best for the true
force of this very log, and it takes the wrench from the torques by a pseudo-inverse.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from covariant import Record, engine, models, observers
from covariant.models import robots

LINK, REST = "panda_link7", np.array([0.0, 0.2, 0.0, -1.6, 0.0, 1.8, 0.5])
STRAIGHT = np.array([0.0, 0.2, 0.0, -0.12, 0.0, 0.3, 0.5])
"""Poses about which the arm moves; in the second the elbow is nearly stretched."""
TICK, STEPS = 2 * np.pi / 2**17, 4
FRICTION = np.array([0.8, 1.0, 0.7, 0.8, 0.4, 0.35, 0.3])
"""Coulomb friction of the joints, where there is some [N m]."""
SIZE = np.array([6.0, 6.0, 6.0, 0.6, 0.6, 0.6])
"""Largest forces and torques of the pushes, in the axes of the link [N and N m]."""
SETTLED = 0.5


class Motion(NamedTuple):
    """Rows of a simulation: inputs, true motion, wrench and angular velocity of the link, in its axes."""

    t: np.ndarray
    u: np.ndarray
    q: np.ndarray
    v: np.ndarray
    wrench: np.ndarray
    spin: np.ndarray


def pushes(t: float, seconds: float, seed: int) -> np.ndarray:
    """Wrench (6,): each push rises and falls within .8 s, one in two seconds, in a direction of its own."""
    random = np.random.default_rng(seed).uniform(-1, 1, (int(seconds / 2) + 2, 6))
    k, phase = int(t // 2), t % 2 - 0.6
    return SIZE * random[k] * np.sin(np.pi * phase / 0.8) ** 2 if 0 < phase < 0.8 else np.zeros(6)


def moved(seconds: float, rate: int, rest: np.ndarray, friction: np.ndarray, pushed: bool, seed: int = 0) -> Motion:
    """An arm under a controller that knows the file only."""
    random = np.random.default_rng(seed)
    machine = mujoco.MjModel.from_xml_string(robots.located("panda").read_text(encoding="utf-8"))
    machine.opt.timestep, machine.opt.integrator = 1 / (rate * STEPS), mujoco.mjtIntegrator.mjINT_RK4
    machine.opt.gravity[:] = 0, 0, -9.81
    machine.jnt_limited[:] = 0
    machine.dof_damping[:], machine.dof_frictionloss[:], machine.dof_armature[:] = 0, 0, 0
    known, body = mujoco.MjData(machine), machine.body(LINK).id
    nominal = machine.body_mass.copy(), machine.body_inertia.copy()
    factor = random.uniform(0.95, 1.05, len(nominal[0]))
    pace, phase = 2 * np.pi * random.uniform(0.2, 0.6, (3, 7)), random.uniform(0, 2 * np.pi, (3, 7))
    size = random.uniform(0.1, 0.25, (3, 7)) if rest is REST else random.uniform(0.01, 0.03, (3, 7))
    mujoco.mj_setConst(machine, known)
    data, count = mujoco.MjData(machine), int(seconds * rate)
    real = mujoco.MjModel.from_xml_string(robots.located("panda").read_text(encoding="utf-8"))
    real.opt.timestep, real.opt.integrator, real.opt.gravity[:] = (
        machine.opt.timestep,
        machine.opt.integrator,
        machine.opt.gravity,
    )
    real.jnt_limited[:], real.dof_damping[:], real.dof_frictionloss[:], real.dof_armature[:] = 0, 0, 0, 0
    real.body_mass[:], real.body_inertia[:] = factor * nominal[0], factor[:, None] * nominal[1]
    mujoco.mj_setConst(real, data)

    def wanted(t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        s, c = np.sin(pace * t + phase), np.cos(pace * t + phase)
        return (
            rest + np.sum(size * (s - np.sin(phase)), axis=0),
            np.sum(size * pace * c, axis=0),
            -np.sum(size * pace**2 * s, axis=0),
        )

    data.qpos[:], data.qvel[:] = wanted(0.0)[:2]
    rows: list[tuple[np.ndarray, ...]] = []
    inertia, spin = np.zeros((7, 7)), np.zeros(6)

    def passive(_: Any, now: Any) -> None:
        now.qfrc_passive[:] -= friction * np.tanh(now.qvel / 0.02)

    mujoco.set_mjcb_passive(passive)
    try:
        for k in range(count):
            aim, pace_now, pull = wanted(k / rate)
            mujoco.mj_forward(real, data)
            known.qpos[:], known.qvel[:] = data.qpos, data.qvel
            mujoco.mj_forward(machine, known)
            mujoco.mj_fullM(machine, known, inertia)
            u = inertia @ (pull + 100 * (aim - data.qpos) + 20 * (pace_now - data.qvel)) + known.qfrc_bias
            mujoco.mj_objectVelocity(real, data, mujoco.mjtObj.mjOBJ_XBODY, body, spin, 1)
            push = pushes(k / rate, seconds, seed + 1) if pushed else np.zeros(6)
            rows.append((u, data.qpos.copy(), data.qvel.copy(), push, spin[:3].copy()))
            for i in range(STEPS):
                now = (k + i / STEPS) / rate
                push = pushes(now, seconds, seed + 1) if pushed else np.zeros(6)
                turn, generalized = data.xmat[body].reshape(3, 3), np.zeros(7)
                mujoco.mj_applyFT(real, data, turn @ push[:3], turn @ push[3:], data.xpos[body], body, generalized)
                data.qfrc_applied[:] = u + generalized
                mujoco.mj_step(real, data)
    finally:
        mujoco.set_mjcb_passive(None)
    return Motion(np.arange(count) / rate, *(np.array(column) for column in zip(*rows, strict=True)))


def rms(error: np.ndarray) -> float:
    """Root mean square over rows, of the length of a vector."""
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def sizes(wrench: np.ndarray, true: np.ndarray) -> str:
    """Errors of force and torque, of a component."""
    off = (wrench - true) ** 2
    return f"{np.sqrt(off[:, :3].mean()):.2f} N, {np.sqrt(off[:, 3:].mean()):.3f} N m"


def best_momentum(model: models.MechanicalSystem, log: Motion, y: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Wrenches (T, 6) by the momentum observer that is best for the true ones, of all bandwidths and gains."""
    jacobian = jax.jit(jax.vmap(lambda q: model.space.jacobian(q, LINK)))(jnp.asarray(log.q))
    inverse = np.linalg.pinv(np.swapaxes(np.asarray(jacobian), 1, 2))
    best, least = log.wrench, np.inf
    by = jax.jit(
        jax.vmap(
            lambda k, q, v: observers.observed_forces(observers.MomentumObserver(model, k), log.t, log.u, q, v),
            (0, None, None),
        )
    )
    gains = jnp.array([5.0, 10.0, 20.0, 40.0])
    for bandwidth in (50.0, 100.0, 200.0, 400.0):
        derivative = observers.FilteredDerivative(jnp.asarray(bandwidth), model.circles)
        run = observers.run(derivative, Record(log.t, np.zeros_like(log.u), y), ())
        q, v = np.split(np.asarray(run.estimate), 2, axis=1)
        for force in np.asarray(by(gains, jnp.asarray(q), jnp.asarray(v))):
            found = np.einsum("tij,tj->ti", inverse, force)
            error = float(np.sum(((found - log.wrench)[counts] / SIZE) ** 2))
            if error < least:
                best, least = found, error
    return best


def forces() -> None:
    """Errors of a wrench at the last link."""
    model = models.robots.load("panda")
    noise = np.full(7, TICK**2 / 12)
    hand = observers.wrench(model.space, LINK, SIZE[:3] / 3, SIZE[3:] / 3, time=0.3, name="hand")
    cases = (("masses off", REST, 0.0), ("friction unknown as well", REST, 1.0), ("nearly stretched", STRAIGHT, 0.0))
    for name, rest, dry in cases:
        log = moved(20.0, 250, rest, dry * FRICTION, pushed=True)
        y = TICK * np.round(log.q / TICK)
        counts = log.t > SETTLED
        print(f"{name}: size of the truth {sizes(0 * log.wrench[counts], log.wrench[counts])}")
        beside = {"friction as forces of the joints": 0.3 * FRICTION + dry * FRICTION, "no friction": None}
        for what, std in beside.items():
            joints = () if std is None else (observers.external_force(std=std, time=0.3),)
            kalman = observers.IntrinsicKalman(model, 1e-3, np.diag(noise), 1.0, (hand, *joints), substeps=1)
            (run,), used = engine.run_logs([kalman], Record(log.t, log.u, y), ("slow", "slow_std", "nis"), "jax")
            found, std_ = np.asarray(run.info.slow)[counts, :6], np.asarray(run.info.slow_std)[counts, :6]
            covered = np.mean(np.abs(found - log.wrench[counts]) < 1.96 * std_)
            nis = np.nanmean(np.asarray(run.info.nis)[counts]) / 7
            print(
                f"  filter, {what}: {sizes(found, log.wrench[counts])}; in band {covered:.2f}, NIS {nis:.2f} ({used})",
                flush=True,
            )
        print(
            f"  momentum observer: {sizes(best_momentum(model, log, y, counts)[counts], log.wrench[counts])}",
            flush=True,
        )


def gyros() -> None:
    """Errors of the velocities with and without a gyro on the last link."""
    model = models.robots.load("panda")
    random = np.random.default_rng(5)
    log = moved(10.0, 1000, REST, 0 * FRICTION, pushed=False)
    counts = log.t > SETTLED
    y = log.q + 1e-4 * random.normal(size=log.q.shape)
    slow = y.copy()
    slow[np.arange(len(y)) % 10 > 0] = np.nan
    bias = np.array([0.02, -0.03, 0.01])
    read = log.spin + bias + 5e-3 * random.normal(size=log.spin.shape)
    gyro = observers.gyro(model.space, LINK, 5e-3, bias_std=0.1)
    joints = observers.external_force(std=np.array([1.0, 2.0, 1.0, 1.0, 0.3, 0.3, 0.1]), time=0.3)
    setups: dict[str, tuple[Any, np.ndarray]] = {
        "encoders at 100 Hz": ((), slow),
        "encoders at 1 kHz": ((), y),
        "encoders at 100 Hz and gyro at 1 kHz": (gyro, np.hstack([slow, read])),
    }
    for name, (sensors, measured) in setups.items():
        kalman = observers.IntrinsicKalman(model, 1e-4, 1e-8 * np.eye(7), 1.0, joints, substeps=1, sensors=sensors)
        (run,), used = engine.run_logs([kalman], Record(log.t, log.u, measured), ("slow", "velocity_std"), "jax")
        off = np.asarray(run.estimate)[counts, 7:] - log.v[counts]
        covered = np.mean(np.abs(off) < 1.96 * np.asarray(run.info.velocity_std)[counts])
        print(f"{name}: {1e3 * np.sqrt(np.mean(off**2)):.2f} mrad/s; in band {covered:.2f} ({used})", flush=True)
        if len(np.asarray(run.info.slow)[0]) > 7:
            print(f"  bias {np.asarray(run.info.slow)[-1, 7:]} of {bias} rad/s")


if __name__ == "__main__":
    forces()
    gyros()
