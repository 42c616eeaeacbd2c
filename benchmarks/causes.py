"""What `covariant check` and `covariant fit` say of simulated machines whose logs have faults: docs/check.md.

Each machine is one of the systems of `information.py`, with first values that are off by factors of up to 1.7, 3 or 10,
and with no fault in its log or up to three. Its user runs init, check, does what the first finding says, checks again
until nothing is wrong, fits, and checks once more. A fault is named if the first finding, the refusal of the file or
the refusal of the fit names it while it is in the log. Every third machine has no fault.

    python benchmarks/causes.py --machines 100 --out build/causes.jsonl

prints a table of the results in the file, and computes those that are missing. Results are one JSON object a line.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from information import SUBSTEPS, programs
from information_systems import System, systems
from scipy.spatial.transform import Rotation

import covariant
from covariant import logs
from covariant.signals import Record

OFF = 1.7, 3.0, 10.0
"""Factors by which first values are off at most."""
BEYOND = 4.0
"""Standard errors beyond which a number is wrong."""
TURNS = 6
"""How often a user checks a log again."""
GROUPS = "top", "vehicle"


class Fault(NamedTuple):
    """A fault: its kind, the words of which one names it, and how it comes into a log.

    Attributes:
        kind: "input", "register" or "rows".
        words: Names of findings, or words of a refusal.
        spoil: The record with the fault, from the right one, the system and random numbers.
        act: What acts where inputs (T, m) are logged; as logged where None.
    """

    kind: str
    words: tuple[str, ...]
    spoil: Callable[[Record, System, np.random.Generator], Record] = lambda record, system, random: record
    act: Callable[[np.ndarray], np.ndarray] | None = None


def sizes(record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations of inputs (m,) and positions (n,)."""
    return np.std(record.u, axis=0), np.std(record.y, axis=0)


def offset(record, system, random):
    return record._replace(u=record.u + 0.6 * sizes(record)[0])


def late(record, system, random):
    rows = int(random.integers(2, 6))
    return record._replace(u=np.concatenate([np.repeat(record.u[:1], rows, axis=0), record.u[:-rows]]))


def sign_bit(record, system, random):
    counts = np.round(record.u / np.abs(record.u).max(axis=0) * 900)
    return record._replace(u=np.abs(counts) + 1024 * (counts < 0))


def shifted(record, system, random):
    y, rows = record.y.copy(), int(random.integers(2, 4))
    y[rows:, -1] = record.y[:-rows, -1]
    return record._replace(y=y)


def moved_zero(record, system, random):
    y, row = record.y.copy(), int(random.uniform(0.3, 0.7) * len(record.t))
    y[row:, 0] += 0.5 * sizes(record)[1][0]
    return record._replace(y=y)


def interpolated(record, system, random):
    known = record.t[::4]
    columns = [np.interp(record.t, known, column[::4]) for column in record.y.T]
    rows = len(record.t) // 4 * 4 - 3
    return Record(*(each[:rows] for each in (record.t, record.u, np.stack(columns, axis=1))))


def early(record, system, random):
    t, step = record.t.copy(), record.t[1]
    rows = random.choice(np.arange(5, len(t) - 5), size=max(3, len(t) // 200), replace=False)
    t[rows] -= 40.5 * step
    return record._replace(t=t)


def bursts(record, system, random):
    y = record.y.copy()
    for begin in random.choice(np.arange(1, 10), size=3, replace=False) * len(y) // 11:
        rows = slice(begin, begin + int(random.integers(8, 30)))
        y[rows, 0] += random.normal(0, 2 * sizes(record)[1][0], len(y[rows]))
    return record._replace(y=y)


def frozen(record, system, random):
    y, rows = record.y.copy(), len(record.y) // 10
    moves = np.abs(y[rows:] - y[:-rows]).reshape(len(y) - rows, -1).max(axis=1)
    begin = int(np.argmax(moves[1:])) + 1
    y[begin : begin + rows] = y[begin]
    return record._replace(y=y)


def degrees(record, system, random):
    servo = "servo" in system.model  # its commands are positions
    return record._replace(y=np.rad2deg(record.y), u=np.rad2deg(record.u) if servo else record.u)


def limited(u):
    return np.clip(u, -np.std(u, axis=0), np.std(u, axis=0))


def beyond_a_band(u):
    return u - np.clip(u, -0.5 * np.std(u, axis=0), 0.5 * np.std(u, axis=0))


FAULTS = {
    "input in thousandths": Fault("input", ("unit of an input",), lambda r, s, g: r._replace(u=1e3 * r.u)),
    "input reversed": Fault("input", ("sign of an input", "sign of a position"), lambda r, s, g: r._replace(u=-r.u)),
    "input with an offset": Fault("input", ("offset of an input", "offset and limit"), offset),
    "input that is limited": Fault(
        "input",
        ("limit of an input", "offset and limit"),
        act=lambda u: np.clip(u, *(np.std(u, 0) * [[-1], [1]])),
    ),
    "input with a dead band": Fault("input", ("dead band",), act=beyond_a_band),
    "input late": Fault("input", ("delay against the inputs", "inputs between rows"), late),
    "input with a sign bit": Fault("input", ("highest bit is a sign",), sign_bit),
    "degrees": Fault("register", ("unit of positions", "unit of a command"), degrees),
    "milliseconds": Fault("register", ("unit of time",), lambda r, s, g: r._replace(t=1e3 * r.t)),
    "rows stamped early": Fault("register", ("clock of single rows",), early),
    "interpolated": Fault("register", ("interpolated rows",), interpolated),
    "position late": Fault("register", ("row shift", "delay"), shifted),
    "zero that moves": Fault("register", ("zero of a position", "zero of a servo"), moved_zero),
    "bursts": Fault("rows", ("outliers",), bursts),
    "frozen": Fault("rows", ("repeated rows",), frozen),
}
COMMANDS = "degrees", "bursts", "frozen", "milliseconds", "rows stamped early", "interpolated", "zero that moves"
"""Faults of machines with servos, whose inputs are commands."""
ON_GROUPS = "rows stamped early", "frozen"
ALL_ANGLES = "pendulum", "double pendulum", "furuta", "urdf arm", "servo arm"
"""Systems whose positions are angles, so that all may be in degrees."""


def possible(name: str, system: System, fault: str) -> bool:
    """Whether a log of a system can have a fault."""
    if name in GROUPS:
        return fault in ON_GROUPS
    if name == "servo arm":
        return fault in COMMANDS
    if system.feedback is not None and FAULTS[fault].act is not None:
        return False  # what acts is fed back
    return (fault != "degrees" or name in ALL_ANGLES) and (fault != "position late" or len(system.noise) > 1)


class Machine(NamedTuple):
    """A machine: its system, first values (p,), the faults of its log, and the log by the faults that it still has."""

    system: System
    first: np.ndarray
    faults: tuple[str, ...]
    log: Callable[[tuple[str, ...]], Record]


def write(folder: Path, machine: "Machine", record: Record) -> tuple[Path, dict[str, Any]]:
    """Write a log as CSV; returns its path, and the columns of positions and inputs by field."""
    n = len(machine.system.noise)
    path, names = folder / "log.csv", [f"q{i + 1}" for i in range(n)]
    columns: dict[str, np.ndarray] = {"t": record.t}
    if record.y.ndim == 2:
        fields: dict[str, Any] = {"q": names}
        columns |= dict(zip(names, record.y.T, strict=True))
    else:
        fields = dict(machine.system.model["columns"])
        if "position" in fields:
            columns |= dict(zip(fields["position"], record.y[:, :3, 3].T, strict=True))
        quaternions = Rotation.from_matrix(record.y[:, :3, :3]).as_quat(scalar_first=True)
        columns |= dict(zip(fields["quaternion_wxyz"], quaternions.T, strict=True))
    inputs = [f"u{j + 1}" for j in range(record.u.shape[1])]
    logs.write(path, columns | dict(zip(inputs, record.u.T, strict=True)))
    return path, fields | {"u": inputs}


def machine(known: dict[str, System], number: int) -> tuple[str, Machine]:
    """A machine, the same whatever others there are."""
    random = np.random.default_rng([number, 72])
    mechanical = [name for name in known if name not in ("ship", "state space")]
    name = mechanical[number % len(mechanical)]
    system = known[name]
    names = [fault for fault in FAULTS if possible(name, system, fault)]
    count = 0 if number % 3 == 2 else min(len(names), 1 + number // 3 % 3)
    faults = tuple(random.choice(names, size=count, replace=False).tolist())
    acting = [fault for fault in faults if FAULTS[fault].act is not None]
    faults = tuple(fault for fault in faults if fault not in acting[1:])
    rows = round(random.uniform(*system.seconds) * system.rate)
    middle, half = (np.array(system.first[key], float) for key in ("middle", "half"))
    first, inputs, still = middle + half * random.uniform(-1, 1, len(half)), system.inputs(random), np.zeros(1)
    errors = np.array(system.noise) * random.normal(size=(len(inputs), len(system.noise)))
    noise = np.zeros((len(inputs), SUBSTEPS, len(system.force)))
    seed = int(random.integers(2**31))
    off = float(random.choice(OFF, p=(0.5, 0.25, 0.25)))
    values = system.truth * np.exp(random.uniform(-np.log(off), np.log(off), len(system.truth)))

    def log(faults: tuple[str, ...]) -> Record:
        act = next((FAULTS[fault].act for fault in faults if FAULTS[fault].act is not None), None)
        w = still * np.zeros(len(system.force))
        _, _, u, y = programs(system)[0](first, w, inputs if act is None else act(inputs), noise, errors)
        logged = np.asarray(u) if act is None else inputs
        y = np.asarray(y)[:rows]
        record = Record(np.arange(rows) / system.rate, logged[:rows], y)
        for fault in FAULTS:  # the clock last
            if fault in faults:
                record = FAULTS[fault].spoil(record, system, np.random.default_rng(seed))
        return record

    return name, Machine(system, values, faults, log)


def use(number: int, known: dict[str, System], folder: Path) -> dict[str, Any]:
    """What the user of a machine sees."""
    begin = time.process_time()
    name, made = machine(known, number)
    left, said, named = list(made.faults), [], []
    line: dict[str, Any] = {"machine": number, "system": name, "faults": made.faults}

    def overrides(path_fields: dict[str, Any], values: np.ndarray) -> dict[str, Any]:
        columns = {f"columns.{field}": each for field, each in path_fields.items()}
        return made.system.overrides(values) | columns

    def heard(words: str) -> bool:
        """Whether words name a fault that is left; the user then mends that one."""
        fault = next((each for each in left if any(word in words for word in FAULTS[each].words)), None)
        if fault is not None:
            left.remove(fault)
            named.append(fault)
        return fault is not None

    for _ in range(TURNS):
        path, fields = write(folder, made, made.log(tuple(left)))
        try:
            found = [
                each
                for each in covariant.check(made.system.spec, path, overrides=overrides(fields, made.first)).findings
                if each.wrong
            ]
        except ValueError as error:
            found = []
            said.append(f"refused: {str(error).splitlines()[0]}")
            if heard(str(error)):
                continue
            break
        if not found or found[0].what == "numbers of the model":  # which the fit mends
            break
        said.append(f"{found[0].what} of {found[0].where} -> {found[0].line}")
        if not heard(found[0].what):
            line["other findings"] = [each.what for each in found]
            break
    line |= {"said": said, "named by check": list(named), "left after check": list(left)}
    for _ in range(TURNS):
        path, fields = write(folder, made, made.log(tuple(left)))
        try:
            result = covariant.fit(made.system.spec, path, made.system.numbers, overrides=overrides(fields, made.first))
        except ValueError as error:
            line["fit"] = f"refused: {str(error).splitlines()[0]}"
            if heard(str(error)):
                continue
            break
        order = [list(result.columns["parameter"]).index(each) for each in made.system.numbers]
        values, std = result.values[order], result.standard_errors[order]
        determined = np.isfinite(std) & (np.abs(values) > 3 * std)
        line["fit"] = "written" if result.better else "not written"
        line["z"] = np.where(determined, (values - made.system.truth) / std, 0.0).round(2).tolist()
        line["undetermined"] = int((~determined).sum())
        after = covariant.check(made.system.spec, path, overrides=overrides(fields, values)) if result.better else None
        line["wrong after"] = [each.what for each in after.findings if each.wrong] if after else []
        if not (line["wrong after"] and heard(line["wrong after"][0])):
            break
    line |= {"named": named, "left": left, "seconds": round(time.process_time() - begin, 1)}
    return line


def table(lines: list[dict[str, Any]]) -> None:
    """Print the results by kind of fault."""
    print("| log has | machines | faults | named | named by `check` | wrong number written | not written | CPU s |")
    print("|---|--:|--:|--:|--:|--:|--:|--:|")
    groups: dict[str, list[dict[str, Any]]] = {"no fault": []}
    for line in lines:
        kinds = {FAULTS[fault].kind for fault in line["faults"]}
        count = len(line["faults"])
        group = "no fault" if not count else "several faults" if count > 1 else f"one fault: {kinds.pop()}"
        groups.setdefault(group, []).append(line)
    for group, those in sorted(groups.items()):
        faults = sum(len(line["faults"]) for line in those)
        named, checked = (sum(len(line[key]) for line in those) for key in ("named", "named by check"))
        wrong = sum(is_wrong(line) for line in those)
        unwritten = sum(line["fit"] != "written" for line in those)
        seconds = np.median([line["seconds"] for line in those]) if those else 0.0
        print(f"| {group} | {len(those)} | {faults} | {named} | {checked} | {wrong} | {unwritten} | {seconds:.0f} |")
    alarms = [line["machine"] for line in lines if not line["faults"] and line["said"]]
    print(f"without a fault and called wrong: {alarms}")
    print(f"faults not named: {[(line['machine'], line['left']) for line in lines if line['left']]}")
    other = [line["machine"] for line in lines if line["faults"] and "other findings" in line]
    print(f"first finding is no fault of the log: {other}")
    print(f"wrong numbers written: {[line['machine'] for line in lines if is_wrong(line)]}")


def is_wrong(line: dict[str, Any]) -> bool:
    """Whether a number is written as determined that is not right."""
    return line["fit"] == "written" and bool(np.abs(line["z"]).max() > BEYOND)


def main() -> None:
    """Compute results that are missing in a file, and print its table."""
    parser = argparse.ArgumentParser(description="what check and fit say of logs with faults")
    parser.add_argument("--machines", default="100", help="how many, or their numbers by commas")
    parser.add_argument("--out", type=Path, default=Path("build/causes.jsonl"))
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    numbers = [int(each) for each in options.machines.split(",")]
    numbers = list(range(numbers[0])) if len(numbers) == 1 else numbers
    lines = list(map(json.loads, options.out.read_text().splitlines())) if options.out.exists() else []
    with tempfile.TemporaryDirectory() as folder:
        known = systems(Path(folder))
        for number in sorted(set(numbers) - {line["machine"] for line in lines}):
            lines.append(use(number, known, Path(folder)))
            with options.out.open("a") as file:
                file.write(json.dumps(lines[-1]) + "\n")
            print(json.dumps(lines[-1]), file=sys.stderr, flush=True)
    table([line for line in lines if line["machine"] in numbers])


if __name__ == "__main__":
    main()
