"""Numbers that a model file lacks and a log shows: what takes long."""

import numpy as np
import pytest
from test_suggestions import T, by_key, noise

from covariant.calibration import diagnose, suggest_noise
from covariant.models import load
from covariant.signals import Record

CART = """
system = "ball_and_beam"
[columns]
q = ["r", "theta"]
u = ["torque"]
"""


@pytest.fixture
def beam(tmp_path):
    path = tmp_path / "beam.toml"
    path.write_text(CART)
    return load(str(path))


@pytest.mark.exhaustive
def test_coordinates_of_different_units_have_ticks_of_their_own(beam):
    rough = np.stack([0.1 * np.sin(3 * T), 0.4 * np.cos(2 * T)], axis=1)
    ticks = np.array([1e-4, 5e-3])
    log = Record(T, np.zeros((len(T), 1)), ticks * np.round(rough / ticks))
    found = by_key(suggest_noise(beam, log))["measurement.quantum"]
    assert found.value == pytest.approx(ticks, rel=1e-3)
    assert found.line == f"[measurement] quantum = [{found.value[0]}, {found.value[1]}]"
    right = [finding.what for finding in diagnose(beam, log, tuple(ticks)).findings]
    assert "ticks" not in right
    (wrong,) = [finding for finding in diagnose(beam, log, 1e-4).findings if finding.what == "ticks"]
    assert wrong.line == found.line
    assert wrong.wrong


@pytest.mark.exhaustive
def test_noise_beyond_that_of_the_file_is_said_for_each_coordinate(beam):
    rough = np.stack([0.1 * np.sin(3 * T) + noise(1e-3), 0.4 * np.cos(2 * T) + 1e-4 * noise(1.0)[::-1]], axis=1)
    log = Record(T, np.zeros((len(T), 1)), rough)
    (found,) = [
        finding
        for finding in diagnose(beam._replace(measurement_std=(1e-4, 1e-4)), log).findings
        if finding.what == "noise"
    ]
    assert (found.where, found.line) == ("r", f"[measurement] std = [{found.numbers['std']:.2g}, 0.0001]")
    assert found.numbers["std"] == pytest.approx(1e-3, rel=0.1)
