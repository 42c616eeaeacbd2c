"""Servos written for other programs: BAM, Isaac Lab and MuJoCo move them as the prediction of a fit does, open loop."""

import json

import mujoco
import numpy as np
import pytest

import covariant
from covariant import models
from covariant.calibration.identification import predict_servos
from covariant.signals import Record

STEP = 1e-3
DELAY = 0.02
MASS, LENGTH, OFFSET, START = 0.5, 0.1, 0.1, 0.05
PENDULUM = f"""<robot name="pendulum">
  <link name="stand"/><link name="weight"><inertial><origin xyz="0 0 -{LENGTH}"/><mass value="{MASS}"/>
    <inertia ixx="1e-9" ixy="0" ixz="0" iyy="1e-9" iyz="0" izz="1e-9"/></inertial></link>
  <joint name="horn" type="revolute"><parent link="stand"/><child link="weight"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="2" velocity="9"/></joint>
</robot>"""
CLOSE = 1e-3
"""Largest RMS difference of two simulations [rad]; a tick of a servo's encoder is 1.5e-3."""
SERVO = {"stiffness": 6.0, "gain": 1.5, "back_emf": 0.03, "limit": 1.1, "delay": DELAY}
GEAR = {"coulomb": 0.03, "viscous": 0.01, "armature": 0.002}
STRIBECK = {"stribeck": 0.05, "stribeck_velocity": 0.3}
LOAD = {"load": 0.3, "load_external": 0.2}
T = STEP * np.arange(2500)
HELD = np.floor(T / 0.02 + 1e-9) * 0.02
COMMAND = 0.8 * np.sin(2.5 * HELD) + 0.5 * (HELD > 1.2)


def pendulum(folder, **servo):
    (folder / "pendulum.urdf").write_text(PENDULUM)
    return arm(folder, "pendulum.urdf", {"horn": OFFSET}, {"horn": servo})


def arm(folder, path, offsets, servos):
    lines = ['system = "robot"', "[parameters]", f'path = "{path}"', "[parameters.offsets]"]
    lines += [f"{name} = {value}" for name, value in offsets.items()]
    for name, servo in servos.items():
        lines += [f"[servo.{name}]", *(f"{key} = {value}" for key, value in servo.items())]
    (folder / "arm.toml").write_text("\n".join(lines) + "\n")
    return folder / "arm.toml"


def predicted(model, joint, start, commands):
    """Positions (T, n) from the first ones and the commands; the weight is that along the prediction itself."""
    family = models.robot_family(str(model), [f"servo.{joint}.stiffness"])
    path = np.tile(start, (len(T), 1))
    for _ in range(3):
        path = np.concatenate([np.tile(start, (8, 1)), path[8:]])  # at rest, by the smoothed path, at first
        path = predict_servos(family, np.zeros(1), Record(t=T, y=path, u=commands.reshape(len(T), -1)))
    return path


def simulated(torque, friction, armature, delay, step):
    """Positions (T,) of the pendulum; friction stops it within a step, up to its size, as in BAM's simulation."""
    every, inertia = round(STEP / step), MASS * LENGTH**2 + armature
    commands = np.repeat(COMMAND, every)
    late = np.concatenate([np.full(round(delay / step), commands[0]), commands])
    q, v, path = START, 0.0, []
    for command in late[: len(commands)]:
        path.append(q)
        motor, weight = torque(command - q, v), -MASS * 9.80665 * LENGTH * np.sin(q + OFFSET)
        most, net = friction(v, motor, weight), motor + weight
        acceleration = (net - np.clip(inertia / step * v + net, -most, most)) / inertia
        v += step * acceleration
        q += step * v + step**2 / 2 * acceleration
    return np.array(path)[::every]


def at_short_steps(simulate):
    """What a simulation of first order tends to at shorter steps, by Richardson's extrapolation."""
    coarse, fine = simulate(STEP / 2), simulate(STEP / 4)
    return 2 * fine - coarse


def rms(error):
    return np.sqrt(np.mean(np.square(error)))


def in_bam(p, step):
    def torque(error, v):
        duty = np.clip(p["kp"] * p["error_gain"] * error, -p["max_pwm"], p["max_pwm"])
        return p["kt"] * p["vin"] * duty / p["R"] - p["kt"] ** 2 * v / p["R"]

    def friction(v, motor, weight):
        most = p["friction_base"] + p["friction_viscous"] * abs(v)
        if p["model"] in ("m2", "m5"):
            most += p["friction_stribeck"] * np.exp(-(abs(v / p["dtheta_stribeck"]) ** p["alpha"]))
        if p["model"] == "m5":
            most += abs(p["load_friction_external"] * weight - p["load_friction_motor"] * motor)
        return most

    assert p["q_offset"] == OFFSET
    return simulated(torque, friction, p["armature"], p["command_delay"], step)


def bam_file(folder, **servo):
    result = covariant.export(pendulum(folder, **servo), folder / "horn.bam.json", rate=1 / STEP)
    return json.loads(result.out.read_text()), result


@pytest.mark.parametrize(
    "more",
    [
        STRIBECK | LOAD,
        pytest.param({}, marks=pytest.mark.exhaustive),
        pytest.param(STRIBECK, marks=pytest.mark.exhaustive),
        pytest.param(LOAD | {"damping": 0.1, "limit": 9.0}, marks=pytest.mark.exhaustive),
    ],
)
def test_bam_moves_a_servo_as_the_fit_does(more, tmp_path):
    parameters, _ = bam_file(tmp_path, **SERVO | GEAR | more)
    ours = predicted(tmp_path / "arm.toml", "horn", [START], COMMAND)[:, 0]
    assert np.ptp(ours) > 1.0
    assert rms(at_short_steps(lambda step: in_bam(parameters, step)) - ours) < CLOSE


def test_a_file_for_bam_has_the_smallest_model_that_holds_the_friction(tmp_path):
    for i, (more, model) in enumerate(
        [({}, "m1"), (STRIBECK, "m2"), (STRIBECK | LOAD, "m5"), ({"load": 0.3}, "m5"), ({"load_external": 0.2}, "m5")]
    ):
        (tmp_path / str(i)).mkdir()
        parameters, result = bam_file(tmp_path / str(i), **SERVO | GEAR | more)
        assert parameters["model"] == model
        assert (parameters["dtheta_stribeck"], parameters["alpha"]) == (0.3 if "stribeck" in more else 0.1, 2.0)
        # Its first version knows no delay of commands.
        assert result.warnings == (f"BAM 1.0 has no entry for horn: delay = {DELAY}",)


def test_a_drive_is_that_of_the_model_file(tmp_path):
    drive = {"supply": 7.4, "resistance": 2.0, "torque_constant": 1.1, "pwm_limit": 0.97}
    parameters, result = bam_file(tmp_path, stiffness=0.5, gain=32, **drive)
    assert parameters["kt"] == pytest.approx(1.1)
    assert parameters["R"] == pytest.approx(2.0)
    assert (parameters["vin"], parameters["max_pwm"], parameters["kp"]) == (7.4, 0.97, 32.0)
    assert parameters["error_gain"] == pytest.approx(0.5 * 2.0 / (1.1 * 7.4))
    assert result.warnings == ()


def test_what_bam_cannot_represent_is_printed_and_in_the_file(tmp_path):
    others = {"offset": 0.02, "damping": 0.1, "dead_band": 0.01, "asymmetry": -0.01}
    parameters, result = bam_file(tmp_path, **SERVO | others)
    line = "horn: damping = 0.1, offset = 0.02, delay = 0.02, dead_band = 0.01, asymmetry = -0.01"
    assert parameters["left_out"] == [line]
    assert result.warnings == (f"BAM 1.0 has no entry for {line}",)


def test_a_servo_that_bam_cannot_represent_is_refused_with_what_is_missing(tmp_path):
    model = pendulum(tmp_path, stiffness=6.0, limit=1.0)
    with pytest.raises(ValueError, match=r"state limit, and damping or back_emf, of \[servo.horn\]"):
        covariant.export(model, tmp_path / "horn.bam.json", rate=500.0)
    with pytest.raises(ValueError, match=r"the name of a joint with a servo \(horn\); got 'arm'"):
        covariant.export(model, tmp_path / "arm.bam.json", rate=500.0)
    with pytest.raises(ValueError, match=r"only a robot is written as BAM 1.0 \(.bam.json\)"):
        covariant.export("oscillator", tmp_path / "horn.bam.json", rate=500.0)


def in_isaac_lab(p, offset, step):
    """Motion by a `DelayedPDActuator` with a delay of whole steps, and by static, dynamic and viscous friction."""

    def torque(error, v):
        return np.clip(p["stiffness"] * (error + offset) - p["damping"] * v, -p["effort_limit"], p["effort_limit"])

    def friction(v, motor, weight):
        return (p["dynamic_friction"] if v else p["friction"]) + p["viscous_friction"] * abs(v)

    assert p["min_delay"] == p["max_delay"]
    return simulated(torque, friction, p["armature"], p["max_delay"] * step, step)


def test_isaac_lab_moves_a_servo_as_the_fit_does(tmp_path):
    model = pendulum(tmp_path, **SERVO | GEAR | {"damping": 0.05, "offset": 0.02})

    def simulate(step):
        out = covariant.export(model, tmp_path / "arm.json", rate=1 / step, overwrite=True).out
        table = json.loads(out.read_text())
        return in_isaac_lab(table["actuators"]["horn"], table["command_offsets"]["horn"], step)

    ours = predicted(model, "horn", [START], COMMAND)[:, 0]
    assert np.ptp(ours) > 1.0
    assert rms(at_short_steps(simulate) - ours) < CLOSE


def test_mujoco_moves_an_arm_as_the_fit_does(tmp_path):
    gear = {"coulomb": 0.4, "viscous": 0.1, "armature": 0.03}
    servo = gear | {"stiffness": 18.0, "damping": 0.4, "back_emf": 0.1, "limit": 7.0, "delay": 0.03}
    servos = {"shoulder": servo | {"offset": 0.1}, "elbow": servo | {"stiffness": 9.0, "limit": 3.0}}
    model = arm(tmp_path, "double_pendulum", {"shoulder": 0.2}, servos)
    commands = np.stack([0.8 * np.sin(2 * HELD) + 0.6 * (HELD > 1.0), 0.6 * np.sin(3 * HELD)], axis=1)
    start, every = [0.0, 0.1], 4
    result = covariant.export(model, tmp_path / "arm.xml", rate=every / STEP)
    assert result.warnings == ()
    engine = mujoco.MjModel.from_xml_path(str(result.out))
    data, theirs = mujoco.MjData(engine), np.zeros((len(T), 2))
    data.qpos[:] = start
    for i in range(2):
        mujoco.mj_initCtrlHistory(engine, data, i, None, np.full(engine.actuator_history[i, 0], commands[0, i]))
    for k, command in enumerate(commands):
        theirs[k], data.ctrl[:] = data.qpos, command
        for _ in range(every):
            mujoco.mj_step(engine, data)
    assert np.ptp(theirs, axis=0).min() > 1.0
    assert rms(theirs - predicted(model, "elbow", start, commands)) < CLOSE


def test_friction_that_mujoco_cannot_represent_is_printed(tmp_path):
    result = covariant.export(pendulum(tmp_path, **SERVO | GEAR | STRIBECK | LOAD), tmp_path / "arm.xml", rate=500.0)
    line = "horn: stribeck = 0.05, stribeck_velocity = 0.3, load = 0.3, load_external = 0.2"
    assert result.warnings == (f"MJCF has no entry for {line}",)
