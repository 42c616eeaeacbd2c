"""Fits of state-space models: what takes long."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from test_state_fits import family, log, tank

import covariant
from covariant import models, scoring
from covariant.calibration import fit
from covariant.calibration._least_squares import Point
from covariant.calibration.identification import rows_of, search
from covariant.models import StateSpace
from covariant.signals import Record


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))


@pytest.mark.parametrize("size", [1.0, 1e5, 1e-5])
def test_numbers_of_dynamics_and_of_the_reading_are_found_in_any_unit(size):
    record = log(1)
    found, slopes = family(record, size)
    result = fit(found, [record], slopes)
    z = (result.values - [0.5, 2.0]) / result.standard_errors
    assert np.abs(z).max() < 4
    assert (result.standard_errors < [0.004, 0.001]).all()


def test_what_a_reading_cannot_tell_is_said():
    """With one more gain in the reading than it can tell, the product is known."""
    record = log(2)
    found, slopes = family(record)

    def twice(values):
        return tank(0.5, values[0] * values[1]), 0.0

    both = found._replace(make=twice, first=np.array([1.5, 1.2]), names=("gain", "scale"))
    result = fit(both, [record], slopes)
    assert not result.determined.any()
    np.testing.assert_allclose(np.prod(result.values), 2.0, rtol=2e-3)


def motor(resistance=1.2, inductance=5e-3, inertia=1e-4, viscous=2e-4):
    """A motor whose current is measured, and not its speed; the input is a voltage."""

    def rate(t, x, u):
        current = (u[0] - resistance * x[0] - 0.05 * x[1]) / inductance
        return jnp.stack([current, (0.05 * x[0] - viscous * x[1]) / inertia])

    return StateSpace(rate, lambda t, x, u: x[:1], coordinates=("current", "speed"), outputs=("i",), inputs=1)


def test_a_search_ends_where_the_loss_is_least_though_the_numbers_change_the_gains():
    """Under an unknown voltage, which is forgotten sooner than the current changes, scores alone end elsewhere."""
    rng, rows, inner = np.random.default_rng(1), 2000, 8
    t = np.arange(rows) * 0.004
    u = 3 * (np.sin(2 * np.pi * t * 0.7) + np.sin(2 * np.pi * t * 2.3 + 1.0) + np.sin(2 * np.pi * t * 6.9 + 2.0))
    a = np.array([[-1.2 / 5e-3, -0.05 / 5e-3], [0.05 / 1e-4, -2e-4 / 1e-4]])
    whole = np.zeros((3, 3))
    whole[:2, :2], whole[0, 2] = a, 1 / 5e-3
    step, stays = expm(whole * 0.004 / inner), np.exp(-0.004 / inner / 0.05)
    x, voltage, current = np.array([0.5, 5.0]), 0.0, []
    for k in range(rows):
        current.append(x[0])
        for _ in range(inner):
            voltage = stays * voltage + 0.1 * np.sqrt(1 - stays**2) * rng.normal()
            x = step[:2, :2] @ x + step[:2, 2] * (u[k] + voltage)
    y = np.array(current) + 0.02 * rng.normal(size=rows)
    record = Record(t, u[:, None], y[:, None])
    first = {"resistance": 1.7, "inductance": 4e-3, "inertia": 1.3e-4, "viscous": 2.6e-4}
    stated = {f"parameters.{name}": value for name, value in first.items()}
    found = models.family(f"{__name__}:motor", list(first), stated)
    solved = search(found, rows_of(found, [record], [scoring.zero_phase_velocity(t, y[:, None], t, 0.02, 3)]))
    assert not solved.quiet
    z = (solved.fit.values - [1.2, 5e-3, 1e-4, 2e-4]) / solved.fit.standard_errors
    assert np.abs(z).max() < 4, z
    inverse = solved.point.blocks.inverse(solved.fixed.directions)
    off = 0.2 * np.diag(np.sqrt(np.diagonal(inverse)))

    def loss(z):
        return Point.at(solved.problem, z, solved.point.blocks.rest).loss(solved.fixed)

    slope = np.array([(loss(solved.point.z + row) - loss(solved.point.z - row)) / (2 * row.max()) for row in off])
    assert slope @ inverse @ slope < 0.3**2


def test_an_input_of_the_other_sign_is_said_and_nothing_is_written():
    """Rates that nobody knows would make up for it."""
    record = log(1)
    first = {"parameters.outflow": 0.9, "measurement.std": 5e-3, "inputs.between": "held"}
    right, wrong = (
        covariant.fit("test_state_fits:tank", record._replace(u=sign * record.u), "outflow", overrides=first)
        for sign in (1, -1)
    )
    assert right.better
    assert right.summary["suspicion"] == ""
    assert not wrong.better
    assert "[units] u" in wrong.summary["suspicion"]
