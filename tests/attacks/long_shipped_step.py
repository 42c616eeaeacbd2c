"""The step that ships, run in search of an error that its certificate excludes: in JAX and in exported C.

`COVARIANT_ATTACKS=500` tries 100 000 runs of each, instead of some two thousand.
"""

import dataclasses
import functools
import os
import subprocess
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import covariant
from covariant import models
from covariant.certificates import ContractionCertificate, certify
from covariant.observers import Intrinsic
from scalargraph.compiler import compiler

RUNS, SAMPLES = 200 * int(os.environ.get("COVARIANT_ATTACKS", "12")), 30
INTERVAL, RATE, GAINS = (0.008, 0.012), 100.0, (10.0, 50.0)
BOUNDS = {"position": (-3.0, 3.0), "velocity": 4.0, "error": 0.1, "input": 0.5}
MODEL = 'system = "pendulum_chain"\n[parameters]\nmass = [1.0]\nlength = [0.5]\n'
INSIDE, CHORD = 0.95, 1.002
"""Distance from which runs start, as a fraction of the radius, and how much longer a segment may be than a geodesic."""
ROUNDED = {np.float64: 1e-9, np.float32: 2e-3}
"""Fraction of the radius that rounding may add to a distance, since certificates are about exact numbers."""
DRIVER = """
#include <stdio.h>
#include "shipped.h"
#ifdef BOUNDED
#define INNER(name) inner_##name
#define BOUNDS ((shipped_real[]){state.last_position_bound[0], state.last_velocity_bound[0], state.last_premise})
#else
#define INNER(name) name
#define BOUNDS ((shipped_real[]){0, 0, 0})
#endif
int main(void) {
    shipped_real row[4];
    while (fread(row, sizeof row[0], 2, stdin) == 2) {
        shipped_state state;
        shipped_init(&state, &shipped_default, row, 0);
        state.INNER(q)[0] = row[0];
        state.INNER(v)[0] = row[1];
        for (int k = 0; k < SAMPLES; k++) {
            if (fread(row, sizeof row[0], 3, stdin) != 3) return 1;
            shipped_step(&state, &shipped_default, row, row + 1, 0, row[2]);
            fwrite(state.INNER(q), sizeof row[0], 1, stdout);
            fwrite(state.INNER(v), sizeof row[0], 1, stdout);
            fwrite(BOUNDS, sizeof row[0], 3, stdout);
        }
    }
    return 0;
}
"""


FILES = ("driver.c", "c/shipped.c")


class Logs(NamedTuple):
    """What happened in several runs, and where their estimates start.

    Attributes:
        start: first estimates (runs, 2).
        u, y, dt: inputs, measurements, NaN where lost, and times since the sample before (runs, samples).
        truth: true states (runs, samples, 2).
        inside: whether a run has kept to the region so far (runs, samples).
    """

    start: np.ndarray
    u: np.ndarray
    y: np.ndarray
    dt: np.ndarray
    truth: np.ndarray
    inside: np.ndarray


class Made(NamedTuple):
    """A certificate, its file, and the model file."""

    certificate: ContractionCertificate
    path: str
    model: str


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shipped")
    (folder / "pendulum.toml").write_text(MODEL)
    recipe = models.recipe(str(folder / "pendulum.toml"))
    system = models.from_recipe(recipe)
    assert isinstance(system, models.MechanicalSystem)
    observer = Intrinsic(system, *GAINS, substeps=1)
    certificate = certify(observer, **BOUNDS, interval=INTERVAL, lost=1, recipe=recipe, checker="off")
    assert certificate.statement.verdict == "holds"
    return Made(certificate, str(certificate.save(folder / "proved.json")), str(folder / "pendulum.toml"))


@functools.partial(jax.jit, static_argnums=0)
def moved(observer, x, u, dt):
    """True states (runs, 2) after a step."""

    def one(x, u, dt):
        new = observer.predict(observer.init(x[:1])._replace(q=x[:1], v=x[1:]), u[None], dt)
        return jnp.concatenate([new.q, new.v])

    return jax.vmap(one)(x, u, dt)


def length(certificate, x, estimate):
    """Lengths of segments from truth to estimate (…, 2) in the metric after a measurement."""
    nowhere = jnp.zeros(len(certificate.domain.low))
    error = jnp.asarray(estimate - x)
    metric = jax.vmap(lambda x: certificate.error_system.at(nowhere).metric(jnp.zeros(()), x))
    middle = metric(jnp.asarray((x + estimate) / 2).reshape(-1, 2)).reshape(*x.shape, 2)
    return np.asarray(jnp.sqrt(jnp.einsum("...i,...ij,...j->...", error, middle, error)))


def logs(certificate, interval=INTERVAL, lost=1, seed=0, share=INSIDE):
    """Runs from everywhere in the region, half of them with all intervals and inputs at their bounds."""
    rng, observer = np.random.default_rng(seed), certificate.observer
    truth_model = dataclasses.replace(observer, substeps=24)
    x = rng.uniform(-1, 1, size=(RUNS, 2)) * [2.9, 3.9]
    direction = rng.normal(size=(RUNS, 2)) / certificate.half_widths[[0, 1]]
    direction /= length(certificate, x, x + 1e-6 * direction)[:, None] * 1e6
    start = x + share * certificate.radius * direction
    missed, inside, rows = np.zeros(RUNS, int), np.ones(RUNS, bool), []
    for _ in range(SAMPLES):
        part = rng.uniform(size=(2, RUNS))
        part[:, ::2] = np.round(part[:, ::2])
        dt, u = interval[0] + part[0] * (interval[1] - interval[0]), part[1] - 0.5
        x = np.asarray(moved(truth_model, jnp.asarray(x), jnp.asarray(u), jnp.asarray(dt)))
        gone = (missed < lost) & (rng.uniform(size=RUNS) < 0.5)
        missed = np.where(gone, missed + 1, 0)
        inside = inside & (np.abs(x) < [3.0, 4.0]).all(axis=1)
        rows.append((u, np.where(gone, np.nan, x[:, 0]), dt, x, inside))
    u, y, dt, truth, inside = (np.stack(each, axis=1) for each in zip(*rows, strict=True))
    return Logs(start, u, y, dt, truth, inside)


@functools.partial(jax.jit, static_argnums=(0, 2))
def estimates(observer, runs, real):
    """Estimates (runs, samples, 2) of the step in JAX, in numbers of a type."""

    def one(start, *rows):
        state = observer.init(start[:1])._replace(q=start[:1], v=start[1:], age=jnp.zeros((), real))

        def sample(state, row):
            u, y, dt = row
            new, _ = observer.step(state, u[None], y[None], dt)
            return new, jnp.concatenate([new.q, new.v])

        return jax.lax.scan(sample, state, rows)[1]

    return jax.vmap(one)(*(jnp.asarray(each, real) for each in runs[:4]))


def excess(certificate, runs, found, real):
    """By how much a distance exceeds what is proved, as a fraction of the radius, at the worst of all samples."""
    distance = length(certificate, runs.truth, np.asarray(found, float))
    elapsed, first = np.cumsum(runs.dt, axis=1), INSIDE * certificate.radius
    # The recursion without its rounding: distances fall at the rate to what errors of the predictions leave.
    proved = first * np.exp(-certificate.decay * elapsed) + certificate.steady
    measured = np.isfinite(runs.y) & runs.inside
    worst = (distance - CHORD * proved)[measured].max() / certificate.radius - ROUNDED[real]
    return worst, int(measured.sum())


@pytest.mark.exhaustive
@pytest.mark.parametrize(("name", "real"), [("double", np.float64), ("float", np.float32)])
def test_no_run_of_the_step_in_c_or_jax_is_farther_off_than_what_is_proved(name, real, made, tmp_path):
    command = compiler()
    if command is None:
        pytest.skip("no C compiler")
    certificate, (alpha, beta) = made.certificate, GAINS
    options = {"alpha": alpha, "beta": beta, "certificate": made.path, "real": name, "name": "shipped"}
    covariant.export(made.model, tmp_path / "c", rate=RATE, observer="intrinsic", **options)
    (tmp_path / "driver.c").write_text(DRIVER)
    # A bound is computed with doubles alone.
    bound = ["-DBOUNDED"] if name == "double" else []
    flags = ["-O2", "-std=c99", f"-DSAMPLES={SAMPLES}", *bound, "-I", "c", "-o", "driver", *FILES, "-lm"]
    subprocess.run([command, *flags], cwd=tmp_path, check=True)
    runs = logs(certificate, seed=1)
    rows = np.stack([runs.u, runs.y, runs.dt], axis=2).reshape(RUNS, -1)
    sent = np.concatenate([runs.start, rows], axis=1).astype(real).tobytes()
    answer = subprocess.run([tmp_path / "driver"], input=sent, capture_output=True, check=True).stdout
    answer = np.frombuffer(answer, real).reshape(RUNS, SAMPLES, 5)
    found, bound, premise = answer[..., :2], answer[..., 2:4], answer[..., 4]
    if name == "double":
        known = np.isfinite(bound).all(axis=2)
        assert (known == (premise == 0)).all()
        assert 0.2 < known.mean() < 1.0
        assert (np.abs(found - runs.truth)[known] <= bound[known]).all()
    apart = np.abs(found - np.asarray(estimates(certificate.observer, runs, real))).max()
    assert apart < (1e-11 if name == "double" else 1e-4)
    worst, tried = excess(certificate, runs, found, real)
    print(f"{RUNS} runs, {tried} samples in the region: {worst:.2e}")
    assert tried > 5 * RUNS
    assert worst < 0


@pytest.mark.exhaustive
@pytest.mark.parametrize("change", ["gains", "longer intervals", "late samples", "a start outside"])
def test_what_is_not_proved_is_found_false(change, made):
    """The same search finds what is wrong, where something is."""
    certificate, observer = made.certificate, made.certificate.observer
    options: dict[str, Any] = {}
    match change:
        case "gains":
            observer = dataclasses.replace(observer, alpha=1.0, beta=0.5)
        case "longer intervals":
            options = {"interval": (0.4, 0.5), "lost": 0}
        case "a start outside":
            options = {"share": 1.2}
    runs = logs(certificate, **options)
    if change == "late samples":
        runs = runs._replace(y=np.roll(runs.y, 1, axis=1))
    worst, _ = excess(certificate, runs, estimates(observer, runs, np.float64), np.float64)
    assert worst > 0
