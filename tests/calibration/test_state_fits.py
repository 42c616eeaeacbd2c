"""Fits of state-space models: the linear model of the errors of their states, against expm and differences."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

import covariant
from covariant import models, scoring
from covariant.calibration.identification import rows_of, unknowns_of
from covariant.models import StateSpace
from covariant.signals import Record

STEP, STD = 0.05, 5e-3


def tank(outflow=0.5, gain=2.0, size=1.0):
    """Two levels, in units of `size`; one reading shows both of them, the second squared."""

    def flow(t, x, u):
        return jnp.stack([size * u[0] + x[1] - 2.0 * x[0], x[0] - (1.0 + outflow) * x[1]])

    def pressure(t, x, u):
        return jnp.stack([gain * (x[0] / size + 0.3 * (x[1] / size) ** 2)])

    return StateSpace(flow, pressure, coordinates=("a", "b"), units=("m", "m"), outputs=("p",), inputs=1)


def matrix(outflow):
    return np.array([[-2.0, 1.0], [1.0, -1.0 - outflow]])


def log(seed: int, rows: int = 400) -> Record:
    """Readings of the tank, whose states follow by exponentials."""
    rng, t = np.random.default_rng(seed), np.arange(rows) * STEP
    u = np.sign(np.sin(1.3 * t + seed) + 0.5 * np.sin(0.37 * t))
    whole = np.zeros((3, 3))
    whole[:2, :2], whole[0, 2] = matrix(0.5), 1.0
    step, x = expm(whole * STEP), np.array([0.4, 0.2])
    states = []
    for k in range(rows):
        states.append(x)
        x = step[:2, :2] @ x + step[:2, 2] * u[k]
    a, b = np.array(states).T
    y = 2.0 * (a + 0.3 * b**2) + STD * rng.normal(size=rows)
    y[50:55] = np.nan
    return Record(t, u[:, None], y[:, None])


def family(record: Record, size: float = 1.0, **first: float) -> Any:
    spec = f"{__name__}:tank"
    stated = {"outflow": 0.9, "gain": 1.4} | first
    found = models.family(spec, list(stated), {f"parameters.{k}": v for k, v in (stated | {"size": size}).items()})
    t, y = np.asarray(record.t), np.asarray(record.y)
    return found, [scoring.zero_phase_velocity(t, y, t, 0.3, 3)]


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))


def test_steps_are_those_of_the_exponential_and_slopes_are_differences():
    record = log(0)
    found, slopes = family(record)
    rows = rows_of(found, [record], slopes)
    unknowns: Any = unknowns_of(found, rows)
    z = np.array([-0.2, 0.1])
    assert unknowns.steps(z, rows) >= 1
    here = rows._replace(t=jnp.asarray(rows.t))

    def linear(z):
        return unknowns.linearised(jnp.asarray(z), rows.start, here, jnp.asarray(8))

    system, sizes = linear(z), np.asarray(unknowns.sizes)
    exact = expm(matrix(float(unknowns.values(jnp.asarray(z))[0])) * STEP)
    k = 120
    np.testing.assert_allclose(system.transition[k], exact * sizes / sizes[:, None], rtol=1e-7)
    step = 1e-5
    for j in range(2):
        up, down = (linear(z + way * step * np.eye(2)[j]) for way in (1, -1))
        np.testing.assert_allclose(system.slopes[k, :, j], (up.defect - down.defect)[k] / (2 * step), atol=1e-8)
        # A reading minus what the model shows falls where the model shows more.
        shown = -(up.residual - down.residual)[k] / (2 * step)
        np.testing.assert_allclose(system.shown_slopes[k, :, j], shown, atol=1e-8)
    assert float(abs(system.shown_slopes[k, 0, 1])) > 0.1, "the gain of the reading"
    x = np.asarray(rows.start.v)[k]
    gain = float(unknowns.values(jnp.asarray(z))[1])
    np.testing.assert_allclose(system.shows[k], [gain * np.array([1.0, 0.6 * x[1]]) * sizes], rtol=1e-9)


def test_bases_on_legs_are_not_fitted():
    record = Record(np.arange(50) * 0.01, np.zeros((50, 6)), np.zeros((50, 12)))
    first = {"parameters.path": "quadruped", "parameters.feet": {"FL_FOOT": [0.0, 0.0, 0.0]}, "parameters.slip": 0.1}
    with pytest.raises(ValueError, match="numbers are fitted for mechanical ones"):
        covariant.fit("legged_base", record, ["slip"], overrides=first)
