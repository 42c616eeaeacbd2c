"""Plain commands: verbs, machines and logs of every kind, and what a command must never do with them.

A command gives a result, or refuses its input with exit code 1 or 2 and one line. It never ends in another exception,
never warns, and never leaves an empty file.
"""

import itertools
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from commands import leave

import covariant
from covariant import logs, models

EXAMPLES = Path(__file__).parents[2] / "examples"
ROWS, RATE = 601, 200.0
FILES = 4
"""In how many files the log with the fewest rows in each is."""


class Machine(NamedTuple):
    """Parameters to fit, the motion in a log as arguments of `simulate`, and numbers that the model file lacks."""

    parameters: str
    motion: dict
    numbers: tuple[str, ...] = ()


PENDULUM = Machine("com,inertia", {"q0": [1.0], "amplitude": [0.5]})
DOUBLE = Machine("com,inertia", {"q0": [0.6, 0.3], "amplitude": [0.5, 0.2]})
MACHINES = {
    "demo_double_pendulum.toml": DOUBLE,
    "dfki_double_pendulum.toml": DOUBLE,
    "dfki_simple_pendulum.toml": PENDULUM,
    "dfki_simple_pendulum_dircol.toml": PENDULUM,
    "multiarm_double.toml": DOUBLE._replace(motion={"q0": [2.5, 3.5]}),
    "multiarm_single.toml": PENDULUM._replace(motion={"q0": [2.0]}),
    "heavy_top.toml": Machine("moment,viscous", {"q0": [0.3, 0.2, 0.0], "v0": [0.5, 1.0, 4.0], "amplitude": [0.1] * 3}),
    "underwater_vehicle.toml": Machine("mass", {"amplitude": [20.0, 0.0, 5.0, 0.0, 0.0, 1.0]}),
    "so101.toml": Machine("servo", {"amplitude": [0.3] * 5}),
    "xl330.toml": Machine("servo", {"amplitude": [0.5, 0.0]}),
    "chain.toml": Machine("mass,viscous", {"q0": [0.5, 0.2, 0.1], "amplitude": [0.5, 0.2, 0.1]}),
    "cart.toml": Machine("friction", {"q0": [0.0, 0.4], "amplitude": [1.0, 0.0]}),
    "ship.toml": Machine("mass", {"amplitude": [1.0, 0.5, 0.2]}),
    "tank:two_levels": Machine(
        "outflow",
        {"q0": [1.0, 0.5], "amplitude": [0.3]},
        ("measurement.std=1e-3", "uncertainty.process=[0.01,0.01]", "initial.std=1.0"),
    ),
    "arm.urdf": Machine("friction", DOUBLE.motion, ("measurement.std=1e-3", "uncertainty.acceleration=0.5")),
}
"""All machines by what a command is given: the examples, and small ones that these lines write."""
WRITTEN = {
    "chain.toml": """system = "pendulum_chain"
[parameters]
mass = [1.0, 0.5, 0.3]
length = [0.5, 0.4, 0.3]
viscous = [0.1, 0.1, 0.05]
""",
    "cart.toml": """system = "robot"
[parameters]
path = "cart.urdf"
[measurement]
std = 1e-3
[uncertainty]
acceleration = 0.5
""",
    "ship.toml": """system = "cybership"
[measurement]
std = 1e-3
[uncertainty]
process = 0.01
[initial]
std = 1.0
""",
    "tank.py": """import jax.numpy as jnp

from covariant.models import StateSpace


def two_levels(outflow=0.5):
    def flow(t, x, u):
        return jnp.stack([u[0] + x[1] - 2.0 * x[0], x[0] - (1.0 + outflow) * x[1]])

    return StateSpace(flow, lambda t, x, u: x[:1], coordinates=("upper", "lower"), units=("m", "m"), inputs=1)
""",
    "cart.urdf": """<robot name="cart">
<link name="rail"/>
<link name="cart"><inertial><mass value="1.0"/>
<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
<link name="pole"><inertial><origin xyz="0 0 -0.2"/><mass value="0.3"/>
<inertia ixx="0.004" ixy="0" ixz="0" iyy="0.004" iyz="0" izz="0.0001"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="rail"/><child link="cart"/><axis xyz="1 0 0"/>
<limit lower="-5" upper="5" effort="50" velocity="10"/></joint>
<joint name="swing" type="continuous"><parent link="cart"/><child link="pole"/><axis xyz="0 1 0"/></joint>
</robot>
""",
}

Table = dict[str, np.ndarray]


class Motion(NamedTuple):
    """A simulated log: its columns, the names of its stamps, measurements and inputs."""

    columns: Table
    t: str
    measured: tuple[str, ...]
    inputs: tuple[str, ...]

    def without(self, name: str) -> Table:
        return {key: column for key, column in self.columns.items() if key != name}

    def change(self, names: Iterable[str], change) -> Table:
        return self.columns | {name: change(self.columns[name]) for name in names}

    def rows(self, stop: int, start: int = 0) -> Table:
        return {name: column[start:stop] for name, column in self.columns.items()}


@lru_cache(None)
def simulated(machine: str, noise: float = 0.0, inputs: bool = True) -> Motion:
    """A log of a machine, in the folder of the machines, without its true states."""
    motion = MACHINES[machine].motion
    if not inputs:
        motion = {"q0": motion.get("q0"), "v0": motion.get("v0")}
    result = covariant.simulate(machine, duration=(ROWS - 1) / RATE, rate=RATE, noise=noise, **motion)
    columns = {name: column for name, column in result.columns.items() if not name.startswith("true_")}
    layout = result.layout
    return Motion(columns, layout.t, tuple(n for n in columns if n not in (layout.t, *layout.u)), layout.u)


def stand_still(machine: str) -> Table:
    log = simulated(machine)
    still = log.change(log.measured, lambda column: np.full_like(column, column[0]))
    return still | {name: np.zeros(ROWS) for name in log.inputs}


LOGS = {
    "clean": lambda m: simulated(m).columns,
    "noisy": lambda m: simulated(m, 1e-3).columns,
    "ticks": lambda m: simulated(m).change(simulated(m).measured, lambda column: np.round(column / 1e-3) * 1e-3),
    "zero inputs": lambda m: simulated(m, 1e-3, inputs=False).columns,
    "constant inputs": lambda m: simulated(m, 1e-3).change(simulated(m).inputs, lambda column: 0 * column + 0.3),
    "nothing moves": stand_still,
    "2 rows": lambda m: simulated(m, 1e-3).rows(2),
    "20 rows": lambda m: simulated(m, 1e-3).rows(20),
    "four short files": lambda m: [simulated(m, 1e-3).rows(120 * (k + 1) + 1, 120 * k) for k in range(FILES)],
    "a column of NaN": lambda m: simulated(m, 1e-3).change(simulated(m).measured[:1], lambda column: np.nan * column),
    "a column missing": lambda m: {
        k: c for k, c in simulated(m, 1e-3).columns.items() if k != simulated(m).measured[0]
    },
    "stamps stand still": lambda m: simulated(m, 1e-3).change(
        [simulated(m).t], lambda column: np.minimum(column, column[300])
    ),
}
"""All logs by name, as functions of the machine."""

FORCES = ("--set", "uncertainty.external_force_std=0.3", "--set", "uncertainty.external_force_time=0.3")
FROM_LOGS = {
    "init": ("init", "{log}", "-o", "out/draft.toml"),
    "check": ("check", "{machine}", "{log}"),
    "estimate": ("estimate", "{machine}", "{log}", "-o", "out/v.csv"),
    "kalman": ("estimate", "{machine}", "{log}", "-o", "out/k.csv", "--observer", "intrinsic-kalman"),
    "forces": ("estimate", "{machine}", "{log}", "-o", "out/f.csv", "--observer", "intrinsic-kalman", *FORCES),
    "smooth": ("smooth", "{machine}", "{log}", "-o", "out/s.csv"),
    "compare": ("compare", "{machine}", "{log}"),
    "fit": ("fit", "{machine}", "{log}", "--parameters", "{parameters}", "-o", "out/fitted.toml"),
    "tune": ("tune", "{machine}", "{log}", "-o", "out/tuned.toml"),
}
OVER_LOGS = ("check", "estimate", "smooth")
"""Commands that go over many logs, each by itself, with a folder for what they write."""
PROOF = ("--alpha", "10", "--beta", "50", "--velocity", "1", "--error", "0.05", "--rate", "2")
WITHOUT_LOGS = {
    "simulate": ("simulate", "{machine}", "-o", "out/log.csv", "--duration", "2"),
    "push": ("simulate", "{machine}", "-o", "out/pushed.csv", "--duration", "2", "--push", "{push}"),
    "model": ("model", "{machine}"),
    "export": ("export", "{machine}", "--rate", "500", "--real", "float", "-o", "out/arm"),
    "python": ("export", "{machine}", "--rate", "500", "--python", "-o", "out/module"),
    "ros2": ("export", "{machine}", "--rate", "500", "--ros2", "-o", "out/ros"),
    "fmu": ("export", "{machine}", "--rate", "500", "-o", "out/arm.fmu"),
    "design": ("design", "excitation", "{machine}", "--parameters", "{parameters}", "-o", "out/e.csv"),
    "certify": ("certify", "{machine}", *PROOF),
    "metric": ("design", "metric", "{machine}", "--grid", "3", "--rate", "8", "-o", "out/P.zarr"),
}
"""The verbs of the page of all commands, by name, with what stands for machine, logs and numbers of the machine."""
NO_LOG = "no log"
SLOW, QUICK = ("compare", "tune"), ("multiarm_single.toml", "tank:two_levels")
"""Verbs that run many observers, and machines on which these take seconds."""
FILTERS, LARGE = (
    ("kalman", "forces", "smooth"),
    ("so101.toml", "xl330.toml", "underwater_vehicle.toml", "heavy_top.toml", "arm.urdf", "cart.toml"),
)
"""Verbs that carry covariances, and machines on which their programs take most of a minute to compile."""


def covering_machines(verb: str) -> list[str]:
    """The machines that a verb meets in the long suite."""
    left_out = LARGE if verb in FILTERS else ()
    return [*QUICK] if verb in SLOW else [machine for machine in MACHINES if machine not in left_out]


def every_case() -> list[tuple[str, str, str]]:
    """The whole product of verb, machine and log; verbs without logs have one log each."""
    with_logs = list(itertools.product(FROM_LOGS, MACHINES, LOGS))
    return with_logs + [(verb, machine, NO_LOG) for verb in WITHOUT_LOGS for machine in MACHINES]


def cover(verbs: Iterable[str], logs: Sequence[str], machines: Callable[[str], Sequence[str]]) -> list[tuple[str, ...]]:
    """Cases in which each verb meets each log, always the same, each with the machine that then meets most.

    Each machine counts the pairs with this verb and this log that no case before has; of equal ones, the one that was
    taken least is taken. All pairs of three kinds would need as many cases as there are machines and logs.
    """
    met: Counter[tuple[str, str]] = Counter()
    cases = []
    for log, verb in itertools.product(logs, verbs):
        machine = min(machines(verb), key=lambda m: (bool(met[verb, m]) + bool(met[m, log]), met[m, ""]))
        met.update([(verb, machine), (machine, log), (machine, "")])
        cases.append((verb, machine, log))
    return cases


def few_cases() -> list[tuple[str, ...]]:
    """Cases that together take minutes: each verb with each log, or with two machines where it reads no log."""
    return [
        *cover(FROM_LOGS, [*LOGS], covering_machines),
        *((verb, machine, NO_LOG) for verb, machine, _ in cover(WITHOUT_LOGS, "ab", lambda _: [*MACHINES])),
    ]


def write_machines(folder: Path) -> None:
    """Write the machines into a folder."""
    for path in [*EXAMPLES.glob("*.toml"), *EXAMPLES.glob("*.urdf")]:
        shutil.copy(path, folder)
    for name, text in WRITTEN.items():
        (folder / name).write_text(text)
    shutil.copy(models.robots.located("double_pendulum"), folder / "arm.urdf")


def write_logs(machine: str, log: str) -> list[str]:
    """Write a log into the working folder; return the names of its files."""
    tables = LOGS[log](machine)
    files = {f"log{k}.csv": each for k, each in enumerate(tables)} if isinstance(tables, list) else {"log.csv": tables}
    for name, table in files.items():
        logs.write(Path(name), table)
    return list(files)


class Ended(NamedTuple):
    """How a command ended: its exit code, what it printed last, and what is wrong with that, "" if nothing is."""

    code: int
    message: str
    fault: str


def run_case(verb: str, machine: str, log: str) -> Ended:
    """Run a command in the working folder, where the machines are."""
    shutil.rmtree("out", ignore_errors=True)
    Path("out").mkdir()
    words = {"{log}": write_logs(machine, log) if log != NO_LOG else [], "{machine}": [machine]}
    words["{parameters}"] = [MACHINES[machine].parameters]
    words["{push}"] = [",".join(["0.1"] * models.load(machine).dimension)] if verb == "push" else []
    command = [each for word in (FROM_LOGS | WITHOUT_LOGS)[verb] for each in words.get(word, [word])]
    if log != NO_LOG and verb != "init":
        command += [word for number in MACHINES[machine].numbers for word in ("--set", number)]
    if len(words["{log}"]) > 1 and command[0] in OVER_LOGS:  # in this process, where warnings are errors
        command = [word.removesuffix(".csv") if word.startswith("out/") else word for word in command]
        command += ["--workers", "1"]
    code, out, error = leave(*command)
    empty = [str(path) for path in Path("out").rglob("*") if path.is_file() and not path.stat().st_size]
    # ROS 2 asks for these two files, which are empty in every package.
    empty = [path for path in empty if not path.endswith("__init__.py") and "/resource/" not in path]
    faults = {
        f"exit code {code}": code not in (0, 1, 2),
        "a refusal of several lines": code == 2 and "Usage:" not in error and "\n" in error.strip(),
        "a warning": "Warning:" in error,
        f"empty files: {', '.join(empty)}": bool(empty),
        "neither a result nor a reason": not (out + error).strip(),
    }
    fault = "; ".join(fault for fault, holds in faults.items() if holds)
    return Ended(code, (error or out).strip(), fault and f"{fault}\n{error or out}")
