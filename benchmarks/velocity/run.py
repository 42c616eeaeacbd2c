"""Runs the estimators of the benchmark on a log; what was computed before is read again, unless something changed."""

import functools
import hashlib
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

import covariant
from benchmarks.velocity.cases import Case, case, entries
from benchmarks.velocity.estimators import AbstractEstimator, Estimate, Numbers, estimators
from benchmarks.velocity.scores import ratio, scores
from benchmarks.velocity.search import searched

ROOT = Path(__file__).parents[2]
OUT = Path("build/velocity")


@functools.cache
def code_key() -> str:
    """Checksum of the library and of this benchmark."""
    parts = [Path(covariant.__file__).parents[1], ROOT / "benchmarks" / "velocity", ROOT / "benchmarks" / "twins.py"]
    files = [path for part in parts for path in ([part] if part.is_file() else sorted(part.rglob("*.py")))]
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


def judge(name: str) -> dict[str, Any] | None:
    """Scores of all estimators that fit a log; None if its recording is not there."""
    entry, folder = entries()[name], OUT / name.replace(" ", "-").replace(",", "")
    log = case(entry)
    if log is None:
        return None
    folder.mkdir(parents=True, exist_ok=True)
    rows: dict[str, dict[str, Any]] = {}
    found: dict[str, Estimate] = {}
    for estimator in estimators().values():
        if estimator.fits(log):
            rows[estimator.name], found[estimator.name] = _kept(estimator, log, folder, rows)
    for each, row in rows.items():
        row["ratio"] = ratio(log, found["covariant"].v, found[each].v)
    size = np.sqrt(np.nanmean(log.v[log.judge] ** 2, axis=0))
    return {
        "log": name,
        "recorded": log.recorded,
        "against": log.against,
        "rate": log.loaded.rate,
        "rows": int(log.judge.sum()),
        "rms_velocity": size.tolist(),
        "second_delay": log.second and log.second.delay,
        "cause": entry.get("cause", ""),
        "estimators": rows,
    }


def _operations(estimator: AbstractEstimator, log: Case, numbers: Numbers) -> int | None:
    """Operations of a step in C; None for a step whose work is not fixed."""
    try:
        return estimator.operations(log, numbers)
    except ValueError:
        return None


def _kept(estimator: AbstractEstimator, log: Case, folder: Path, rows: dict) -> tuple[dict[str, Any], Estimate]:
    """Scores and velocities of an estimator, from an earlier run if nothing changed since."""
    path, key = folder / f"{estimator.name}.npz", f"{code_key()} {log.key}"
    if path.is_file():
        with np.load(path) as stored:
            if str(stored["key"]) == key:
                return json.loads(str(stored["row"])), Estimate(stored["v"], stored.get("std"))
    began = time.perf_counter()
    row: dict[str, Any] = {"knows_model": estimator.knows_model}
    try:
        borrowed = rows.get(estimator.numbers_of, {}).get("numbers")
        numbers = searched(estimator, log) if borrowed is None else borrowed
        (estimate,) = estimator.run(log, [numbers], log.judge)
        length = len(estimate.v)
        missing = np.full((len(log.t) - length, estimate.v.shape[1]), np.nan)
        whole = Estimate(*(each if each is None else np.concatenate([each, missing]) for each in estimate[:2]))
        row |= {"numbers": numbers, "note": estimate.note} | scores(log, whole.v, whole.std)
        row["operations"] = _operations(estimator, log, numbers)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        row |= {"error": np.inf, "note": f"failed: {str(error).splitlines()[0]}"}
        whole = Estimate(np.full(log.v.shape, np.nan))
    print(f"{log.name}: {estimator.name} {row['error']:.4g} in {time.perf_counter() - began:.0f} s", flush=True)
    stored = {"key": key, "row": json.dumps(row), "v": whole.v} | ({} if whole.std is None else {"std": whole.std})
    partial = path.with_suffix(".part.npz")  # a run that is stopped leaves no half of a file
    np.savez_compressed(partial, **stored)
    partial.replace(path)
    return row, whole
