"""Errors of `covariant.fit` beside the Cramér–Rao bound, on logs of twelve simulated systems: docs/identification.md.

Each log has 2 to 10 s (the ship 2 to 10 min), random inputs and a random first state, with white noise in its outputs,
without and with an unknown Gauss–Markov force. The fit starts from numbers that are off by factors of 0.6 to 1.7. The
bound is for a free first state; with a force it is the information of the linear filter that knows the noise levels,
along the true motion. Runge–Kutta steps in the state (the matrix, for a system on a group) make the logs and the bound,
independently of the library's integrators.

    python benchmarks/information.py --systems pendulum,top --logs 4 --force without --out build/information.jsonl

prints a table of the results in the file, and computes those that are missing. Results are one JSON object a line.
"""

import argparse
import json
import sys
import tempfile
import time
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from information_systems import Case, cases

import covariant
from covariant import models
from covariant.signals import Record

SUBSTEPS = 4
"""Runge–Kutta steps in a row."""
RUNGE_KUTTA = np.array([[0, 1 / 6], [1 / 2, 1 / 3], [1 / 2, 1 / 3], [1, 1 / 6]])
"""Of each stage of the classical method: place on the slope before, and weight."""
PRIOR = 1e2
"""Standard deviation of each first state for the filter, in its unit: much larger than the states."""
OFF = 0.6, 1.7
"""Factors by which first values are off."""


class Batch(NamedTuple):
    """Simulated logs: states and forces (B, T, …), inputs (B, T, m), noise of the force (B, T, S, d), outputs, lengths
    (B,) in rows, and random generators for what follows."""

    x: Any
    w: jax.Array
    u: jax.Array
    noise: jax.Array
    y: jax.Array
    rows: np.ndarray
    randoms: list[np.random.Generator]


def is_mechanical(model) -> bool:
    return not isinstance(model, models.StateSpace)


def origin(model):
    """The state from which first states are displaced: (q, v), or x."""
    if not is_mechanical(model):
        return jnp.zeros(len(model.coordinates))
    q = model.manifold.origin()
    return q, jnp.zeros_like(model.manifold.zero(q))


def displace(model, x, d):
    """The state x moved by d (N,) in local coordinates."""
    if not is_mechanical(model):
        return x + d
    n = len(d) // 2
    return model.manifold.retract(x[0], d[:n]), x[1] + d[n:]


def difference(model, start, end):
    """The displacement (N,) between two states."""
    if not is_mechanical(model):
        return end - start
    return jnp.concatenate([model.manifold.towards(start[0], end[0]), end[1] - start[1]])


def rate(model, x, u, force):
    """Time derivative of the state under an unknown force."""
    if not is_mechanical(model):
        return model.f(0.0, x, u + force)
    q, v = x
    covector = models.applied_force(model, 0.0, q, u) + models.resistance(model, 0.0, q, v, u) + force
    return (v if model.manifold.commuting else q @ model.manifold.hat(v)), model.space.acceleration(q, v, covector)


def step(case: Case, model, x, w, u, noise):
    """State and force, in units of its RMS, after a row; the noise (S, d) changes the force between substeps."""
    h = 1 / case.rate / SUBSTEPS
    stays = np.exp(-h / case.correlation)

    def substep(now, noise):
        x, w = now

        def stage(stages, factors):
            slope, total = stages
            place = jax.tree.map(lambda a, b: a + factors[0] * h * b, x, slope)
            slope = rate(model, place, u, w * np.array(case.force))
            return (slope, jax.tree.map(lambda a, b: a + factors[1] * h * b, total, slope)), None

        end = jax.lax.scan(stage, (jax.tree.map(jnp.zeros_like, x), x), RUNGE_KUTTA)[0][1]
        return (end, stays * w + np.sqrt(1 - stays**2) * noise), None

    return jax.lax.scan(substep, (x, w), noise)[0]


def output(model, x, u):
    return x[0] if is_mechanical(model) else model.h(0.0, x, u)


def simulate(name: str, case: Case, with_force: bool, logs: list[int]) -> Batch:
    """Logs of a system with these numbers; a log does not depend on the others."""
    model = case.model()(jnp.asarray(case.truth))
    randoms = [np.random.default_rng([zlib.crc32(name.encode()), with_force, log]) for log in logs]
    t = np.arange(round(case.seconds[1] * case.rate)) / case.rate
    rows = np.array([round(random.uniform(*case.seconds) * case.rate) for random in randoms])
    first = jnp.array([case.centre + np.array(case.spread) * r.uniform(-1, 1, len(case.centre)) for r in randoms])
    inputs = jnp.array([case.inputs(random, t) for random in randoms])
    size = len(case.force)
    w0 = jnp.array([with_force * random.normal(size=size) for random in randoms])
    noise = jnp.array([with_force * random.normal(size=(len(t), SUBSTEPS, size)) for random in randoms])
    errors = jnp.array([np.array(case.std) * random.normal(size=(len(t), len(case.std))) for random in randoms])
    gains = np.zeros((inputs.shape[2], len(case.centre))) if case.feedback is None else np.array(case.feedback)
    zero = origin(model)

    def log(first, inputs, w0, noise, errors):
        def row(now, given):
            u = given[0] - gains @ difference(model, zero, now[0]) if case.feedback is not None else given[0]
            return step(case, model, *now, u, given[1]), (*now, u)

        x, w, u = jax.lax.scan(row, (displace(model, zero, first), w0), (inputs, noise))[1]
        return x, w, u, jax.vmap(lambda x, u, e: model.manifold.retract(output(model, x, u), e))(x, u, errors)

    x, w, u, y = jax.jit(jax.vmap(log))(first, inputs, w0, noise, errors)
    return Batch(x, w, u, noise, y, rows, randoms)


def linearise(case: Case, batch: Batch) -> tuple[np.ndarray, np.ndarray]:
    """Jacobians along the true motions, by state (N), force (d), noise of the force (S d) and numbers (p): of the next
    state and force (B, T, N + d, …), and of the output (B, T, m, …)."""
    make, truth = case.model(), jnp.asarray(case.truth)
    n, d = len(case.centre), len(case.force)
    cuts = [n, n + d, n + d + SUBSTEPS * d]

    def row(x, w, u, noise):
        true = make(truth)
        next_x, next_w = step(case, true, x, w, u, noise)

        def moved(z):
            change, of_force, of_noise, numbers = jnp.split(z, cuts)
            model, start = make(truth + numbers), displace(true, x, change)
            end, force = step(case, model, start, w + of_force, u, noise + of_noise.reshape(noise.shape))
            error = true.manifold.towards(output(true, x, u), output(model, start, u))
            return jnp.concatenate([difference(true, next_x, end), force - next_w]), error

        return jax.jacfwd(moved)(jnp.zeros(cuts[-1] + len(truth)))

    rows = jax.jit(jax.vmap(row))
    logs = [rows(*jax.tree.map(lambda part, k=k: part[k], batch[:4])) for k in range(len(batch.rows))]
    return tuple(np.stack([np.asarray(log[i]) for log in logs]) for i in range(2))  # type: ignore[return-value]


def bounds(case: Case, batch: Batch, with_force: bool) -> np.ndarray:
    """Cramér–Rao bounds (B, p) of the standard errors of the numbers."""
    next_state, outputs = linearise(case, batch)
    n, d, p = len(case.centre), len(case.force), len(case.numbers)
    live = np.arange(outputs.shape[1]) < batch.rows[:, None]
    r = np.diag(np.square(case.std))
    information = (_of_filter if with_force else _of_trajectory)(next_state, outputs, live, r, n, d, p)
    scale = np.sqrt(np.diagonal(information, axis1=1, axis2=2))  # numbers and states have different units
    covariance = np.linalg.inv(information / scale[:, :, None] / scale[:, None, :])
    return (np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)) / scale)[:, :p]


def _of_trajectory(next_state, outputs, live, r, n, d, p) -> np.ndarray:
    """Information (B, p + n, p + n) of outputs with white noise on the numbers and the first state."""
    batch, (a, h) = len(live), (next_state[:, :, :n, :n], outputs[..., :n])
    inverse = np.linalg.inv(r)
    s = np.concatenate([np.zeros((batch, n, p)), np.broadcast_to(np.eye(n), (batch, n, n))], axis=2)
    information = np.zeros((batch, p + n, p + n))
    for k in range(live.shape[1]):
        j = h[:, k] @ s
        j[:, :, :p] += outputs[:, k, :, -p:]
        information += live[:, k, None, None] * (j.mT @ inverse @ j)
        s = a[:, k] @ s
        s[:, :, :p] += next_state[:, k, :n, -p:]
    return information


def _of_filter(next_state, outputs, live, r, n, d, p) -> np.ndarray:
    """Information (B, p, p) of the innovations of a Kalman filter for state and force, with a diffuse first state."""
    size, batch = n + d, len(live)
    covariance = np.broadcast_to(np.diag([PRIOR**2] * n + [1.0] * d), (batch, size, size))
    s, information = np.zeros((batch, size, p)), np.zeros((batch, p, p))
    for k in range(live.shape[1]):
        a, g, b = np.split(next_state[:, k], [size, next_state.shape[-1] - p], axis=2)
        h = outputs[:, k, :, :size]
        sensitivity = h @ s + outputs[:, k, :, -p:]
        inverse = np.linalg.inv(h @ covariance @ h.mT + r)
        information += live[:, k, None, None] * (sensitivity.mT @ inverse @ sensitivity)
        gain = covariance @ h.mT @ inverse
        rest = np.eye(size) - gain @ h
        covariance = rest @ covariance @ rest.mT + gain @ r @ gain.mT  # Joseph's form stays positive
        s = a @ (s - gain @ sensitivity) + b
        covariance = a @ covariance @ a.mT + g @ g.mT
    return information


def fit(case: Case, record: Record, random: np.random.Generator) -> dict[str, Any]:
    """Errors and standard errors of the fit of a log, or why it is refused."""
    truth = case.truth
    first = truth * np.exp(random.uniform(*np.log(OFF), len(truth)))
    start = time.process_time()
    try:
        result = covariant.fit(case.spec, record, list(case.numbers), overrides=case.overrides(first))
    except ValueError as error:
        return {"refused": str(error).splitlines()[0], "seconds": time.process_time() - start}
    order = [list(result.columns["parameter"]).index(name) for name in case.numbers]
    return {
        "first": first.tolist(),
        "error": (result.values[order] - truth).tolist(),
        "standard_error": result.standard_errors[order].tolist(),
        "written": result.better,
        "seconds": time.process_time() - start,
    }


def compute(name: str, case: Case, force: str, logs: list[int], out: Path) -> None:
    """Add the results of these logs to a file."""
    batch = simulate(name, case, force == "with", logs)
    limits = bounds(case, batch, force == "with")
    for k, log in enumerate(logs):
        rows = slice(int(batch.rows[k]))
        stamps = np.arange(batch.rows[k]) / case.rate
        record = Record(stamps, np.asarray(batch.u[k, rows]), np.asarray(batch.y[k, rows]))
        line = {"system": name, "force": force, "log": log, "rows": int(batch.rows[k]), "bound": limits[k].tolist()}
        line |= fit(case, record, batch.randoms[k])
        with out.open("a") as file:
            file.write(json.dumps(line) + "\n")
        print(f"{name} {force} {log}: {line.get('refused') or np.round(line['error'] / limits[k], 2)}", file=sys.stderr)


def table_row(results: list[dict[str, Any]], numbers: tuple[str, ...]) -> str:
    """A line of the table on the logs of a system."""
    fits = [line for line in results if "error" in line]
    head = f"| {len(results)} | {len(results) - len(fits)} | {sum(not line['written'] for line in fits)} |"
    if not fits:
        return f"{head} – | – | – | – | – | refused: {results[0]['refused']}"
    error, bound, std = (np.array([line[key] for line in fits]) for key in ("error", "bound", "standard_error"))
    ratio, z = np.sqrt(np.mean((error / bound) ** 2, axis=0)), (error / std)[np.isfinite(std)]
    worst = f"{ratio.max():.2f} ({numbers[int(np.argmax(ratio))]})"
    of_z = f"{np.sqrt(np.mean(z**2)):.2f} | {np.mean(np.abs(z) > 3):.1%}" if len(z) else "– | –"
    return f"{head} {np.median(ratio):.2f} | {worst} | {of_z} | {np.median([line['seconds'] for line in fits]):.1f} |"


def main() -> None:
    """Compute results that are missing in a file, and print its table."""
    parser = argparse.ArgumentParser(description="errors of covariant.fit beside the Cramér–Rao bound")
    parser.add_argument("--systems", default="", help="names by commas; all by default")
    parser.add_argument("--logs", type=int, default=40)
    parser.add_argument("--force", choices=("without", "with", "both"), default="both")
    parser.add_argument("--out", type=Path, default=Path("build/information.jsonl"))
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        known = cases(Path(folder))
        chosen = [name.strip() for name in options.systems.split(",")] if options.systems else list(known)
        kinds = ("without", "with") if options.force == "both" else (options.force,)
        pairs = [(name, force) for name in chosen for force in kinds]
        results: dict[tuple[str, str], dict[int, Any]] = {pair: {} for pair in pairs}
        for name, force in pairs:
            read(options.out, results)
            if missing := [log for log in range(options.logs) if log not in results[name, force]]:
                compute(name, known[name], force, missing, options.out)
        read(options.out, results)
    print("| system | force | logs | refused | not written | error/bound | worst | z | beyond 3 | CPU s |")
    print("|---|---|--:|--:|--:|--:|--:|--:|--:|--:|")
    for name, force in pairs:
        print(f"| {name} | {force} {table_row(list(results[name, force].values()), known[name].numbers)}")


def read(path: Path, results: dict[tuple[str, str], dict[int, Any]]) -> None:
    """Read the results in a file of these systems."""
    for line in map(json.loads, path.read_text().splitlines() if path.exists() else []):
        if (pair := (line["system"], line["force"])) in results:
            results[pair][line["log"]] = line


if __name__ == "__main__":
    main()
