"""How near `covariant tune` comes to the best gains, and what it makes of a wrong model: prints the tables of the page.

Run `COVARIANT_DATA=... python benchmarks/tuning.py` from the repository's root. "Best" are the gains that are found by
searching the held-out rows themselves for the least velocity error, by Nelder & Mead from four starts.
"""

import os
import tomllib
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from covariant.calibration import observer_gains, tune
from covariant.calibration.tuning._filters import relative_error
from covariant.observers import Intrinsic, run
from covariant.scoring import scored_window
from covariant.verbs.base.aligned import aligned
from covariant.verbs.base.inputs import Job, data_sheet
from covariant.verbs.base.tune_to_logs import confirm, warning

DATA = Path(os.environ["COVARIANT_DATA"])
DOUBLE = ("multiarm_double", ["multiarm_pendulum/double.csv"], 20.0)
DFKI = ("dfki_double_pendulum", [f"dfki_double_pendulum/A0_sysid_{k}.csv" for k in ("00", "05", "12")], None)
CASES = [(*DOUBLE, every) for every in (50, 20, 10, 5, 1)] + [(*DFKI, every) for every in (10, 5, 1)]
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
    free, after = judged.beside.verdict.other, found.after.relative
    if factor != 1:
        parts = after / free
        words = f"{free:.4f} ({judged.beside.filter}) | {parts[0]:.2f} | {parts[1]:.2f} | {warning(judged)}"
        print(f"| {name} | {one.rate:.0f} | {words} |", flush=True)
        return
    masks = [scored_window(r.t) & (r.t >= r.t[0] + 2 / 3 * (r.t[-1] - r.t[0])) for r in records]

    def error(z):
        observer = Intrinsic(one.model, float(2 * np.exp(z[0] + z[1])), float(np.exp(2 * z[0])))
        runs = [np.asarray(run(observer, r, ("result",)).estimate)[m, n:] for r, m in zip(records, masks, strict=True)]
        true = np.concatenate([v[m] for v, m in zip(velocities, masks, strict=True)])
        value = relative_error(np.concatenate(runs), true)
        return value if np.isfinite(value) else 1e6

    rule, tuned = observer_gains(before, one.rate), np.log([found.natural_frequency, found.damping])
    ruled = np.log([rule.beta**0.5, before.damping])
    starts = [tuned, ruled, ruled + np.array([-0.7, 0.4]), ruled + np.array([0.7, 0.4])]
    options = {"xatol": 0.03, "fatol": 1e-6, "maxfev": 40}
    searched = [minimize(error, start, method="Nelder-Mead", options=options) for start in starts]
    best = min(searched, key=lambda each: each.fun)
    was, is_now = error(ruled) / best.fun, error(tuned) / best.fun
    print(f"| {name} | {one.rate:.0f} | {best.fun:.5f} | {np.exp(best.x[0]):.0f}, {np.exp(best.x[1]):.2f} | {was:.3f} |"
          f" {found.natural_frequency:.0f}, {found.damping:.2f} | {is_now:.3f} | {after[1] / best.fun:.3f} |"
          f" {free / best.fun:.1f} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    print("| log | rate | best | its ω, ζ | rule | tuned ω, ζ | tuned | tuned Kalman filter | without a model |")
    for each in CASES:
        case(*each, 1.0)
    print("| log | rate | without a model | tuned gains | tuned Kalman filter | warning |")
    for each in CASES[:4] + CASES[5:7]:
        case(*each, 1.3)
