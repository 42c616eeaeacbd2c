"""What `covariant tune` makes of a wrong model: prints the table of docs/tuning.md.

Run `COVARIANT_DATA=... python benchmarks/tuning.py` from the repository's root. How near the tuned default comes to the
best of all estimators with a right model, `make velbench` says.
"""

import os
import tomllib
from pathlib import Path

import numpy as np

from covariant.calibration import tune
from covariant.verbs.base.aligned import aligned
from covariant.verbs.base.inputs import Job, data_sheet
from covariant.verbs.base.tune_to_logs import confirm, warning

DATA = Path(os.environ["COVARIANT_DATA"])
DOUBLE = ("multiarm_double", ["multiarm_pendulum/double.csv"], 20.0)
DFKI = ("dfki_double_pendulum", [f"dfki_double_pendulum/A0_sysid_{k}.csv" for k in ("00", "05", "12")], None)
CASES = [(*DOUBLE, every) for every in (50, 20, 10, 5)] + [(*DFKI, every) for every in (10, 5)]
COLUMNS = dict.fromkeys(("t", "q", "u", "v", "truth"))


def too_large(spec: str, factor: float) -> tuple[str, ...]:
    """Overrides that make the metric of a pendulum too large, and leave its torques of gravity as they are."""
    given = tomllib.loads(Path(spec).read_text())["parameters"]
    scaled = {key: [factor * x for x in given[key]] for key in ("mass", "inertia", "rotor_inertia") if key in given}
    scaled["gravity"] = given["gravity"] / factor
    return tuple(f"parameters.{key}={value}" for key, value in scaled.items())


def case(name: str, logs: list[str], until: float | None, every: int, factor: float) -> None:
    spec = f"examples/{name}.toml"
    loaded = [
        aligned(Job(spec, DATA / log, too_large(spec, factor), every, until, COLUMNS, True)).loaded for log in logs
    ]
    one, n = loaded[0], loaded[0].file.dimension
    known = None if one.file.quantum is None else np.full(n, one.file.typical_std)
    records, velocities = [each.record for each in loaded], [each.reference.v for each in loaded]
    before = data_sheet(one.file)
    found = tune(one.model, records, velocities, std=known, before=before)
    judged = confirm(loaded, found)
    free = judged.beside.verdict.other
    parts = found.after.relative / free
    words = f"{free:.4f} ({judged.beside.filter}) | {parts[0]:.2f} | {parts[1]:.2f} | {warning(judged)}"
    print(f"| {name} | {one.rate:.0f} | {words} |", flush=True)


if __name__ == "__main__":
    print("| log | rate | without a model | tuned gains | tuned Kalman filter | warning |")
    for each in CASES:
        case(*each, 1.3)
