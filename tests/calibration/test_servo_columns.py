"""What the columns of logs of servos are taken for: commands, units, registers; and what is refused."""

import numpy as np
import pytest

from covariant.calibration import draft

TURN = 2 * np.pi


def servo(n=2, rate=100.0, seconds=8.0, lag=0.06, held=1, sag=0.0, steps=False):
    """Stamps, positions and commands of servos of second order that act late, simulated every 2 ms."""
    t, fine = np.arange(int(seconds * rate)) / rate, np.arange(-0.5, seconds, 0.002)
    phases = [(0.35 + 0.17 * j, 1.1 + 0.2 * j, j) for j in range(n)]
    waves = [0.6 * np.sin(TURN * a * fine + j) + 0.2 * np.sin(TURN * b * fine) for a, b, j in phases]
    if steps:
        waves = [0.5 * np.sign(np.sin(TURN * (0.4 + 0.13 * j) * fine + j)) for j in range(n)]
    command = np.stack(waves, 1)
    if held > 1:
        rows = int(held / rate / 0.002)
        command = command[np.arange(len(fine)) // rows * rows]
    position, q, v, late = np.zeros_like(command), command[0].copy(), np.zeros(n), int(lag / 2 / 0.002)
    for i in range(len(fine)):
        v = v + 0.002 * (1600 * (command[max(i - late, 0)] - q - sag) - 50 * v)
        q = q + 0.002 * v
        position[i] = q
    sampled = np.stack([np.interp(t, fine, column) for column in position.T], 1)
    return t, sampled, command[np.searchsorted(fine, t + 1e-9) - 1]


def first_servo(found):
    """What a draft says of the servo of its first position."""
    (first, *_) = found.servos
    assert first is not None
    return first


def in_ticks(angle):
    return np.round(angle / TURN * 4096)


def word(numbers):
    """A 16-bit word of a magnitude and a sign."""
    return np.where(np.round(numbers) < 0, 32768 - np.round(numbers), np.round(numbers))


T, _swing, _sent = servo()
Q1, Q2 = in_ticks(_swing).T / 4096 * TURN
C1, C2 = _sent.T
V1, V2 = np.gradient(_swing, T, axis=0).T
TICKS, SENT = in_ticks(Q1) + 2048, in_ticks(C1) + 2048
ON, REST = np.where((T > 3) & (T < 4), 0.0, 1.0), np.zeros(T.size)
HELD_T, HELD, HELD_SENT = servo(held=10)
SLOW_T, SLOW, SLOW_SENT = servo(rate=30.0, seconds=10.0)
STEP_T, STEP, STEP_SENT = servo(steps=True)
_, SAG, SAG_SENT = servo(sag=0.2)
RANDOM = np.random.default_rng(0).normal(size=(2, T.size))
STATES, ACTIONS = ({"t": T, "observation.state[0]": Q1, "observation.state[1]": Q2}, {"action[0]": C1, "action[1]": C2})

COMMANDS = {
    "cmd": ({"t": T, "q_a": Q1, "q_b": Q2, "cmd_a": C1, "cmd_b": C2}, ("cmd_a", "cmd_b")),
    "commands come first": ({"goal_position_1": C1, "t": T, "present_position_1": Q1}, ("goal_position_1",)),
    "actions": (ACTIONS | STATES | {"index": np.arange(800.0), "frame_index": np.arange(800.0)}, tuple(ACTIONS)),
    "des": ({"t": T, "q1": Q1, "q2": Q2, "q1_des": C1, "q2_des": C2}, ("q1_des", "q2_des")),
    "measured and des": ({"t": T, "q1_des": C1, "q1_meas": Q1, "q2_des": C2, "q2_meas": Q2}, ("q1_des", "q2_des")),
    "ref": ({"t": T, "q1": Q1, "q1_ref": C1}, ("q1_ref",)),
    "target before": ({"t": T, "q": Q1, "target_q": C1}, ("target_q",)),
    "set point": ({"t": T, "pos_x1": Q1, "sp_x1": C1}, ("sp_x1",)),
    "glued": ({"t": T, "q1": Q1, "qdes1": C1}, ("qdes1",)),
    "d for desired": (
        {"t": T, "q_0": Q1, "q_1": Q2, "q_d_0": C1, "q_d_1": C2, "dq_0": V1, "dq_1": V2},
        ("q_d_0", "q_d_1"),
    ),
    "joint_pos_target": ({"t": T, "joint_pos_0": Q1, "joint_pos_target_0": C1}, ("joint_pos_target_0",)),
    "position_command": ({"t": T, "position": Q1, "position_command": C1}, ("position_command",)),
    "messages": ({"t": T, "hip/position": Q1, "hip/command": C1, "hip/velocity": V1}, ("hip/command",)),
    "names say nothing": ({"t": T, "angle1": Q1, "angle2": Q2, "ch3": C1, "ch4": C2}, ("ch3", "ch4")),
    "nor does their order": ({"t": T, "angle1": Q1, "angle2": Q2, "ch3": C2, "ch4": C1}, ("ch4", "ch3")),
    "actions in another order": (
        {"t": T, "angle_l": Q1, "angle_r": Q2, "action_x": C2, "action_y": C1},
        ("action_y", "action_x"),
    ),
    "leader and follower": ({"t": T, "follower_joint_1": Q1, "leader_joint_1": C1}, ("leader_joint_1",)),
    "current position": ({"t": T, "current_position": Q1, "target_position": C1}, ("target_position",)),
    "angle of a motor": ({"t": T, "motor_angle": Q1, "motor_current": V1, "target_angle": C1}, ("target_angle",)),
    "encoder of a load": ({"t": T, "theta_load": Q1, "theta_ref": C1}, ("theta_ref",)),
    "an error beside": (
        {"t": T, "position": Q1, "position_error": C1 - Q1, "position_command": C1},
        ("position_command",),
    ),
    "commanded velocities beside": ({"t": T, "q1": Q1, "dq1": V1, "q1_des": C1, "dq1_des": V1}, ("q1_des",)),
    "commanded moments beside": (
        {"timestamp": T, "actual_q_0": Q1, "target_q_0": C1, "target_moment_0": V1, "target_current_0": V1},
        ("target_q_0",),
    ),
    "registers beside": (
        {"t": T, "q1": Q1, "cmd1": C1, "current1": V1, "load1": V1, "volts": REST + 7, "torque_enabled": REST + 1},
        ("cmd1",),
    ),
    "a limit of torques beside": (
        {"t": T, "present_position": Q1, "goal_position": C1, "torque_limit": REST + 1000},
        ("goal_position",),
    ),
    "a switch": ({"t": T, "q1": Q1, "cmd1": C1, "torque_enabled": ON}, ("cmd1", "torque_enabled")),
    "a switch of all": (
        {"t": T, "q1": Q1, "q2": Q2, "cmd1": C1, "cmd2": C2, "enabled": ON},
        ("cmd1", "cmd2", "enabled", "enabled"),
    ),
    "a switch of each": (
        {"t": T, "q1": Q1, "q2": Q2, "cmd1": C1, "cmd2": C2, "torque_enable1": ON, "torque_enable2": 1 - ON},
        ("cmd1", "cmd2", "torque_enable1", "torque_enable2"),
    ),
    "held": ({"t": HELD_T, "q1": HELD[:, 0], "cmd1": HELD_SENT[:, 0]}, ("cmd1",)),
    "30 rows a second": ({"t": SLOW_T, "q1": SLOW[:, 0], "cmd1": SLOW_SENT[:, 0]}, ("cmd1",)),
    "steps": ({"t": STEP_T, "q1": STEP[:, 0], "cmd1": STEP_SENT[:, 0]}, ("cmd1",)),
    "one step": (
        {"t": T, "q1": np.where(T < 3.05, -1.0, -np.exp(-10 * (T - 3.05))), "cmd1": 1.0 * (T >= 3) - 1},
        ("cmd1",),
    ),
    "a joint stands still": ({"t": T, "q1": Q1, "q2": REST + 0.2, "cmd1": C1, "cmd2": REST + 0.21}, ("cmd1", "cmd2")),
    "a servo sags": ({"t": T, "q1": SAG[:, 0], "cmd1": SAG_SENT[:, 0]}, ("cmd1",)),
    "noise": ({"t": T, "q1": Q1 + 0.03 * RANDOM[0], "cmd1": C1}, ("cmd1",)),
    "one of two": ({"t": T, "q_a": Q1, "q_b": Q2, "cmd_a": C1}, ("cmd_a",)),
    "velocities among the states": (
        ACTIONS | STATES | {"observation.state[2]": V1, "observation.state[3]": V2},
        tuple(ACTIONS),
    ),
    "milliseconds": ({"t_ms": 1e3 * T, "q1": Q1, "cmd1": C1}, ("cmd1",)),
}


@pytest.mark.core(16)
@pytest.mark.parametrize(("log", "commands"), COMMANDS.values(), ids=COMMANDS)
def test_commands_are_known_by_name_and_by_content(log, commands):
    found = draft(log)
    assert found.u == commands
    assert len(found.q) == len(found.servos)
    assert not set(found.q) & set(found.u)
    for servo_found in found.servos:
        assert servo_found is None or servo_found.unit == 1.0


NO_COMMANDS = {
    "currents alone": ({"t": T, "q1": Q1, "current1": np.abs(V1)}, (), ""),
    "per cent of the voltage": ({"t": T, "q1": Q1, "pwm1": V1}, (), ""),
    "voltage": ({"t": T, "q1": Q1, "motor_voltage": V1}, (), ""),
    "torques": ({"t": T, "q1": Q1, "tau1": 100 * (C1 - Q1)}, ("tau1",), ""),
    "torques beside commands": ({"t": T, "q1": Q1, "ref1": C1, "tau1": C1 - Q1}, ("tau1",), "name the commands by"),
    "estimated torques beside": ({"t": T, "q1": Q1, "q1_des": C1, "tau_est1": V1}, ("tau_est1",), "follow q1_des"),
    "a torque that is called a command": ({"t": T, "q1": Q1, "cmd1": 9 * (C1 - Q1)}, ("cmd1",), "taken for torques"),
    "an unrelated target": ({"t": T, "q1": Q1, "target": RANDOM[0]}, (), ""),
    "unrelated actions": (STATES | dict(zip(ACTIONS, RANDOM, strict=True)), (), ""),
    "two encoders of a joint": ({"t": T, "q_motor": Q1, "q_link": Q1 + 1e-3 * np.sin(40 * T)}, (), ""),
    "legs in a gait": ({"t": T, "q_left": np.sin(9.4 * T), "q_right": np.sin(9.4 * T - 2.1)}, (), ""),
    "joints a to d": ({"t": T, "q_a": Q1, "q_b": Q2, "q_c": Q1 + Q2, "q_d": Q1 - Q2}, (), ""),
}


@pytest.mark.parametrize(("log", "inputs", "remark"), NO_COMMANDS.values(), ids=NO_COMMANDS)
def test_what_is_no_command_is_not_taken_for_one(log, inputs, remark):
    found = draft(log)
    assert (found.u, found.servos) == (inputs, ())
    assert any(remark in each for each in found.remarks) == bool(remark)


def test_registers_are_named_by_what_they_hold():
    log = {
        "time": T,
        "Present_Position_1": TICKS,
        "Goal_Position_1": SENT,
        "Present_Current_1": V1,
        "Present_Load_1": V1,
    }
    log |= {"Present_Voltage_1": REST + 74, "Present_Temperature_1": REST + 30}
    found = draft(log)
    assert dict(found.registers) == {
        "current": ("Present_Current_1",),
        "load": ("Present_Load_1",),
        "voltage": ("Present_Voltage_1",),
        "temperature": ("Present_Temperature_1",),
    }
    assert set(found.left_out) == {name for names in found.registers.values() for name in names}


UNITS = {
    "ticks": ({"present_position": TICKS, "goal_position": SENT}, "turn/4096", "turn/4096", ("q",)),
    "ticks that are called so": ({"position_ticks": TICKS, "goal_ticks": SENT}, "turn/4096", "turn/4096", ("q",)),
    "ticks, commanded in radians": ({"present_position": TICKS, "goal_position": C1}, "turn/4096", None, ("q",)),
    "ticks, commanded in degrees": ({"pos": TICKS, "target_deg": np.degrees(C1)}, "turn/4096", "deg", ("q",)),
    "degrees": ({"q1": 3 * np.degrees(Q1), "cmd1": 3 * np.degrees(C1)}, "deg", "deg", ("q",)),
    "degrees by name": ({"q1_deg": np.degrees(Q1), "cmd1_deg": np.degrees(C1)}, "deg", "deg", ()),
    "degrees, commanded in radians": ({"q1_deg": np.degrees(Q1), "cmd1": C1}, "deg", None, ()),
    "radians, commanded in degrees": ({"q1": Q1, "cmd1": np.degrees(C1)}, None, "deg", ()),
    "radians by name": ({"q1_rad": Q1, "cmd1_rad": C1}, None, "rad", ()),
    "the other sign": ({"q1": Q1, "cmd1": -C1}, None, "-1 rad", ()),
}


@pytest.mark.parametrize(("log", "q", "u", "guessed"), UNITS.values(), ids=UNITS)
def test_units_of_servos_are_known_by_name_or_numbers(log, q, u, guessed):
    found = draft({"t": T} | log)
    assert (found.units.get("q"), found.units.get("u")) == tuple((each,) if each else None for each in (q, u))
    assert found.guessed == guessed
    assert first_servo(found).lag == pytest.approx(0.06, abs=0.015)


REFUSED = {
    "ticks about zero": ({"present_position": TICKS - 2048, "goal_position": SENT - 2048}, "whole numbers from"),
    "ticks of 10 bits": ({"present_position": TICKS // 4, "goal_position": SENT // 4}, "whole numbers from"),
    "ticks of several turns": ({"present_position": TICKS + 4096, "goal_position": SENT + 4096}, "whole numbers from"),
    "means of ticks": ({"present_position": TICKS + 0.25, "goal_position": SENT}, "more than a servo turns"),
    "two's complement": ({"position": (TICKS - 2048) % 65536, "goal_position": SENT}, "whole numbers from"),
    "whole degrees": ({"q1": np.round(np.degrees(Q1)), "cmd1": np.round(np.degrees(C1))}, "ticks or degrees"),
    "per cent of the range": ({"q1": 60 * Q1, "cmd1": 60 * C1}, "degrees, or per cent of the range"),
    "commands in per cent": ({"q1": Q1, "cmd1": C1 / np.radians(150) * 100}, "no unit of a command"),
    "commands from -1 to 1": ({"q1": Q1, "cmd1": C1 / (np.pi / 2)}, "no unit of a command"),
    "commands in microseconds": (
        {"angle_deg": np.degrees(Q1), "cmd_us": 1500 + np.degrees(C1) / 0.09},
        "has 'us' in its name",
    ),
    "changes as actions": ({"state[0]": Q1, "action[0]": np.gradient(C1)}, "no unit of a command"),
    "a copy": ({"q1": Q1, "cmd1": Q1}, "is a copy of 'q1' of the same row"),
    "the next state as action": ({"state[0]": Q1, "action[0]": np.append(Q1[1:], 0)}, "'state\\[0\\]' of the next row"),
    "words": ({"position": word(TICKS - 2048), "goal_position": word(SENT - 2048)}, "highest bit is a sign"),
    "words of commands": ({"q": Q1, "goal_position": word(SENT - 2048)}, "highest bit is a sign"),
    "a row for each motor": (
        {
            "t": 0.005 * np.arange(2 * T.size),
            "id": np.arange(2 * T.size) % 2,
            "position": np.stack([Q1, Q2], 1).ravel(),
        },
        "each row is of another motor",
    ),
    "commands that are called positions": ({"q": Q1, "q_c": C1}, "q follows q_c, late, as a servo its command"),
    "rows as a clock": (
        {"t": None, "index": np.arange(800.0), "state[0]": Q1, "action[0]": C1},
        "'index' counts rows from 0, and is no clock",
    ),
    "a pose": ({f"state[{k}]": Q1 for k in range(3)} | {"action[0]": C1}, "is a pose, and no joints"),
}


@pytest.mark.parametrize(("log", "message"), REFUSED.values(), ids=REFUSED)
def test_servos_whose_numbers_are_not_clear_are_refused(log, message):
    log = {name: column for name, column in ({"t": T} | log).items() if column is not None}
    entries = {f"state[{k}]": letter for k, letter in enumerate("xyz")} if "state[2]" in log else None
    with pytest.raises(ValueError, match=message):
        draft(log, entries=entries)


def test_units_that_are_given_are_not_guessed():
    log = {"t": T, "q1": 60 * Q1, "q2": 60 * Q2, "cmd1": 60 * C1, "cmd2": 60 * C2}
    found = draft(log, units={"q": ["0.9 deg", "1.1 deg"]})
    assert (found.units["q"], found.units["u"]) == (("0.9 deg", "1.1 deg"),) * 2
    assert found.guessed == ()
    with pytest.raises(ValueError, match="3 units are given for q, which has 2 columns"):
        draft(log, units={"q": ["deg"] * 3})
    with pytest.raises(ValueError, match="unit 'kg' is no unit of q"):
        draft(log, units={"q": ["kg"]})


REMARKS = {
    "gaps": ({"q1": Q1, "cmd1": np.where(np.arange(800) % 5, np.nan, C1)}, "cmd1 is empty in 640 rows"),
    "another scale": ({"dof_pos[0]": Q1, "actions[0]": 4 * C1}, "0.25 for one of actions[0]: a soft servo, or another"),
    "a gripper": ({"gripper_pos": Q1, "gripper_target_pos": C1}, "logged as a part of their range"),
    "a rate in another unit": (
        {"q1": Q1, "cmd1": C1, "velocity1": V1 / TURN * 60},
        "velocity1 is 9.55 times the slope",
    ),
    "a rate in words": ({"q1": Q1, "cmd1": C1, "velocity1": word(600 * V1)}, "highest bit is a sign"),
    "velocities among the states": (
        STATES | ACTIONS | {"observation.state[2]": V1},
        "observation.state[2] are velocities",
    ),
    "a free joint": ({"q_a": Q1, "q_b": Q2, "cmd_a": C1}, "q_b have no command"),
    "several recordings": ({"q1": Q1, "cmd1": C1, "episode_index": 1.0 * (T > 4)}, "goes on over several recordings"),
}


@pytest.mark.parametrize(("log", "remark"), REMARKS.values(), ids=REMARKS)
def test_what_is_odd_is_said(log, remark):
    found = draft({"t": T} | log)
    assert any(remark in each for each in found.remarks), found.remarks
    assert found.servos
    assert found.v == ()


def test_a_lag_and_an_offset_are_measured_where_they_show():
    found = first_servo(draft({"t": T, "q1": Q1 + 0.3, "cmd1": C1}))
    assert (found.lag, found.offset) == (pytest.approx(0.06, abs=0.015), pytest.approx(0.3, abs=0.01))
    still = first_servo(draft({"t": T, "q1": REST, "q2": Q2, "cmd1": REST, "cmd2": C2}))
    assert (still.lag, still.offset) == (None, 0.0)


def test_inputs_that_are_named_are_commands_where_positions_follow_them():
    assert first_servo(draft({"t": T, "q1": Q1, "a": C1, "b": V1}, {"u": ["a"]})).command == "a"
    assert draft({"t": T, "q1": Q1, "a": C1 - Q1, "b": V1}, {"u": ["a"]}).servos == ()
    assert draft({"t": T, "q1": Q1, "tau1": C1}, {"u": ["tau1"]}).servos == ()


def test_names_of_entries_name_positions_and_tell_rates():
    entries = {"observation.state[0]": "elbow.pos", "observation.state[1]": "elbow.vel"}
    found = draft(STATES | {"action[0]": C1, "observation.state[1]": V1}, entries=entries)
    assert (found.q, found.v) == (("observation.state[0]",), ("observation.state[1]",))
    assert found.plain_names == ("elbow",)
