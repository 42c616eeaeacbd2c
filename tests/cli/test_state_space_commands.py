"""The commands on state-space models: a log of outputs, with the true states beside them."""

import pytest

from covariant.models import load


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_ships_and_underwater_vehicles_are_systems():
    for name, states, inputs in (("cybership", 6, 3), ("supply_vessel", 6, 3), ("manoeuvring_ship", 6, 2)):
        file = load(name)
        assert (file.dimension, len(file.columns.u)) == (states, inputs), name
    assert load("odin").dimension == 12
    assert load("cybership", ("parameters.mass=30.0",)).model.parameters
