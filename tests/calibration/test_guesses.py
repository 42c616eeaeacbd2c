"""Numbers of a model that are far off are told from faults of a log, and hide none of these."""

import jax.numpy as jnp
import numpy as np
from logs_with_faults import _moved

import covariant
from covariant.models import load
from covariant.signals import Record

TRUE = {"mass": [0.6, 0.4], "com": [0.16, 0.14], "inertia": [5e-3, 2.6e-3], "viscous": [0.03, 0.02]}
GUESSED = {"mass": [0.2, 1.0], "com": [0.1, 0.3], "inertia": [2e-2, 1e-3], "viscous": [0.15, 0.005]}
KNOWN = {"parameters.length": [0.3, 0.25], "measurement.std": 5e-4}
PERIOD, ROWS = 0.004, 1500
NUMBERS = "numbers of the model"


def stated(numbers: dict[str, list[float]]) -> dict[str, object]:
    return {f"parameters.{name}": values for name, values in numbers.items()} | KNOWN


def log(curve=lambda u: u, late: int = 0, seed: int = 0) -> Record:
    """The log of two links whose inputs act by a curve, or are logged some rows late."""
    random = np.random.default_rng(seed)
    t = PERIOD * np.arange(ROWS)
    phases, speeds = random.uniform(0, 6.28, (3, 2)), random.uniform(2.0, 12.0, (3, 2))
    u = np.array([0.5, 0.15]) * np.mean(np.sin(speeds * t[:, None, None] + phases), axis=1) * 2
    start, acting = random.uniform(-1, 1, 4), curve(u)
    model = load("pendulum_chain", stated(TRUE)).model
    exact = np.asarray(_moved(model, *map(jnp.asarray, (t, acting, np.zeros_like(acting[1:]), start))))[:, :2]
    logged = np.concatenate([np.repeat(u[:1], late, axis=0), u[: len(u) - late]])
    return Record(t, logged, exact + random.normal(0, 5e-4, exact.shape))


def found(record: Record, numbers: dict[str, list[float]] = GUESSED) -> list:
    return [
        each for each in covariant.check("pendulum_chain", record, overrides=stated(numbers)).findings if each.wrong
    ]


def test_numbers_that_are_off_are_no_fault_of_a_right_log():
    (finding,) = found(log())
    assert finding.what == NUMBERS
    assert finding.line.startswith("covariant fit ")
    assert finding.numbers["unexplained_after"] < 0.01
    assert found(log(), TRUE) == []


def test_a_span_of_equal_readings_and_a_sudden_step_need_no_model():
    record = log()
    y = record.y.copy()
    y[700:900, 0] = y[700, 0]
    findings = found(record._replace(y=y))
    assert findings[0].what == "repeated rows"
    assert {each.what for each in findings} <= {"repeated rows", NUMBERS}
    y = record.y.copy()
    y[700:, 1] += 0.3
    findings = found(record._replace(y=y))
    assert findings[0].what == "zero of a position"
    assert abs(findings[0].numbers["jump"] - 0.3) < 0.01


def test_all_rows_of_bursts_are_emptied():
    from covariant.calibration import outliers

    record, random = log(), np.random.default_rng(1)
    y, burst = record.y.copy(), np.zeros(ROWS, bool)
    for begin, rows in ((300, 25), (700, 12), (1100, 30)):
        burst[begin : begin + rows] = True
    y[burst, 0] += random.normal(0, 1.0, burst.sum())
    wrong, _ = outliers(record.t, y, ())
    assert wrong[burst, 0].mean() > 0.9
    assert not wrong[~burst].any()
    assert found(record._replace(y=y))[0].what == "outliers"


ASSERTING = """
import jax.numpy as jnp
from covariant import models


def spring(mass, stiffness):
    assert mass > 0, "a mass is positive"
    return models.Lagrangian(
        lambda q: mass * jnp.eye(1),
        lambda q: stiffness * q[0] ** 2 / 2,
        lambda t, q, u: u,
        coordinates=("x",),
        inputs=1,
    )
"""


def test_a_model_whose_numbers_cannot_be_changed_is_compared_as_it_is(tmp_path, monkeypatch):
    (tmp_path / "asserting_spring.py").write_text(ASSERTING)
    monkeypatch.syspath_prepend(tmp_path)
    swing = covariant.simulate("oscillator", duration=10.0, rate=100.0, amplitude=2.0, noise=1e-4).record
    stated = {"parameters.mass": 1.0, "parameters.stiffness": 9.0, "measurement.std": 1e-4}
    findings = covariant.check("asserting_spring:spring", swing, overrides=stated).findings
    assert findings[0].what != NUMBERS
