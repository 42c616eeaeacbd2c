"""Pushes: those of `simulate`, and rows of `estimate` in which something pushes: what takes long."""

import numpy as np
import pytest
from scipy.signal import lfilter

import covariant
from covariant import models
from covariant.observers import MomentumObserver, observed_forces
from covariant.verbs.base import outcome as _outcome
from covariant.verbs.base.simulated_log import pushes

NOISE = {"measurement.std": 2e-4, "uncertainty.acceleration": 0.1}


FORCE = {"uncertainty.external_force_std": [0.2, 0.1], "uncertainty.external_force_time": 0.3}


ARM = {"parameters.mass": [1.0, 0.7], "parameters.length": [0.5, 0.4], "parameters.viscous": [0.05, 0.02]}


MOTION = {"duration": 10.0, "rate": 200.0, "q0": [1.0, 0.5], "amplitude": [1.0, 0.5], "noise": 2e-4}


def estimated(push, seed=0, **beside):
    log = covariant.simulate("pendulum_chain", seed=seed, overrides=ARM | NOISE, **MOTION, push=push)
    overrides = ARM | NOISE | FORCE | beside
    return log, covariant.estimate("pendulum_chain", log.record, observer="intrinsic-kalman", overrides=overrides)


@pytest.mark.exhaustive
def test_without_a_push_hardly_a_row_is_called_pushed():
    for seed in range(2):
        assert estimated(None, seed)[1].pushes.rows.mean() <= _outcome.FALSE_ALARM


@pytest.mark.exhaustive
def test_every_large_push_is_found_and_nothing_between_them():
    log, result = estimated([0.6, 0.3])
    true = np.abs(log.to_pandas()[list(log.force_columns)].to_numpy()).max(axis=1) > 0
    begins = np.flatnonzero(true & ~np.concatenate([[False], true[:-1]]))
    ends = np.flatnonzero(true & ~np.concatenate([true[1:], [False]]))
    late = 40  # rows, .2 s: the force is known that late
    assert all(result.pushes.rows[a : b + late].any() for a, b in zip(begins, ends, strict=True))
    near = np.zeros(len(true), bool)
    for a, b in zip(begins, ends, strict=True):
        near[a : b + late] = True
    assert not result.pushes.rows[~near].any()
    assert (result.columns["pushed"] == result.pushes.rows).all()
    assert f"pushed {len(result.pushes.starts)} times" in str(result)
    assert result.summary["pushes"] == len(result.pushes.starts) >= len(begins)


def test_without_forces_nothing_is_said_of_pushes():
    log = covariant.simulate("oscillator", duration=1.0, rate=100.0, noise=1e-4, q0=[1.0]).record
    result = covariant.estimate("oscillator", log, observer="intrinsic-kalman", overrides=NOISE)
    assert result.pushes is None
    assert "pushed" not in result.columns
    assert "pushed" not in str(result)


@pytest.mark.parametrize(
    ("wrenches", "names", "forces"),
    [
        ({}, ("mass", "external_force1", "external_force2"), ("external_force1", "external_force2")),
        ({"hand": None}, ("fx_hand", "external_force1", "imu_bias1"), ("fx_hand",)),
        ({}, ("imu_bias1",), ()),
    ],
)
def test_beside_forces_on_links_those_of_joints_are_no_pushes(wrenches, names, forces):
    file = covariant.models.load("oscillator")._replace(wrenches=wrenches)
    assert _outcome.force_names(file, names) == forces


@pytest.mark.exhaustive
def test_simulated_pushes_are_what_moves_the_machine():
    """The momentum of the exact motion shows the forces in the log, behind its lag."""
    stiff = {"parameters.stiffness": 4.0}
    log = covariant.simulate("oscillator", duration=8.0, rate=100.0, push=[0.6], q0=[0.3], overrides=stiff)
    assert log.force_columns == ("true_external_force1",)
    assert log.units["true_external_force1"] == "N"
    assert log.summary["force_columns"] == "true_external_force1"
    assert str(log).endswith("true forces are in true_external_force1")
    t, x, gain, force = log.record.t, log.record.x, 20.0, log.columns["true_external_force1"]
    seen = observed_forces(
        MomentumObserver(models.oscillator(stiffness=4.0), gain), t, log.record.u, x[:, :1], x[:, 1:]
    )
    share = -np.expm1(-gain * 0.01)
    np.testing.assert_allclose(seen[:, 0], lfilter([share], [1, share - 1], force), atol=0.02)
    assert covariant.simulate("oscillator", duration=0.5, rate=20.0).force_columns == ()
