"""Numbers that a model file lacks and a log shows."""

import numpy as np
import pytest

from covariant.calibration import suggest_noise
from covariant.models import free_body, load
from covariant.signals import Record

T = np.arange(0.0, 10.0, 0.005)
MOTION = 0.3 * np.cos(T)  # of the library's oscillator, whose acceleration is -q


def record(y: np.ndarray) -> Record:
    return Record(T, np.zeros((len(T), 1)), y.reshape(len(T), -1))


def noise(std: float) -> np.ndarray:
    return std * np.random.default_rng(0).normal(size=len(T))


def by_key(found) -> dict:
    return {suggestion.key: suggestion for suggestion in found}


@pytest.mark.parametrize("std", [1e-4, 1e-3])
def test_noise_is_what_neighbours_do_not_predict(std):
    found = by_key(suggest_noise(load("oscillator"), record(MOTION + noise(std))))
    assert found["measurement.std"].value == pytest.approx(std, rel=0.1)
    assert found["measurement.std"].line == f"[measurement] std = {found['measurement.std'].value}"
    assert "measurement.quantum" not in found


def test_ticks_are_suggested_where_positions_are_whole_ticks_apart():
    found = by_key(suggest_noise(load("oscillator"), record(2e-3 * np.round(MOTION / 2e-3))))
    assert found["measurement.quantum"].value == pytest.approx(2e-3, rel=1e-3)
    assert "measurement.std" not in found


@pytest.mark.parametrize("unknown", [0.05, 0.1])
def test_acceleration_is_what_the_model_leaves(unknown):
    """A motion at another frequency is that of the model with a force of its own."""
    y = MOTION + unknown * np.cos(2 * T) / 4
    left = np.std((4 - 1) * unknown * np.cos(2 * T) / 4)
    found = by_key(suggest_noise(load("oscillator"), record(y + noise(1e-5))))
    assert found["uncertainty.acceleration"].value == pytest.approx(left, rel=0.1)


def test_what_the_file_has_is_not_suggested_and_what_the_log_hides_neither():
    file = load("oscillator", {"measurement.std": 1e-3})
    assert set(by_key(suggest_noise(file, record(MOTION + noise(1e-3))))) == {"uncertainty.acceleration"}
    known = load("oscillator", {"measurement.std": 1e-3, "uncertainty.acceleration": 1.0})
    assert suggest_noise(known, record(MOTION)) == ()
    assert suggest_noise(load("oscillator"), record(np.zeros(len(T)))) == ()
    short = Record(T[:20], np.zeros((20, 1)), MOTION[:20, None])
    assert suggest_noise(load("oscillator"), short) == ()
    body = Record(T, np.zeros((len(T), 3)), np.broadcast_to(np.eye(3), (len(T), 3, 3)))
    assert suggest_noise(load("oscillator")._replace(model=free_body((1.0, 2.0, 3.5))), body) == ()
