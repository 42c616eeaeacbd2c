"""A quadruped that trots over slippery patches, simulated by MuJoCo: `python gallery/demo_trot.py --out DIR`.

Written are `trot.xml`, the robot; `trot.csv`, its IMU and its encoders at 500 Hz; and `truth.csv`, the velocity of the
base in its axes and the load of each foot. A MEMS IMU is read, with biases and the mean of each interval, and encoders
of 2¹⁵ counts a turn. The joints have friction of .3 N m that no model knows, and one step in eight is on a patch with
a friction of .08 to .18 in place of .7.
"""

import argparse
from pathlib import Path

import mujoco
import numpy as np

RATE, PERIOD, STANDS = 500, 0.5, 1.0
"""Sampling rate [Hz], time of a step and its swing [s], and time [s] for which the robot stands at first."""
NAMES = ("FL", "FR", "RL", "RR")
FORE, SIDE = np.array([1, 1, -1, -1]), np.array([1, -1, 1, -1])
HIP, OUT, THIGH, CALF, RADIUS = np.array([0.1805, 0.047]), 0.0838, 0.2, 0.2, 0.02
"""Place of the hips, and lengths of the links of a leg and the radius of a foot [m]."""
HEIGHT = 0.29
"""Height of the hips above the centres of the feet [m]."""
GYRO, ACCELEROMETER, COUNTS = (0.01, 0.02), (0.15, 0.15), 2**15
"""Noise of a sample and standard deviation of the bias, and counts of an encoder in a turn."""
FLOOR = 'solref="0.004 1" solimp="0.95 0.995 0.001"'


def robot() -> str:
    """The robot in MJCF, without a floor."""
    legs = ""
    for name, fore, side in zip(NAMES, FORE, SIDE, strict=True):
        x, y = HIP * (fore, side)
        legs += f"""
    <body name="{name}_hip" pos="{x} {y} 0">
      <inertial pos="0 {0.02 * side} 0" mass="0.6" diaginertia="0.0005 0.0007 0.0005"/>
      <joint name="{name}_roll" axis="1 0 0" armature="0.005"/>
      <body name="{name}_thigh" pos="0 {OUT * side} 0">
        <inertial pos="0 {-0.02 * side} -0.03" mass="0.85" diaginertia="0.004 0.004 0.001"/>
        <joint name="{name}_pitch" axis="0 1 0" armature="0.005"/>
        <body name="{name}_calf" pos="0 0 {-THIGH}">
          <inertial pos="0 0 -0.1" mass="0.18" diaginertia="0.0009 0.0009 0.00003"/>
          <joint name="{name}_knee" axis="0 1 0" armature="0.005"/>
        </body>
      </body>
    </body>"""
    return f"""<mujoco model="trot">
  <compiler angle="radian"/>
  <worldbody><body name="base">
    <freejoint/>
    <inertial pos="0.01 0 0.005" mass="6" diaginertia="0.03 0.08 0.09"/>{legs}
  </body></worldbody>
</mujoco>
"""


def on_floor() -> mujoco.MjModel:
    """The robot on a floor, with feet, an IMU and friction in its joints."""
    spec = mujoco.MjSpec.from_string(robot())
    spec.option.timestep, spec.option.integrator = 5e-4, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10
    contact = {"solref": [0.004, 1], "solimp": [0.95, 0.995, 0.001, 0.5, 2]}
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[100, 100, 1], **contact)
    spec.body("base").add_site(name="imu")
    for name in NAMES:
        sphere = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [RADIUS, 0, 0], "pos": [0, 0, -CALF]}
        friction = {"friction": [0.7, 0.005, 0.0001], "priority": 1, "condim": 3}
        spec.body(f"{name}_calf").add_geom(name=name, **sphere, **friction, **contact)
    for kind in (mujoco.mjtSensor.mjSENS_GYRO, mujoco.mjtSensor.mjSENS_ACCELEROMETER):
        spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="imu")
    model = spec.compile()
    model.dof_frictionloss[6:], model.dof_damping[6:] = 0.3, 0.15
    return model


def joints_of(foot: np.ndarray, side: int) -> np.ndarray:
    """Joints that put a foot at a place as seen from its hip."""
    x, y, z = foot
    down = np.sqrt(max(y * y + z * z - OUT * OUT, 1e-6))
    roll = np.arctan2(z, y) + np.arctan2(down, side * OUT)
    knee = -np.arccos(np.clip((x * x + down * down - THIGH**2 - CALF**2) / (2 * THIGH * CALF), -1, 1))
    pitch = np.arctan2(-x, down) + np.arctan2(CALF * np.sin(-knee), THIGH + CALF * np.cos(knee))
    return np.array([(roll + np.pi) % (2 * np.pi) - np.pi, pitch, knee])


class Gait:
    """Where the feet should be, as seen from their hips: a trot that catches what the base is too fast."""

    def __init__(self):
        self.rest = np.stack([np.zeros(4), OUT * SIDE, np.full(4, -HEIGHT)], axis=1)
        self.start, self.target = self.rest.copy(), self.rest.copy()

    def joints(self, t: float, turned: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Joints (12,) to hold at a time, for an attitude (3, 3) and a velocity (3,) of the base in its axes."""
        wave = 2 * np.pi * t * np.array([0.07, 0.11, 0.09])
        forward, left, turning = (np.array([0.4, 0, 0]) + [0.3, 0.15, 0.4] * np.sin(wave)) * (t > STANDS)
        roll, pitch, feet = np.arctan2(turned[2, 1], turned[2, 2]), -np.arcsin(turned[2, 0]), []
        for i, (hip, side) in enumerate(zip(np.stack([FORE, SIDE], 1) * HIP, SIDE, strict=True)):
            phase = (t / PERIOD + (0 if i in (0, 3) else 0.5)) % 1
            wanted = np.array([forward - turning * (hip[1] + side * OUT), left + turning * hip[0], 0])
            swing = 2 * phase - 1
            if t < STANDS:
                foot = self.rest[i]
            elif swing < 0:
                foot = self.start[i] = self.target[i] - phase * PERIOD * wanted
            else:
                caught = 0.12 * (velocity - [forward, left, 0]) * [1, 1, 0]
                landing, way = self.rest[i] + wanted * PERIOD / 4 + caught, swing * swing * (3 - 2 * swing)
                foot = self.start[i] * (1 - way) + landing * way
                foot[2] = -HEIGHT + 0.06 * np.sin(np.pi * swing)
                self.target[i] = [*foot[:2], -HEIGHT]
            level = np.clip(0.8 * pitch * hip[0] - 0.8 * roll * (hip[1] + side * OUT), -0.04, 0.04) * (swing < 0)
            feet.append(joints_of(foot + level * np.eye(3)[2], side))
        return np.concatenate(feet)


def simulate(seconds: float = 14.0, slippery: float = 0.125, seed: int = 1) -> dict[str, np.ndarray]:
    """A trot, in rows of 2 ms: attitude R, velocity v in the axes of the base, joints q, torques u, what gyro and
    accelerometer are in the mean of the interval after the row, and the load of each foot in it [N].
    """
    model, random, gait = on_floor(), np.random.default_rng(seed), Gait()
    data, substeps = mujoco.MjData(model), round(1 / RATE / model.opt.timestep)
    feet = [model.geom(name).id for name in NAMES]
    data.qpos[2] = HEIGHT + RADIUS
    data.qpos[7:] = gait.joints(0.0, np.eye(3), np.zeros(3))
    until, force, rows = (
        np.zeros(4),
        np.zeros(6),
        {key: [] for key in ("R", "v", "q", "u", "gyro", "accelerometer", "load")},
    )
    for k in range(round(seconds * RATE)):
        t, turned = k / RATE, np.empty(9)
        mujoco.mju_quat2Mat(turned, data.qpos[3:7])
        turned = turned.reshape(3, 3)
        velocity = turned.T @ data.qvel[:3]
        held = 90 * (gait.joints(t, turned, velocity) - data.qpos[7:]) - 2 * data.qvel[6:]
        data.qfrc_applied[6:] = np.clip(held, -33, 33)
        for i in np.flatnonzero(t > until):
            model.geom_friction[feet[i], 0] = 0.08 + 0.1 * random.random() if random.random() < slippery else 0.7
            until[i] = t + 0.05 + 0.25 * random.random()
        row = {"R": turned, "v": velocity, "q": data.qpos[7:].copy(), "u": data.qfrc_applied[6:].copy()}
        read, load = np.zeros(6), np.zeros(4)
        for _ in range(substeps):
            mujoco.mj_step(model, data)
            read += data.sensordata / substeps
            for c, contact in enumerate(data.contact):
                mujoco.mj_contactForce(model, data, c, force)
                load[feet.index(max(contact.geom1, contact.geom2))] += force[0] / substeps
        for key, value in (row | {"gyro": read[:3], "accelerometer": read[3:], "load": load}).items():
            rows[key].append(value)
    return {key: np.array(values) for key, values in rows.items()}


def measured(log: dict[str, np.ndarray], seed: int = 5) -> dict[str, np.ndarray]:
    """What sensors read of it: gyro, accelerometer and joints."""
    random, tick = np.random.default_rng(seed), 2 * np.pi / COUNTS
    read = {"q": tick * np.round(log["q"] / tick)}
    for name, (noise, bias) in (("gyro", GYRO), ("accelerometer", ACCELEROMETER)):
        read[name] = log[name] + bias * random.normal(size=3) + noise * random.normal(size=log[name].shape)
    return read


def main() -> None:
    """Write the robot and its logs."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path(), help="folder to write into")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    log = simulate()
    read, t = measured(log), np.arange(len(log["q"]))[:, None] / RATE
    joints = [f"{name}_{joint}" for name in NAMES for joint in ("roll", "pitch", "knee")]
    torques, loads = [f"torque_{joint}" for joint in joints], [f"{name}_load" for name in NAMES]
    tables = {
        "trot": (["gx", "gy", "gz", "ax", "ay", "az", *joints], (read["gyro"], read["accelerometer"], read["q"])),
        "truth": (["velocity_x", "velocity_y", "velocity_z", *loads, *torques], (log["v"], log["load"], log["u"])),
    }
    for name, (columns, values) in tables.items():
        header = ",".join(["t", *columns])
        np.savetxt(out / f"{name}.csv", np.hstack([t, *values]), "%.9g", ",", header=header, comments="")
    (out / "trot.xml").write_text(robot(), encoding="utf-8")
    print(f"wrote trot.xml, trot.csv and truth.csv: {len(t)} rows")


if __name__ == "__main__":
    main()
