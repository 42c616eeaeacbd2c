"""Servos that are told positions, from real logs: `fit` beside other programs, by open-loop errors on other logs.

Two machines: one XL330 servo that holds a weight, at four position gains, and the five joints of an SO-101 arm. Each
program fits the same logs and predicts the same other ones, from their first positions and commands alone. The others:
`mujoco.sysid`; a search by evolution in MuJoCo over the numbers of PACE (rotor, viscous and dry friction and encoder
bias of each joint, one delay for all; here the stiffness too, which PACE takes as known); the friction models M1 and
M6 of BAM with the numbers that it publishes for the XL330.

Run `COVARIANT_DATA=... python benchmarks/servo_fits.py` from the repository's root, after
`pip install -r benchmarks/requirements.txt`. The table goes to `benchmarks/servo_fits.md`.
"""

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cma
import mujoco
import numpy as np
from mujoco import rollout, sysid
from numpy.typing import NDArray

DATA = Path(os.environ["COVARIANT_DATA"])
TABLE = Path(__file__).with_name("servo_fits.md")
GRAVITY, MASS, LENGTH = 9.80665, 0.49, 0.1
DUTY = 4096 / (2 * np.pi) / (256 * 885)
"""Duty cycle of an XL330 for a unit of its position gain and of the error [1/rad]."""
SUBSTEPS = 2
SECONDS = 300.0
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
        most: Largest values of the servo's numbers, as in `NUMBERS`.
        limit: Largest torque by the data sheet [N m].
    """

    name: str
    fitted: dict[str, Log]
    held_out: dict[str, Log]
    spec: Callable[[], mujoco.MjSpec]
    joints: tuple[str, ...]
    most: tuple[float, ...]
    limit: float


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
    most = (0.01, 0.2, 2.0, 0.01, 0.1, 0.2, 0.1, 0.03)
    logs = [{name: log(name) for name in names} for names in (fitted, held_out)]
    return Machine("XL330", *logs, spec, ("servo",), most, 0.77)


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
    most = (60.0, 5.0, 6.0, 0.3, 5.0, 1.0, 0.2, 0.15)
    logs = [
        {name: log(name) for name in names}
        for names in (("multisine", "friction_gravity"), ("step_response", "static_holding", "slow_precision"))
    ]
    return Machine("SO-101", *logs, spec, joints, most, 2.94)


def with_servos(machine: Machine, period: float, gain: float = 1.0, on: bool = True) -> mujoco.MjSpec:
    """The machine in MuJoCo with a position servo for each joint, all numbers zero; without it where it is off."""
    spec = machine.spec()
    spec.option.timestep, spec.option.integrator = period / SUBSTEPS, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.modelname = f"{gain if on else 0.0}"
    for joint in machine.joints:
        actuator = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=1.0)
        actuator.forcelimited, actuator.forcerange = True, [-1.0, 1.0]
    return spec


def set_servo(spec: mujoco.MjSpec, joint: str, numbers: NDArray) -> None:
    """Write the numbers of a joint (7,), as in `NUMBERS` but without the delay, into a model."""
    gain = float(spec.modelname)
    kp, kv, limit, armature, damping, frictionloss, offset = (float(number) for number in numbers)
    actuator, hinge = spec.actuator(joint), spec.joint(joint)
    actuator.gainprm[0] = kp * gain
    actuator.biasprm[:3] = [kp * gain * offset, -kp * gain, -kv if gain else 0.0]
    actuator.forcerange = [-limit, limit]
    hinge.armature, hinge.frictionloss, hinge.damping = armature, frictionloss, [damping, 0.0, 0.0]


def pieces(log: Log) -> list[tuple[bool, slice]]:
    """Stretches of a log with the servo on or off."""
    if log.on is None or log.on.all():
        return [(True, slice(0, len(log.q)))]
    cut = int(np.argmin(log.on))
    return [(True, slice(0, cut)), (False, slice(cut, len(log.q)))]


class Simulator:
    """Predictions of logs by MuJoCo, one model for each stretch of a log."""

    def __init__(self, machine: Machine, logs: dict[str, Log]):
        self.machine, self.logs = machine, logs
        self.stretches = {
            name: [(with_servos(machine, log.period, log.gain, on), rows) for on, rows in pieces(log)]
            for name, log in logs.items()
        }

    def predict(self, numbers: NDArray, delays: NDArray) -> dict[str, NDArray]:
        """Positions (T, n) of each log, for numbers (n, 7) of the joints and delays (n,) of their commands."""
        predictions = {}
        for name, log in self.logs.items():
            t = log.period * np.arange(len(log.q))
            fine = log.period / SUBSTEPS * np.arange(SUBSTEPS * len(log.q))
            c = np.stack([np.interp(fine - delay, t, c) for delay, c in zip(delays, log.c.T, strict=True)], 1)
            path, state = [], None
            for spec, rows in self.stretches[name]:
                for joint, servo in zip(self.machine.joints, numbers, strict=True):
                    set_servo(spec, joint, servo)
                model = spec.compile()
                order = [model.joint(joint).qposadr[0] for joint in self.machine.joints]
                if state is None:
                    state = np.zeros(model.nq + model.nv)
                    state[order] = log.q[0]
                control = c[rows.start * SUBSTEPS : rows.stop * SUBSTEPS]
                first = np.concatenate([[0.0], state])
                states = rollout.rollout(model, mujoco.MjData(model), first[None], control[None])[0][0]
                states = np.concatenate([first[None], states])[:, 1:]
                path.append(states[:-1:SUBSTEPS][:, order])
                state = states[-1]
            predictions[name] = np.concatenate(path)
        return predictions


def by_sysid(machine: Machine) -> Outcome:
    """Fit by `mujoco.sysid`: stiffness, damping of the servo, limit, rotor, friction and offset of each joint.

    It has no delay of a control among its numbers; the delay is the best one of a grid, one for all joints.
    """
    start, cpu = time.perf_counter(), time.process_time()
    most = np.array(machine.most[:-1])
    lowest = np.where(np.array(NUMBERS[:-1]) == "offset", -most, 1e-4 * most)

    def fit(delay: float, iterations: int, first: NDArray | None):
        numbers = sysid.ParameterDict()
        for i, joint in enumerate(machine.joints):
            nominal = 0.3 * most * (most != machine.most[6]) if first is None else first[i]
            change = lambda spec, number, joint=joint: set_servo(spec, joint, number.value)  # noqa: E731
            numbers.add(sysid.Parameter(joint, nominal=nominal, min_value=lowest, max_value=most, modifier=change))
        sequences = []
        for name, log in machine.fitted.items():
            t = log.period * np.arange(len(log.q))
            c = np.stack([np.interp(t - delay, t, c) for c in log.c.T], 1)
            for on, rows in pieces(log):
                spec = with_servos(machine, log.period, log.gain, on)
                model = spec.compile()
                order = [model.joint(joint).qposadr[0] for joint in machine.joints]
                q0, q = np.zeros(model.nq), log.q[rows]
                q0[order] = q[0]
                at = t[rows] - t[rows.start]
                state = sysid.create_initial_state(model, q0, np.zeros(model.nv), np.zeros(0))
                positions = sysid.TimeSeries.from_names(at, q, model, [f"{joint}_qpos" for joint in machine.joints])
                control = sysid.TimeSeries(at, c[rows])
                sequences.append(
                    sysid.ModelSequences(
                        f"{name}{on}", spec, name, state, control, positions, allow_missing_sensors=True
                    )
                )
        residual = sysid.build_residual_fn(models_sequences=sequences, n_threads=1)
        found, result = sysid.optimize(numbers, residual, optimizer="mujoco", verbose=False, max_iters=iterations)
        values = found.as_vector()
        cost = sum(float(np.sum(part**2)) for part in residual(values, found)[0])
        return cost, values.reshape(len(machine.joints), -1), result

    grid = np.linspace(0.0, 0.5 * machine.most[-1], 4)
    delay, (_, first, _) = min(((d, fit(d, 6, None)) for d in grid), key=lambda tried: tried[1][0])
    half = grid[1] / 2
    tries = [(d, fit(d, 25, first)) for d in (delay - half, delay, delay + half) if d >= 0]
    delay, (_, values, _) = min(tries, key=lambda tried: tried[1][0])
    wall, cpu = time.perf_counter() - start, time.process_time() - cpu
    predictions = Simulator(machine, machine.held_out).predict(values, np.full(len(values), delay))
    print(machine.name, "sysid", np.round(values, 5).tolist(), delay, flush=True)
    return Outcome(predictions, values.size + 1, True, wall, cpu)


def by_evolution(machine: Machine) -> Outcome:
    """Search by CMA-ES over PACE's numbers and the stiffness, to the end or for `SECONDS` of processor time."""
    start, cpu = time.perf_counter(), time.process_time()
    most = dict(zip(NUMBERS, machine.most, strict=True))
    fitted, n = Simulator(machine, machine.fitted), len(machine.joints)
    keys = ("kp", "armature", "damping", "frictionloss", "offset")

    def unpack(x: NDArray) -> tuple[NDArray, NDArray]:
        part = dict(zip(keys, np.reshape(x[:-1], (len(keys), n)), strict=True))
        columns = [
            np.full(n, machine.limit)
            if key == "limit"
            else np.zeros(n)
            if key not in part
            else most[key] * (2 * part[key] - 1 if key == "offset" else part[key] ** 2)
            for key in NUMBERS[:-1]
        ]
        return np.stack(columns, 1), np.full(n, x[-1] * most["delay"])

    def cost(x: NDArray) -> float:
        predictions = fitted.predict(*unpack(np.asarray(x)))
        squares = [np.mean((predictions[name] - log.q) ** 2) for name, log in machine.fitted.items()]
        return float(np.mean(squares)) if np.all(np.isfinite(squares)) else 1e3

    settings = {"bounds": [0.0, 1.0], "seed": 1, "verbose": -9, "maxfevals": 20000, "tolfun": 1e-10}
    search = cma.CMAEvolutionStrategy(np.full(len(keys) * n + 1, 0.5), 0.2, settings)
    while not search.stop() and time.process_time() - cpu < SECONDS:
        points = search.ask()
        search.tell(points, [cost(x) for x in points])
    wall, cpu = time.perf_counter() - start, time.process_time() - cpu
    numbers, delays = unpack(np.asarray(search.result.xbest))
    print(machine.name, "CMA-ES", search.result.evaluations, np.round(numbers, 5).tolist(), delays[0], flush=True)
    return Outcome(Simulator(machine, machine.held_out).predict(numbers, delays), len(keys) * n + 1, False, wall, cpu)


def by_bam(machine: Machine, name: str) -> Outcome:
    """Predictions by BAM's model M1 or M6 with its published numbers; friction stops the joint within a step."""
    p = json.loads((DATA / "xl330" / f"bam_{name}.json").read_text(encoding="utf-8"))
    predictions = {key: bam(p, log) for key, log in machine.held_out.items()}
    return Outcome(predictions, sum(isinstance(value, float) for value in p.values()), False)


def bam(p: dict, log: Log) -> NDArray:
    """Positions (T, 1) of a log by a model of BAM, one step for each row."""
    assert log.on is not None and log.volts is not None
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


def row(program: str, machine: Machine, outcome: Outcome) -> str:
    """The row of a program in the table."""
    errors = [
        1e3 * np.sqrt(np.mean((outcome.predictions[name] - log.q) ** 2)) for name, log in machine.held_out.items()
    ]
    total = np.sqrt(np.mean(np.square(errors)))
    times = "published" if outcome.wall is None else f"{outcome.wall:.0f} ({outcome.cpu:.0f})"
    cells = (
        machine.name,
        program,
        times,
        f"{total:.1f}",
        ", ".join(f"{error:.1f}" for error in errors),
        str(outcome.numbers),
        "yes" if outcome.intervals else "no",
    )
    return f"| {' | '.join(cells)} |"
