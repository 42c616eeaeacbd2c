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
import functools
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
from information_systems import System, systems

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


class Log(NamedTuple):
    """A log, the bounds (p,) of standard errors, and the values (p,) from which the fit starts."""

    record: Record
    bound: np.ndarray
    first: np.ndarray


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


def step(system: System, model, x, w, u, noise):
    """State and force, in units of its RMS, after a row; the noise (S, d) changes the force between substeps."""
    h = 1 / system.rate / SUBSTEPS
    stays = np.exp(-h / system.correlation)

    def substep(now, noise):
        x, w = now

        def stage(stages, factors):
            slope, total = stages
            place = jax.tree.map(lambda a, b: a + factors[0] * h * b, x, slope)
            slope = rate(model, place, u, w * np.array(system.force))
            return (slope, jax.tree.map(lambda a, b: a + factors[1] * h * b, total, slope)), None

        end = jax.lax.scan(stage, (jax.tree.map(jnp.zeros_like, x), x), RUNGE_KUTTA)[0][1]
        return (end, stays * w + np.sqrt(1 - stays**2) * noise), None

    return jax.lax.scan(substep, (x, w), noise)[0]


def output(model, x, u):
    return x[0] if is_mechanical(model) else model.h(0.0, x, u)


@functools.cache
def programs(system: System) -> tuple[Any, Any]:
    """Compiled functions of a system.

    The first one gives states, forces, inputs and outputs (T, …) of a log, from its first state and force, inputs
    before feedback, noise of the force (T, S, d) and errors of the outputs. The second one gives the Jacobians of the
    next state and force, and of the output, in each row: by the state (N), the force (d), the noise of the force (S d),
    and the numbers (p).
    """
    make, truth, size = system.make, jnp.asarray(system.truth), len(system.first["half"])
    cuts = np.cumsum([size, len(system.force), SUBSTEPS * len(system.force)])

    def log(first, w, inputs, noise, errors):
        model = make(truth)
        zero = origin(model)

        def row(now, given):
            u = given[0]
            if system.feedback is not None:
                u = u - np.array(system.feedback, float) @ difference(model, zero, now[0])
            y = model.manifold.retract(output(model, now[0], u), given[2])
            return step(system, model, *now, u, given[1]), (*now, u, y)

        return jax.lax.scan(row, (displace(model, zero, first), w), (inputs, noise, errors))[1]

    def jacobians(x, w, u, noise):
        true = make(truth)
        next_x, next_w = step(system, true, x, w, u, noise)

        def moved(z):
            change, of_force, of_noise, numbers = jnp.split(z, cuts)
            model, start = make(truth + numbers), displace(true, x, change)
            end, force = step(system, model, start, w + of_force, u, noise + of_noise.reshape(noise.shape))
            error = true.manifold.towards(output(true, x, u), output(model, start, u))
            return jnp.concatenate([difference(true, next_x, end), force - next_w]), error

        return jax.jacfwd(moved)(jnp.zeros(cuts[-1] + len(truth)))

    return jax.jit(log), jax.jit(jax.vmap(jacobians))


def simulate(name: str, system: System, with_force: bool, log: int) -> Log:
    """A log of a system and its bound; the same whatever other logs there are."""
    random = np.random.default_rng([zlib.crc32(name.encode()), with_force, log])
    rows = round(random.uniform(*system.seconds) * system.rate)
    middle, half = (np.array(system.first[key], float) for key in ("middle", "half"))
    first, inputs = middle + half * random.uniform(-1, 1, len(half)), system.inputs(random)
    w = with_force * random.normal(size=len(system.force))
    noise = with_force * random.normal(size=(len(inputs), SUBSTEPS, len(system.force)))
    errors = np.array(system.noise) * random.normal(size=(len(inputs), len(system.noise)))
    run, linearise = programs(system)
    x, w, u, y = run(first, w, inputs, noise, errors)
    next_state, outputs = (np.asarray(jacobian)[:rows] for jacobian in linearise(x, w, u, noise))
    limits = bound(next_state, outputs, system, with_force)
    record = Record(np.arange(rows) / system.rate, np.asarray(u)[:rows], np.asarray(y)[:rows])
    return Log(record, limits, system.truth * np.exp(random.uniform(*np.log(OFF), len(system.truth))))


def bound(next_state: np.ndarray, outputs: np.ndarray, system: System, with_force: bool) -> np.ndarray:
    """Cramér–Rao bounds (p,) of the standard errors of the numbers, from the Jacobians of the T rows of a log.

    The information is that of the innovations of a Kalman filter whose first state is free. Without a force there is no
    noise in its states, and this is the information of the outputs on the numbers and the first state.
    """
    n, d, p = len(system.first["half"]), len(system.force), len(system.numbers)
    size, r = n + d, np.diag(np.square(system.noise))
    covariance = np.diag([PRIOR**2] * n + [float(with_force)] * d)
    s, information = np.zeros((size, p)), np.zeros((p, p))
    for by, h in zip(next_state, outputs, strict=True):
        a, g, b = np.split(by, [size, size + SUBSTEPS * d], axis=1)
        of_state = h[:, :size]
        sensitivity = of_state @ s + h[:, -p:]
        inverse = np.linalg.inv(of_state @ covariance @ of_state.T + r)
        information += sensitivity.T @ inverse @ sensitivity
        gain = covariance @ of_state.T @ inverse
        rest = np.eye(size) - gain @ of_state
        covariance = rest @ covariance @ rest.T + gain @ r @ gain.T  # Joseph's form stays positive
        covariance = a @ covariance @ a.T + with_force * g @ g.T
        s = a @ (s - gain @ sensitivity) + b
    scale = np.sqrt(np.diag(information))  # the numbers have different units
    return np.sqrt(np.diag(np.linalg.inv(information / np.outer(scale, scale)))) / scale


def fit(system: System, log: Log) -> dict[str, Any]:
    """Errors and standard errors of the fit of a log, or why it is refused."""
    start = time.process_time()
    try:
        result = covariant.fit(system.spec, log.record, system.numbers, overrides=system.overrides(log.first))
    except ValueError as error:
        return {"refused": str(error).splitlines()[0], "seconds": time.process_time() - start}
    order = [list(result.columns["parameter"]).index(name) for name in system.numbers]
    return {
        "error": (result.values[order] - system.truth).tolist(),
        "standard_error": result.standard_errors[order].tolist(),
        "written": result.better,
        "seconds": time.process_time() - start,
    }


def compute(name: str, system: System, force: str, number: int, out: Path) -> None:
    """Add the result of a log to a file."""
    log = simulate(name, system, force == "with", number)
    line = {"system": name, "force": force, "log": number, "rows": len(log.record.t)}
    line |= {"bound": log.bound.tolist(), "first": log.first.tolist()} | fit(system, log)
    with out.open("a") as file:
        file.write(json.dumps(line) + "\n")
    message = line.get("refused") or np.round(np.array(line["error"]) / log.bound, 2)
    print(f"{name}, {force} force, log {number}: {message}", file=sys.stderr, flush=True)


def table_row(results: list[dict[str, Any]], numbers: list[str]) -> str:
    """A line of the table on the logs of a system; z is of numbers with a standard error, and others are counted."""
    fits = [line for line in results if "error" in line]
    head = f"{len(results)} | {len(results) - len(fits)} | {sum(not line['written'] for line in fits)} |"
    if not fits:
        return f"{head} – | – | – | – | – | – | refused: {results[0]['refused'] if results else 'no log'}"
    error, bound, std = (np.array([line[key] for line in fits]) for key in ("error", "bound", "standard_error"))
    head += f" {np.sum(~np.isfinite(std))} of {std.size} |"
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
        known = systems(Path(folder))
        chosen = [name.strip() for name in options.systems.split(",")] if options.systems else list(known)
        if unknown := set(chosen) - set(known):
            parser.error(f"no system is named {', '.join(unknown)}; there are: {', '.join(known)}")
        kinds = ("without", "with") if options.force == "both" else (options.force,)
        pairs = [(name, force) for name in chosen for force in kinds]
        results: dict[tuple[str, str], dict[int, Any]] = {pair: {} for pair in pairs}
        for name, force in pairs:
            read(options.out, results)
            for number in sorted(set(range(options.logs)) - set(results[name, force])):
                compute(name, known[name], force, number, options.out)
        read(options.out, results)
    print(
        "| system | force | logs | refused | not written | undetermined | error/bound | worst | z | beyond 3 | CPU s |"
    )
    print("|---|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|")
    for name, force in pairs:
        print(f"| {name} | {force} | {table_row(list(results[name, force].values()), known[name].numbers)}")


def read(path: Path, results: dict[tuple[str, str], dict[int, Any]]) -> None:
    """Read the results in a file of these systems."""
    for line in map(json.loads, path.read_text().splitlines() if path.exists() else []):
        if (pair := (line["system"], line["force"])) in results:
            results[pair][line["log"]] = line


if __name__ == "__main__":
    main()
