"""What takes long of `test_unexplained.py`."""

from typing import Any

import pytest
from test_unexplained import RIGHT

import covariant

STIFF = {"uncertainty.external_force_std": 1e-3, "uncertainty.external_force_time": 10.0}


LOOSE = {"uncertainty.external_force_std": 0.5, "uncertainty.external_force_time": 0.2}


def estimated(machine=(), model=(), **sensors: Any):
    """Estimate of a swinging pendulum, with numbers of machine and model that replace those of `RIGHT`."""
    motion: dict[str, Any] = {"duration": 6.0, "rate": 100.0, "q0": [1.2], "amplitude": [1.0], "noise": 1e-3, "seed": 3}
    log = covariant.simulate("pendulum_chain", overrides=RIGHT | dict(machine), **(motion | sensors))
    given = {"observer": "intrinsic-kalman", "overrides": RIGHT | dict(model), "engine": "jax"}
    return covariant.estimate("pendulum_chain", log.record, **given)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("model", "sensors"),
    [
        ({}, {}),
        ({}, {"dropout": 0.3, "jitter": 1e-3}),
        (STIFF, {}),
        pytest.param({"measurement.quantum": 5e-3}, {"noise": 0.0, "quantum": 5e-3}, marks=pytest.mark.long),
    ],
    ids=["right", "gaps", "with a force state", "ticks"],
)
def test_right_models_raise_no_alarm(model, sensors):
    result = estimated(model=model, **sensors)
    assert result.outcome.nis < 1.3
    assert not any("NIS" in line for line in result.warnings)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("machine", "model"),
    [({"parameters.mass": [1.5]}, {}), ({"parameters.coulomb": [0.15]}, STIFF)],
    ids=["mass", "friction"],
)
def test_wrong_models_raise_it_once_with_its_number_and_a_remedy(machine, model):
    result = estimated(machine, model)
    (line,) = [line for line in result.warnings if "NIS" in line]
    assert f"NIS averages {result.outcome.nis:.3g} a measured number" in line
    assert "`covariant check pendulum_chain record`" in line
    assert line in str(result)


@pytest.mark.exhaustive
def test_a_force_state_of_the_size_of_the_friction_ends_it():
    result = estimated({"parameters.coulomb": [0.15]}, LOOSE)
    assert not any("NIS" in line for line in result.warnings)
