"""What takes long of `test_fit.py`."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from plain import rk4

from covariant import models, scoring
from covariant.calibration import PredictionErrors, fit, relations
from covariant.calibration.identification import Unknowns, error_growth, gather, held_out_rows, search, window_errors
from covariant.signals import Record
from covariant.simulation import hold, simulate

MASS, COM, INERTIA, VISCOUS, GRAVITY = 0.7, 0.4, 0.05, 0.08, 9.81


NOISE = 1e-3


PENDULUM = f"""
system = "pendulum_chain"
[parameters]
mass = [{1.3 * MASS}]
length = [1.0]
com = [{COM}]
inertia = [{1.3 * INERTIA}]
viscous = [{VISCOUS}]
"""


def swing(seeds: int, driven: bool, viscous: float = VISCOUS, seconds: float = 10.0):
    """Stamps (T,), inputs (T,) and noisy positions (seeds, T) of a pendulum that an unknown torque disturbs too."""
    rng = np.random.default_rng(5)
    t = np.arange(0, seconds, 0.01)
    inertia = INERTIA + MASS * COM**2
    u = driven * (1.5 * np.sin(2.1 * t) + np.sin(5.3 * t + 1))
    torque = np.zeros((seeds, len(t)))
    for k in range(1, len(t)):  # correlated over 50 ms, 0.02 N m
        torque[:, k] = 0.8 * torque[:, k - 1] + 0.02 * np.sqrt(1 - 0.8**2) * rng.normal(size=seeds)

    x, path = np.array([np.full(seeds, 1.5), np.zeros(seeds)]), []
    for k in range(len(t)):
        path.append(x[0])
        pushed = u[k] + driven * torque[:, k]

        def rate(x, pushed=pushed):
            return np.array([x[1], (pushed - MASS * GRAVITY * COM * np.sin(x[0]) - viscous * x[1]) / inertia])

        for _ in range(4):
            x = rk4(rate, x, 0.01 / 4)
    return t, u, np.stack(path, axis=1) + NOISE * rng.normal(size=(seeds, len(t)))


def reference(record: Record) -> np.ndarray:
    return scoring.zero_phase_velocity(record.t, np.asarray(record.y), record.t, 0.06)


def swung(driven: bool, seeds: int = 1, **other) -> list[tuple[Record, np.ndarray]]:
    t, u, y = swing(seeds, driven, **other)
    records = [Record(t, u[:, None], one[:, None]) for one in y]
    return [(record, reference(record)) for record in records]


def family(folder: Path, *names: str, text: str = PENDULUM, overrides=()) -> models.Family:
    (folder / "model.toml").write_text(text)
    return models.family(str(folder / "model.toml"), names, overrides)


@pytest.fixture(scope="module")
def fits(tmp_path_factory):
    """Fits of mass, inertia and friction to forty logs with different noise."""
    open_numbers = family(tmp_path_factory.mktemp("family"), "mass", "inertia", "viscous")
    return [fit(open_numbers, [record], [v]) for record, v in swung(True, 40)]


@pytest.mark.exhaustive
def test_intervals_of_95_percent_cover_the_truth(fits):
    values, errors = (np.array([getattr(f, name) for f in fits]) for name in ("values", "standard_errors"))
    covered = np.mean(np.abs(values - [MASS, INERTIA, VISCOUS]) < 1.96 * errors, axis=0)
    assert np.all(covered >= 0.88), covered
    assert np.median(errors / values, axis=0).max() < 0.1, "the intervals are not wide for nothing"
    np.testing.assert_allclose(np.median(errors, axis=0), np.std(values, axis=0), rtol=0.35)


@pytest.mark.exhaustive
def test_outliers_and_missing_samples_hardly_move_a_fit(fits, tmp_path):
    [(record, _)] = swung(True)
    rng = np.random.default_rng(3)
    y = np.array(record.y)
    y[rng.choice(len(y), 50, replace=False)] = np.nan
    y[rng.choice(np.arange(1, len(y)), 10, replace=False)] += 0.5
    y[0] = record.y[0]
    spoiled = record._replace(y=y)
    found = fit(family(tmp_path, "mass", "inertia", "viscous"), [spoiled], [reference(spoiled)])
    assert np.all(np.abs(found.values - [MASS, INERTIA, VISCOUS]) < 4 * fits[0].standard_errors)


STEEP_RAIL = """
import jax.numpy as jnp
from covariant.models import Lagrangian, Parametric

def kinetic(q, mass):
    return mass * jnp.eye(1)

def friction(q, v, viscous, coulomb):
    return -viscous * v - coulomb * jnp.tanh(v / 0.0003)

def make(mass, viscous, coulomb):
    forces = Parametric(friction, viscous=viscous, coulomb=coulomb)
    return Lagrangian(Parametric(kinetic, mass=mass), lambda q: 0.0, dissipation=forces, coordinates=("q",), inputs=1)
"""


@pytest.mark.exhaustive
def test_friction_too_steep_for_the_steps_of_the_first_values_is_found(tmp_path, monkeypatch):
    """The true friction needs a hundred Runge–Kutta steps where that of the first values needs one."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "steep_rail.py").write_text(STEEP_RAIL)
    text = 'system = "steep_rail:make"\n[parameters]\nmass = 1.0\nviscous = 0.01\ncoulomb = 0.01\n'
    open_numbers = family(tmp_path, "mass", "viscous", "coulomb", text=text)
    t = np.arange(0, 12, 0.02)
    u = 0.9 * np.sin(2.5 * t)
    q, v, path = 0.0, 0.0, []
    for force in u:
        path.append(q)
        for _ in range(100):  # the friction implicitly: at rest where it exceeds the force
            fast = v + 2e-4 * force / 0.57
            v = np.sign(fast) * max(0.0, abs(fast) - 2e-4 * 0.6 / 0.57) / (1 + 2e-4 * 1.2 / 0.57)
            q += 2e-4 * v
    y = np.array(path) + 2e-4 * np.random.default_rng(1).normal(size=len(t))
    record = Record(t, u[:, None], y[:, None])
    found = fit(open_numbers, [record], [reference(record)])
    assert found.determined.all(), relations(found)
    np.testing.assert_allclose(found.values, [0.57, 1.2, 0.6], rtol=0.1)


@pytest.mark.exhaustive
def test_gravity_of_the_wrong_sign_is_seen(fits, tmp_path):
    [(record, v)] = swung(True)
    right, wrong = (
        family(tmp_path, "mass", "inertia", "viscous", overrides=[f"parameters.gravity={g}"]) for g in (9.81, -9.81)
    )
    rows = gather(right.file.model.manifold, [record], [v])
    held_out = held_out_rows(rows, [record.t], np.zeros(1, bool))

    def errors(family: models.Family, values: np.ndarray) -> PredictionErrors:
        unknowns = Unknowns.of(family)
        return window_errors(unknowns, unknowns.relative(values), rows, 0.25, held_out)

    found = search(wrong, rows.only(~held_out)).fit
    assert error_growth(errors(right, fits[0].values), errors(wrong, found.values)) > 3
    assert not np.allclose(found.values[0], MASS, rtol=0.2)


@pytest.mark.exhaustive
def test_a_pendulum_that_nothing_drives_shows_its_frequency_only(tmp_path):
    [(record, v)] = swung(False, viscous=0.0, seconds=6.0)
    open_numbers = family(tmp_path, "mass", "com", "inertia", overrides=["parameters.viscous=[0.0]"])
    found = fit(open_numbers, [record], [v])
    m, c, i = found.values
    j, true = i + m * c**2, INERTIA + MASS * COM**2
    np.testing.assert_allclose(m * c / j, MASS * COM / true, rtol=2e-3)
    slope = np.array([1 - m * c**2 / j, 1 - 2 * m * c**2 / j, -i / j])  # of the logarithm of the squared frequency
    assert found.undetermined.shape == (2, 3)
    np.testing.assert_allclose(found.undetermined @ slope, 0, atol=0.02)
    assert not found.determined.any()
    moved = np.log(found.values / found.first)
    assert np.abs(found.undetermined @ moved).max() < 0.02, "no number moves along what the log does not show"


@pytest.mark.exhaustive
def test_what_cannot_be_told_apart_is_named(tmp_path):
    [(record, v)] = swung(True)
    text = PENDULUM.replace(f"inertia = [{1.3 * INERTIA}]", 'inertia = [0.2]\ninertia_about = "joint"')
    found = fit(family(tmp_path, "mass", "com", "inertia", text=text), [record], [v])
    assert relations(found) == (
        "only the product com[0] · mass[0] is determined: com[0] and mass[0] cannot be told apart",
    ) or relations(found) == (
        "only the product mass[0] · com[0] is determined: mass[0] and com[0] cannot be told apart",
    )
    assert found.determined.tolist() == [False, False, True]
    np.testing.assert_allclose(found.values[0] * found.values[1], MASS * COM, rtol=0.03)
    np.testing.assert_allclose(found.values[0] / found.values[1], found.first[0] / found.first[1], rtol=0.05)


@pytest.mark.exhaustive
def test_what_vanishes_on_the_way_is_not_called_determined(tmp_path):
    """There is neither lag nor dry friction: the search makes both small, with errors many times as large."""
    t = np.arange(800) * 0.01
    u = 0.3 * np.sin(2 * t)[:, None]
    true = models.pendulum_chain((1.0,), (1.0,), com=(0.4,), viscous=(0.05,))
    swing = simulate(true, jnp.array([0.5, 0.0]), jnp.asarray(t), hold(jnp.asarray(t), jnp.asarray(u)))
    record = Record(t, u, np.asarray(swing.y) + 1e-4 * np.random.default_rng(0).normal(size=(800, 1)))
    text = PENDULUM.replace("[parameters]", "[parameters]\ncoulomb = [0.05]").replace(f"{1.3 * INERTIA}", "0.0")
    names = ("mass", "viscous", "coulomb", "inputs.lag")
    given = ["inputs.lag=0.02", "parameters.mass=[1.3]", "parameters.viscous=[0.03]"]
    v = scoring.zero_phase_velocity(t, record.y, t, half=0.1)
    found = fit(family(tmp_path, *names, text=text, overrides=given), [record], [v])
    assert (found.standard_errors < found.values)[found.determined].all()
    assert not found.determined[3]
    assert any("inputs.lag" in said for said in relations(found))
    assert abs(found.values[0] - 1.0) < 0.02
