"""A servo of one joint: what a fit is worth where friction sticks, and beside MuJoCo's system identification.

The first table is of a servo with friction that depends on the direction and falls with the speed, simulated here in
NumPy by small steps: errors of predictions of rows that the fit has not seen, by the fitted numbers and by the true
ones. The second one is of a servo simulated by MuJoCo, with what its joints have: a rotor, damping and dry friction,
from the same log by `fit` and by `mujoco.sysid`, with the processor time of each.

Run `python benchmarks/servo.py` from the repository's root; for the second table `pip install "mujoco[sysid]"` first.
"""

import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

import covariant
from covariant.signals import Record

RATE, STEPS, INERTIA, NOISE = 1000, 10, 0.002, 1e-4
URDF = """<robot name="servo">
<link name="base"/>
<link name="disc"><inertial><mass value="0.5"/>
<inertia ixx="0.001" iyy="0.001" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge" type="continuous"><parent link="base"/><child link="disc"/><axis xyz="0 0 1"/></joint>
</robot>"""
MJCF = """<mujoco><option timestep="{step}" integrator="implicitfast"/><worldbody><body name="disc">
<inertial pos="0 0 0" mass="0.5" diaginertia="0.001 0.001 0.002"/>
<joint name="hinge" axis="0 0 1" armature="{armature}" damping="{damping}" frictionloss="{frictionloss}"/>
</body></worldbody><actuator><motor joint="hinge"/></actuator></mujoco>"""


class Servo(NamedTuple):
    """Rotor and friction of a servo, as on the page on identification."""

    armature: float = 0.003
    viscous: float = 0.02
    coulomb: float = 0.08
    asymmetry: float = 0.015
    stribeck: float = 0.04

    def acceleration(self, v, torque):
        """Acceleration at a velocity v under a torque."""
        s = np.tanh(v / 0.02)
        dry = (self.coulomb + self.stribeck * np.exp(-((v / 0.1) ** 2))) * s
        return (torque - self.viscous * v - dry - self.asymmetry * s**2) / (INERTIA + self.armature)

    def rollout(self, q, v, torques, substeps=8):
        """Positions and velocities (T + 1, …) from those at the start, under torques (T, …) held for a sample each."""
        h, path = 1 / RATE / substeps, [(q, v)]
        for torque in torques:
            for _ in range(substeps):
                # The midpoint rule: dry friction, the fastest part, takes seven steps to settle.
                middle = v + h / 2 * self.acceleration(v, torque)
                q, v = q + h * middle, v + h * self.acceleration(middle, torque)
            path.append((q, v))
        return np.array([place for place, _ in path]), np.array([speed for _, speed in path])


def torques(seconds: float) -> np.ndarray:
    """Torques (T,): slow and fast sines, so that the servo sticks at times and reverses in between."""
    t = np.arange(int(seconds * RATE)) / RATE
    parts = ((0.16, 0.31, 0.0), (0.09, 0.83, 1.0), (0.05, 2.3, 2.0), (0.03, 5.1, 0.5))
    return sum(size * np.sin(2 * np.pi * f * t + phase) for size, f, phase in parts)


def logged(servo: Servo, seconds: float, disturbance: float = 0.004, seed: int = 0):
    """A log of a servo with an unknown torque of this size [N m], and its true velocities (T,)."""
    rng, u = np.random.default_rng(seed), torques(seconds)
    unknown = np.zeros(len(u))
    for k in range(1, len(u)):
        unknown[k] = 0.98 * unknown[k - 1] + np.sqrt(1 - 0.98**2) * disturbance * rng.normal()
    q, v = servo.rollout(0.0, 0.0, (u + unknown)[:-1])
    y = q + NOISE * rng.normal(size=len(q))
    return Record(np.arange(len(u)) / RATE, u[:, None], y[:, None]), v


def fitted(record: Record, names: str):
    """The fit of the servo's URDF file, which has neither rotor nor friction, and its processor time [s]."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "servo.urdf"
        path.write_text(URDF)
        start = time.process_time()
        result = covariant.fit(str(path), record, names, overrides={"inputs.between": "held"})
        return result, time.process_time() - start


def servo_of(result) -> Servo:
    """The numbers of a fit."""
    rows = {row["name"].split(".")[-1]: row["after"] for row in result.summary["parameters"]}
    return Servo(rows["hinge"], *(rows[name] for name in Servo._fields[1:]))


def prediction_error(servo: Servo, record: Record, v: np.ndarray, seconds: float = 0.5) -> float:
    """Root mean square error [rad] of open-loop predictions over windows of the last third of a log.

    Each begins with the true velocity and the measured position, which no number of the servo has a part in.
    """
    count, y = int(seconds * RATE), np.asarray(record.y)[:, 0]
    starts = np.arange(int(len(y) * 2 / 3), len(y) - count, count // 2)
    columns = starts + np.arange(count)[:, None]
    q, _ = servo.rollout(y[starts], v[starts], np.asarray(record.u)[columns, 0])
    return float(np.sqrt(np.mean((q[1:] - y[columns + 1]) ** 2)))


def in_mujoco(armature: float, damping: float, frictionloss: float, seconds: float, seed: int = 0) -> Record:
    """A log of the servo as MuJoCo simulates it, in steps of a tenth of a sample."""
    import mujoco

    numbers = {"armature": armature, "damping": damping, "frictionloss": frictionloss}
    model = mujoco.MjModel.from_xml_string(MJCF.format(step=1 / RATE / STEPS, **numbers))
    data, u = mujoco.MjData(model), torques(seconds)
    q = np.empty(len(u))
    for k, torque in enumerate(u):
        q[k], data.ctrl[0] = data.qpos[0], torque
        mujoco.mj_step(model, data, STEPS)
    y = q + NOISE * np.random.default_rng(seed).normal(size=len(u))
    return Record(np.arange(len(u)) / RATE, u[:, None], y[:, None])


def by_sysid(record: Record):
    """Armature, damping and dry friction by `mujoco.sysid`, and its processor time [s]."""
    import mujoco
    from mujoco import sysid

    start = time.process_time()
    spec = mujoco.MjSpec.from_string(MJCF.format(step=1 / RATE, armature=0, damping=0, frictionloss=0))
    model = spec.compile()
    t, u, y = (np.asarray(column) for column in (record.t, record.u, record.y))
    numbers = sysid.ParameterDict()
    for name, most in (("armature", 0.05), ("damping", 0.5), ("frictionloss", 0.5)):

        def change(spec, number, name=name):
            value = float(number.value[0])
            setattr(spec.joint("hinge"), name, [value, 0.0, 0.0] if name == "damping" else value)

        numbers.add(sysid.Parameter(name, nominal=0.1 * most, min_value=0.0, max_value=most, modifier=change))
    log = sysid.ModelSequences(
        "servo",
        spec,
        "log",
        sysid.create_initial_state(model, y[0], np.zeros(1), np.zeros(0)),
        sysid.TimeSeries(t, u),
        # Positions of the state: those of a sensor are one step late in a rollout.
        sysid.TimeSeries.from_names(t, y, model, ["hinge_qpos"]),
        allow_missing_sensors=True,
    )
    found, _ = sysid.optimize(
        numbers, sysid.build_residual_fn(models_sequences=[log], n_threads=1), optimizer="mujoco", verbose=False
    )
    return found.as_vector(), time.process_time() - start


def first_table() -> None:
    """Print the errors of predictions by the fitted numbers and by the true ones."""
    print("| | rotor | viscous | Coulomb | asymmetry | Stribeck | error of position [mrad] |")
    print("|---|--:|--:|--:|--:|--:|--:|")
    record, v = logged(Servo(), 60.0)
    result, _ = fitted(record, "friction,friction.stribeck,armature")
    for what, servo in (("true", Servo()), ("fitted", servo_of(result))):
        error = 1e3 * prediction_error(servo, record, v)
        print(f"| {what} | {' | '.join(f'{number:.4g}' for number in servo)} | {error:.3f} |", flush=True)


def second_table() -> None:
    """Print numbers and processor time of `fit` and of `mujoco.sysid`, on the same log."""
    print("| | rotor | damping | dry friction | processor time [s] |")
    print("|---|--:|--:|--:|--:|")
    truth = (0.003, 0.02, 0.08)
    print(f"| true | {' | '.join(f'{number:.5g}' for number in truth)} | |")
    record = in_mujoco(*truth, 60.0)
    result, spent = fitted(record, "armature,friction.viscous,friction.coulomb")
    print(f"| `fit` | {' | '.join(f'{value:.5g}' for value in result.values)} | {spent:.3g} |", flush=True)
    numbers, spent = by_sysid(record)
    print(f"| `mujoco.sysid` | {' | '.join(f'{value:.5g}' for value in numbers)} | {spent:.3g} |", flush=True)


if __name__ == "__main__":
    first_table()
    second_table()
