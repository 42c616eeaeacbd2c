"""Servos that are told positions, from real logs: `fit` beside other programs, by open-loop errors on other logs.

Two machines: one XL330 servo that holds a weight, at four position gains, and the five joints of an SO-101 arm. Each
program fits the same logs and predicts the same other ones, from their first positions and commands alone. The others:
`mujoco.sysid`; a search by evolution in MuJoCo over the numbers of PACE (rotor, viscous and dry friction and encoder
bias of each joint, one delay for all; here the stiffness too, which PACE takes as known); the friction models M1 and
M6 of BAM with the numbers that it publishes for the XL330.

Run `COVARIANT_DATA=... python benchmarks/servo_fits.py` from the repository's root, after
`pip install -r benchmarks/requirements.txt`. Words after it choose programs: `... servo_fits.py sysid`; rows of
the others stay, with their dates, in `benchmarks/servo_fits.json`.
"""

import datetime
import functools
import json
import math
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cma
import mujoco
import numpy as np
from mujoco import rollout, sysid
from numpy.typing import NDArray

import covariant
from covariant import models
from covariant.calibration.identification import predict_servos
from covariant.signals import Record

DATA, EXAMPLES = Path(os.environ["COVARIANT_DATA"]), Path(__file__).parents[1] / "examples"
TABLE = Path(__file__).with_name("servo_fits.json")
GRAVITY, MASS, LENGTH = 9.80665, 0.49, 0.1
DUTY = 4096 / (2 * np.pi) / (256 * 885)
"""Duty cycle of an XL330 for a unit of its position gain and of the error [1/rad]."""
SUBSTEPS = 2
ROUGH = {
    "stiffness": 0.003,
    "limit": 0.8,
    "back_emf": 0.05,
    "viscous": 0.01,
    "coulomb": 0.01,
    "stribeck": 0.01,
    "load": 0.4,
    "armature": 0.002,
}
"""First numbers of the XL330, in place of those of the example."""
ARM = {
    "stiffness": 12.0,
    "damping": 0.5,
    "delay": 0.03,
    "feedforward": 0.3,
    "coulomb": 0.06,
    "load_external": 0.3,
    "armature": 0.01,
    "stribeck": 0.03,
    "stribeck_velocity": 0.05,
}
"""First numbers of each joint of the SO-101."""
SECONDS = 60.0
"""Processor time at which the search by evolution stops [s]."""


class Log(NamedTuple):
    """Positions q and commands c (T, n) at equal periods; gain, switch (T,) and supply (T,) are of the XL330 alone."""

    period: float
    q: NDArray
    c: NDArray
    gain: float = 1.0
    on: NDArray | None = None
    volts: NDArray | None = None


class Machine(NamedTuple):
    """A machine: its logs, its model in MuJoCo, and the joints in the order of the columns.

    Attributes:
        fitted: Logs to fit.
        held_out: Logs to predict.
        spec: Model without servos.
        joints: Names of the joints (n).
        first: First values of the servo's numbers, as in `NUMBERS`: those of `covariant fit`, where it has them.
        most: Their largest values.
        limit: Largest torque by the data sheet [N m].
        model_file: Text of the model file with first numbers.
        opened: Numbers that `covariant fit` finds.
    """

    name: str
    fitted: dict[str, Log]
    held_out: dict[str, Log]
    spec: Callable[[], mujoco.MjSpec]
    joints: tuple[str, ...]
    first: tuple[float, ...]
    most: tuple[float, ...]
    limit: float
    model_file: Callable[[], str]
    opened: list[str]


class Outcome(NamedTuple):
    """What a program made of a machine's logs: positions of each held-out log, by name, and facts on the fit."""

    predictions: dict[str, NDArray]
    numbers: int
    intervals: bool
    wall: float | None = None
    cpu: float | None = None


NUMBERS = ("kp", "kv", "limit", "armature", "damping", "frictionloss", "offset", "delay")
"""Numbers of a joint with a servo in MuJoCo; offset is added to the command, delay is that of the actuator."""


def xl330() -> Machine:
    """The XL330: logs at gains 100 and 400 are fitted, those at 200 and 800 predicted."""

    def log(name: str) -> Log:
        rows = np.genfromtxt(DATA / "xl330" / f"{name}.csv", delimiter=",", names=True)
        gain = float(name.split("_")[0].removeprefix("kp"))
        return Log(0.005, rows["q"][:, None], rows["cmd"][:, None], gain, rows["torque_enabled"], rows["volts"])

    def spec() -> mujoco.MjSpec:
        return mujoco.MjSpec.from_string(f"""<mujoco><option gravity="0 0 -{GRAVITY}"/><worldbody><body>
            <joint name="servo" axis="0 1 0"/><inertial pos="0 0 -{LENGTH}" mass="{MASS}" diaginertia="1e-9 1e-9 1e-9"/>
            </body></worldbody></mujoco>""")

    fitted = ("kp100_lift_and_drop", "kp100_sin_sin", "kp400_lift_and_drop", "kp400_sin_sin")
    held_out = ("kp200_sin_time_square", "kp200_up_and_down", "kp800_sin_time_square", "kp800_up_and_down")
    first = (0.003, 0.05, 0.8, 0.002, 0.01, 0.01, 0.0, 0.005)
    most = (0.01, 0.2, 2.0, 0.01, 0.1, 0.2, 0.1, 0.06)
    logs = [{name: log(name) for name in names} for names in (fitted, held_out)]

    def model_file() -> str:
        text = (EXAMPLES / "xl330.toml").read_text(encoding="utf-8")
        for key, first in ROUGH.items():
            text = re.sub(rf"^{key} = \S+", f"{key} = {first}", text, flags=re.MULTILINE)
        text = text.replace("servo = 0.0137", "servo = 0.0")
        return text.replace('"xl330.urdf"', json.dumps(str(EXAMPLES / "xl330.urdf")))

    opened = [f"servo.servo.{key}" for key in ROUGH] + ["offsets.servo"]
    # Whole logs: this joint sticks for seconds.
    return Machine("XL330", *logs, spec, ("servo",), first, most, 0.77, model_file, opened)


def so101() -> Machine:
    """The five joints of the SO-101's arm: a multisine and slow motion are fitted, three other motions predicted."""
    columns = ("rotation", "pitch", "elbow", "wrist_pitch", "wrist_roll")

    def log(name: str) -> Log:
        rows = np.genfromtxt(DATA / "so101" / f"{name}.csv", delimiter=",", names=True)
        q, c = (np.stack([rows[f"{kind}_{column}"] for column in columns], 1) for kind in ("q", "cmd"))
        return Log(float(np.mean(np.diff(rows["t"]))), q, c)

    def spec() -> mujoco.MjSpec:
        arm = mujoco.MjSpec.from_file(str(DATA / "so101/so101.urdf"))
        # The jaw hangs on a mechanism that the file does not have: it is held.
        arm.delete(arm.joint("gripper"))
        return arm

    joints = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
    first = (12.0, 0.5, 2.9, 0.01, 0.1, 0.06, 0.0, 0.03)
    most = (60.0, 5.0, 6.0, 0.3, 5.0, 1.0, 0.2, 0.15)
    logs = [
        {name: log(name) for name in names}
        for names in (("multisine", "friction_gravity"), ("step_response", "static_holding", "slow_precision"))
    ]

    def model_file() -> str:
        tables = (f"[servo.{joint}]\n" + "".join(f"{key} = {x}\n" for key, x in ARM.items()) for joint in joints)
        return 'system = "robot"\n[parameters]\npath = "so101"\nlock = { gripper = 0.5 }\n' + "".join(tables)

    return Machine("SO-101", *logs, spec, joints, first, most, 2.94, model_file, ["servo"])


def with_servos(machine: Machine, period: float, gain: float = 1.0, on: bool = True) -> mujoco.MjSpec:
    """The machine in MuJoCo with a position servo for each joint, all numbers zero; without it where it is off."""
    spec = machine.spec()
    spec.option.timestep, spec.option.integrator = period / SUBSTEPS, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.modelname = f"{gain if on else 0.0}"
    for joint in machine.joints:
        actuator = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=1.0)
        actuator.forcelimited, actuator.forcerange = True, [-1.0, 1.0]
        # Linear between samples, so that the delay is a number like the others.
        actuator.interp, actuator.nsample = 1, math.ceil(machine.most[-1] / spec.option.timestep) + 2
    return spec


def set_servo(spec: mujoco.MjSpec, joint: str, numbers: NDArray) -> None:
    """Write the numbers of a joint, in the order of `NUMBERS`, into a model."""
    gain = float(spec.modelname)
    kp, kv, limit, armature, damping, frictionloss, offset, delay = (float(number) for number in numbers)
    actuator, hinge = spec.actuator(joint), spec.joint(joint)
    actuator.gainprm[0] = kp * gain
    actuator.biasprm[:3] = [kp * gain * offset, -kp * gain, -kv if gain else 0.0]
    actuator.forcerange, actuator.delay = [-limit, limit], delay
    hinge.armature, hinge.frictionloss, hinge.damping = armature, frictionloss, [damping, 0.0, 0.0]


def pieces(log: Log) -> list[tuple[bool, slice]]:
    """Stretches of a log with the servo on or off."""
    if log.on is None or log.on.all():
        return [(True, slice(0, len(log.q)))]
    cut = int(np.argmin(log.on))
    return [(True, slice(0, cut)), (False, slice(cut, len(log.q)))]


def initial_state(machine: Machine, model: mujoco.MjModel, q: NDArray, v: NDArray, c: NDArray) -> NDArray:
    """State of a model at positions q, rates v and commands c (n,) of the joints, which held until then."""
    data = mujoco.MjData(model)
    for joint, position, rate, command in zip(machine.joints, q, v, c, strict=True):
        actuator = model.actuator(joint).id
        data.joint(joint).qpos[:], data.joint(joint).qvel[:] = position, rate
        samples = int(model.actuator_history[actuator, 0])
        times = model.opt.timestep * np.arange(-samples, 0.0)
        mujoco.mj_initCtrlHistory(model, data, actuator, times, np.full(samples, command))
    state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    return state


class Simulator:
    """Predictions of logs by MuJoCo, one model for each stretch of a log."""

    def __init__(self, machine: Machine, logs: dict[str, Log]):
        self.machine, self.logs = machine, logs
        self.stretches = {
            name: [(with_servos(machine, log.period, log.gain, on), rows) for on, rows in pieces(log)]
            for name, log in logs.items()
        }

    def predict(self, numbers: NDArray) -> dict[str, NDArray]:
        """Positions (T, n) of each log, for numbers (n, 8) of the joints, in the order of `NUMBERS`."""
        predictions = {}
        for name, log in self.logs.items():
            rows = np.arange(len(log.q))
            fine = np.arange(SUBSTEPS * len(log.q)) / SUBSTEPS
            control = np.stack([np.interp(fine, rows, c) for c in log.c.T], 1)
            path, (q, v) = [], (log.q[0], np.zeros(len(self.machine.joints)))
            for spec, part in self.stretches[name]:
                for joint, servo in zip(self.machine.joints, numbers, strict=True):
                    set_servo(spec, joint, servo)
                model = spec.compile()
                first = initial_state(self.machine, model, q, v, log.c[part.start])
                u = control[part.start * SUBSTEPS : part.stop * SUBSTEPS]
                states = rollout.rollout(model, mujoco.MjData(model), first[None], u[None])[0][0]
                states = np.concatenate([first[None], states])
                order = 1 + np.array([model.joint(joint).qposadr[0] for joint in self.machine.joints])
                path.append(states[:-1:SUBSTEPS][:, order])
                q, v = states[-1, order], states[-1, model.nq + order]
            predictions[name] = np.concatenate(path)
        return predictions


def by_covariant(machine: Machine) -> Outcome:
    """Fit by `covariant.fit`, and predictions by the fitted file along their own path."""
    names = machine.opened
    logs = {**machine.fitted, **dict(list(machine.held_out.items())[-1:])}
    with tempfile.TemporaryDirectory() as folder:
        first = Path(folder) / "first.toml"
        first.write_text(machine.model_file(), encoding="utf-8")
        gains = [{f"servo.{joint}.gain": log.gain for joint in machine.joints} for log in logs.values()]
        start, cpu = time.perf_counter(), time.process_time()
        result = covariant.fit(first, [record(log) for log in logs.values()], names, overrides=gains)
        wall, cpu = time.perf_counter() - start, time.process_time() - cpu
        print(result, flush=True)
        found = dict(zip((row["name"] for row in result.summary["parameters"]), result.values, strict=True))
        fitted = tuple(f"{'parameters.' * name.startswith('offsets')}{name}={x}" for name, x in found.items())
        predictions = {}
        for name, log in machine.held_out.items():
            gain = tuple(f"servo.{joint}.gain={log.gain}" for joint in machine.joints)
            family, known = models.robot_family(str(first), names, fitted + gain), record(log)
            # The weight is evaluated along a path, and here that is the prediction: no row but the first is looked at.
            path = np.repeat(log.q[:1], len(log.q), axis=0)
            for _ in range(4):
                path = predict_servos(family, np.zeros(len(family.names)), known._replace(y=path))
            predictions[name] = path
    return Outcome(predictions, len(result.values), True, wall, cpu)


def record(log: Log) -> Record:
    """A log as `covariant` reads it."""
    u = log.c if log.on is None else np.concatenate([log.c, log.on[:, None]], 1)
    return Record(log.period * np.arange(len(log.q)), u, log.q)


def by_sysid(machine: Machine) -> Outcome:
    """Fit by `mujoco.sysid`, which has all of `NUMBERS` for each joint."""
    start, cpu = time.perf_counter(), time.process_time()
    most = np.array(machine.most)
    offset = np.array(NUMBERS) == "offset"
    numbers, sequences = sysid.ParameterDict(), []
    for joint in machine.joints:
        lowest, first = np.where(offset, -most, 1e-4 * most), np.array(machine.first)
        change = functools.partial(write_parameter, joint)
        numbers.add(sysid.Parameter(joint, nominal=first, min_value=lowest, max_value=most, modifier=change))
    for name, log in machine.fitted.items():
        for on, rows in pieces(log):
            spec = with_servos(machine, log.period, log.gain, on)
            model, q, c = spec.compile(), log.q[rows], log.c[rows]
            t = log.period * np.arange(len(q))
            state = initial_state(machine, model, q[0], np.zeros(len(q[0])), c[0])
            # Positions of the state: those of a sensor are one step late in a rollout.
            positions = sysid.TimeSeries.from_names(t, q, model, [f"{joint}_qpos" for joint in machine.joints])
            parts = (spec, name, state, sysid.TimeSeries(t, c), positions)
            sequences.append(sysid.ModelSequences(f"{name} {on}", *parts, allow_missing_sensors=True))
    residual = sysid.build_residual_fn(models_sequences=sequences, n_threads=1)
    found, _ = sysid.optimize(numbers, residual, optimizer="mujoco", verbose=False, max_iters=12)
    wall, cpu = time.perf_counter() - start, time.process_time() - cpu
    values = found.as_vector().reshape(len(machine.joints), -1)
    print(machine.name, "sysid", np.round(values, 5).tolist(), flush=True)
    return Outcome(Simulator(machine, machine.held_out).predict(values), values.size, True, wall, cpu)


def write_parameter(joint: str, spec: mujoco.MjSpec, numbers: sysid.Parameter) -> None:
    """Write the numbers of a joint, as `mujoco.sysid` has them, into a model."""
    set_servo(spec, joint, np.asarray(numbers.value))


def by_evolution(machine: Machine) -> Outcome:
    """Search by CMA-ES over PACE's numbers and the stiffness, to the end or for `SECONDS` of processor time."""
    start, cpu = time.perf_counter(), time.process_time()
    most = dict(zip(NUMBERS, machine.most, strict=True))
    fitted, n = Simulator(machine, machine.fitted), len(machine.joints)
    keys = ("kp", "armature", "damping", "frictionloss", "offset")

    def unpack(x: NDArray) -> NDArray:
        part = dict(zip(keys, np.reshape(x[:-1], (len(keys), n)), strict=True)) | {"delay": np.full(n, x[-1])}
        numbers = np.zeros((n, len(NUMBERS)))
        for i, key in enumerate(NUMBERS):
            if key == "offset":
                numbers[:, i] = most[key] * (2 * part[key] - 1)
            elif key in part:
                numbers[:, i] = most[key] * part[key] ** 2
        numbers[:, NUMBERS.index("limit")] = machine.limit
        return numbers

    def cost(x: NDArray) -> float:
        predictions = fitted.predict(unpack(np.asarray(x)))
        squares = [np.mean((predictions[name] - log.q) ** 2) for name, log in machine.fitted.items()]
        return float(np.mean(squares)) if np.all(np.isfinite(squares)) else 1e3

    settings = {"bounds": [0.0, 1.0], "seed": 1, "verbose": -9, "maxfevals": 20000, "tolfun": 1e-10}
    search = cma.CMAEvolutionStrategy(np.full(len(keys) * n + 1, 0.5), 0.2, settings)
    while not search.stop() and time.process_time() - cpu < SECONDS:
        points = search.ask()
        search.tell(points, [cost(x) for x in points])
    wall, cpu = time.perf_counter() - start, time.process_time() - cpu
    numbers = unpack(np.asarray(search.result.xbest))
    print(machine.name, "CMA-ES", search.result.evaluations, np.round(numbers, 5).tolist(), flush=True)
    return Outcome(Simulator(machine, machine.held_out).predict(numbers), len(keys) * n + 1, False, wall, cpu)


def by_bam(machine: Machine, name: str) -> Outcome:
    """Predictions by BAM's model M1 or M6 with its published numbers; friction stops the joint within a step."""
    p = json.loads((DATA / "xl330" / f"bam_{name}.json").read_text(encoding="utf-8"))
    predictions = {key: bam(p, log) for key, log in machine.held_out.items()}
    return Outcome(predictions, sum(isinstance(value, float) for value in p.values()), False)


def bam(p: dict, log: Log) -> NDArray:
    """Positions (T, 1) of a log by a model of BAM, one step for each row."""
    assert log.on is not None
    assert log.volts is not None
    h, inertia = log.period, MASS * LENGTH**2 + p["armature"]
    q, v, path = log.q[0, 0] + p["q_offset"], 0.0, []
    for c, on, volts in zip(log.c[:, 0], log.on, log.volts, strict=True):
        path.append(q - p["q_offset"])
        duty = np.clip(DUTY * log.gain * (c - q), -1, 1)
        motor = on * (p["kt"] * volts * duty / p["R"] - p["kt"] ** 2 * v / p["R"])
        weight = -MASS * GRAVITY * LENGTH * np.sin(q)
        net = motor + weight
        stop = inertia / h * v + net
        acceleration = (net - np.clip(stop, *(friction(p, v, motor, weight) * np.array([-1, 1])))) / inertia
        v += h * acceleration
        q += h * v + h**2 / 2 * acceleration
    return np.array(path)[:, None]


def friction(p: dict, v: float, motor: float, weight: float) -> float:
    """Largest friction [N m] of BAM's M1, and of M6 where the numbers are those."""
    most = p["friction_base"] + p["friction_viscous"] * abs(v)
    if p["model"] == "m1":
        return most
    s = np.exp(-(abs(v / p["dtheta_stribeck"]) ** p["alpha"]))
    most += abs(p["load_friction_external"] * weight - p["load_friction_motor"] * motor)
    at_rest = abs(p["load_friction_external_stribeck"] * weight - p["load_friction_motor_stribeck"] * motor)
    square = 0.0
    if weight * motor < 0:
        carried = abs(weight) < abs(motor)
        square = p["load_friction_external_quad"] * weight**2 if carried else p["load_friction_motor_quad"] * motor**2
    return most + s * (p["friction_stribeck"] + at_rest + square)


def row(machine: Machine, outcome: Outcome) -> dict:
    """What the table says of a program: times, errors of the predictions, count of numbers, intervals."""
    errors = {
        name: round(1e3 * float(np.sqrt(np.mean((outcome.predictions[name] - log.q) ** 2))), 1)
        for name, log in machine.held_out.items()
    }
    return {
        "wall_s": outcome.wall and round(outcome.wall),
        "processor_s": outcome.cpu and round(outcome.cpu),
        "rms_mrad": round(float(np.sqrt(np.mean(np.square(list(errors.values()))))), 1),
        "errors_mrad": errors,
        "numbers": outcome.numbers,
        "intervals": outcome.intervals,
        "date": datetime.date.today().isoformat(),
    }


PROGRAMS: dict[str, Callable[[Machine], Outcome]] = {
    "`covariant fit`": by_covariant,
    "`mujoco.sysid`": by_sysid,
    "CMA-ES on PACE's numbers": by_evolution,
    "BAM M1, published": functools.partial(by_bam, name="m1"),
    "BAM M6, published": functools.partial(by_bam, name="m6"),
}


def printed(table: dict) -> None:
    """Print the table."""
    print("| machine | program | wall (processor) [s] | error [mrad] | of each log | numbers | intervals |")
    print("|---|---|--:|--:|--:|--:|---|")
    for machine, rows in table.items():
        for program in (each for each in PROGRAMS if each in rows):
            of = rows[program]
            times = f"{of['wall_s']} ({of['processor_s']})" if of["wall_s"] else ""
            errors = ", ".join(f"{error:.1f}" for error in of["errors_mrad"].values())
            cells = (machine, program, times, f"{of['rms_mrad']:.1f}", errors, of["numbers"], _word(of["intervals"]))
            print(f"| {' | '.join(str(cell) for cell in cells)} |")


def _word(intervals: bool) -> str:
    return "yes" if intervals else "no"


def main() -> None:
    """Run the programs whose names contain a word of the command line, or all; rows of the others stay."""
    for machine in (xl330(), so101()):
        for program, fit in PROGRAMS.items():
            named = len(sys.argv) == 1 or any(word in program for word in sys.argv[1:])
            if named and not (program.startswith("BAM") and machine.name != "XL330"):
                found = row(machine, fit(machine))
                table = json.loads(TABLE.read_text(encoding="utf-8")) if TABLE.exists() else {}
                table.setdefault(machine.name, {})[program] = found
                TABLE.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    printed(json.loads(TABLE.read_text(encoding="utf-8")))


if __name__ == "__main__":
    main()
