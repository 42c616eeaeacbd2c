"""Pushes of `simulate`, and `compare --force`: whose estimates of them are best, and what it refuses."""

import json
import re
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models, workflow
from covariant.cli import main
from covariant.observers import IntrinsicKalman, MomentumObserver, external_force, observed_forces, wrench
from covariant.workflow._compare_force import _Force
from covariant.workflow._force_rivals import _held, _lagged
from covariant.workflow._simulated_log import pushes

FORCES = "true_external_force1"
NOISE = {"measurement.std": 1e-4, "uncertainty.acceleration": 0.1}
PUSHES = NOISE | {"uncertainty.external_force_std": 0.3, "uncertainty.external_force_time": 0.3}
MODEL = """
system = "oscillator"
[parameters]
stiffness = 4.0
[units]
q = "mm"
truth = "mm/s"
[measurement]
std = 1e-4
[uncertainty]
acceleration = 0.1
external_force_std = 0.3
external_force_time = 0.3
"""


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    folder = tmp_path_factory.mktemp("force")
    (folder / "model.toml").write_text(MODEL, encoding="utf-8")
    simulated = workflow.simulate(folder / "model.toml", duration=8.0, rate=100.0, noise=1e-4, push=[0.6], q0=[0.3])
    log = simulated.save(folder / "log.csv")
    return workflow.compare_force(folder / "model.toml", log, FORCES), simulated, folder


@pytest.mark.exhaustive
def test_simulated_pushes_are_what_moves_the_machine(compared):
    """The momentum of the exact motion shows the forces in the log, behind its lag."""
    _, log, _ = compared
    assert log.force_columns == (FORCES,)
    assert log.units[FORCES] == "N"
    assert log.summary["force_columns"] == FORCES
    assert str(log).endswith(f"forces against --force {FORCES}")
    t, x = log.record.t, log.record.x
    model, gain, force = models.oscillator(stiffness=4.0), 20.0, log.columns[FORCES][:, None]
    seen = observed_forces(MomentumObserver(model, gain), t, log.record.u, x[:, :1], x[:, 1:])
    np.testing.assert_allclose(seen, _lagged(jnp.asarray(t), jnp.asarray(force), jnp.asarray(1 / gain)), atol=0.02)
    assert workflow.simulate("oscillator", duration=0.5, rate=20.0).force_columns == ()


def test_pushes_are_on_each_joint_in_turn_and_change_sign():
    times = jnp.array([0.5, 1.0, 1.5, 2.0, 2.5, 3.5, 5.5, 7.5, 9.5])
    forces = np.stack([pushes(t, jnp.array([0.5, 0.2])) for t in times])
    first, second = [0, 0, 0.5, 0, 0, 0, -0.5, 0, 0.5], [0, 0, 0, 0, 0, 0.2, 0, -0.2, 0]
    np.testing.assert_allclose(forces, np.stack([first, second], axis=1), atol=1e-12)


@pytest.mark.exhaustive
def test_the_filter_is_best_and_its_band_holds(compared):
    result, simulated, _ = compared
    names = list(result.estimates)
    assert names[:2] == ["intrinsic-kalman, forgotten", "intrinsic-kalman, random walk"]
    assert [name.split(",")[0] for name in names[2:]] == ["momentum observer", "momentum observer", "inverse dynamics"]
    errors = result.columns["external_force1_rmse"]
    assert errors[0] < 0.8 * errors[3] < 0.8 * errors[2]
    np.testing.assert_allclose(result.true[:, 0], simulated.columns[FORCES], atol=1e-12)  # no unit of velocities
    own = np.sqrt(np.mean((result.estimates[names[0]].force - result.true)[result.scored] ** 2))
    np.testing.assert_allclose(errors[0], own)
    assert 0.9 < result.columns["within_band"][0] <= 1.0
    assert np.isnan(result.columns["within_band"][2:]).all()
    assert result.units == {"external_force1_rmse": "N"}


@pytest.mark.exhaustive
def test_its_forces_are_those_of_estimate(compared):
    result, _, folder = compared
    best = result.estimates["intrinsic-kalman, forgotten"]
    estimate = workflow.estimate(folder / "model.toml", folder / "log.csv", observer="intrinsic-kalman", engine="jax")
    np.testing.assert_allclose(best.force[:, 0], estimate.columns["external_force1"], atol=1e-12)
    np.testing.assert_allclose(best.std[:, 0], estimate.columns["external_force1_std"], rtol=1e-9)


@pytest.mark.long
def test_the_command_prints_and_writes_it(compared, monkeypatch, capsys):
    result, _, folder = compared
    monkeypatch.chdir(folder)
    monkeypatch.setattr(
        sys, "argv", ["covariant", "compare", "model.toml", "log.csv", "--force", FORCES, "-o", "t.csv"]
    )
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    out = capsys.readouterr().out
    assert f"RMSE {FORCES} [N]" in out
    assert "none: the size of the truth" in out
    rows = (folder / "t.csv").read_text().splitlines()
    assert len(rows) == 6
    assert rows[0] == "estimator,external_force1_rmse,within_band,nis"
    assert json.dumps(result.summary)


@pytest.mark.long
def test_forces_on_links_are_scored_as_the_joints_feel_them():
    arm = models.robots.load("double_pendulum")
    slow = (wrench(arm.space, "lower", [2.0, 0.0, 2.0], time=0.5), external_force(std=[0.1, 0.1], time=0.5))
    kalman = IntrinsicKalman(arm, 1e-4, 1e-8 * jnp.eye(2), jnp.eye(2), slow, substeps=1)
    state = kalman.init(jnp.array([0.4, 0.9]))._replace(slow=jnp.array([1.0, -0.5, 7.0, 7.0]))
    force, std = jnp.split(_Force(kalman, (True, False)).estimate(state), 2)
    felt = slow[0].force
    assert felt is not None
    np.testing.assert_allclose(force, felt(state.q, state.v, state.slow[:2]), rtol=1e-12)
    jacobian = np.stack([felt(state.q, state.v, axis) for axis in jnp.eye(2)], axis=1)
    np.testing.assert_allclose(std, np.sqrt(np.diag(jacobian @ (4.0 * np.eye(2)) @ jacobian.T)), rtol=1e-6)


def test_missing_inputs_are_held():
    np.testing.assert_array_equal(_held(np.array([[np.nan], [1.0], [np.nan], [2.0]])), [[0.0], [1.0], [1.0], [2.0]])


REFUSED = [
    ({"force": "true_external_force1,true_v1"}, "`force` names 2 columns, and oscillator has 1 velocities"),
    ({"overrides": NOISE}, "estimate no force; give `overrides=['uncertainty.external_force_std=NUMBER', "),
    ({"columns": {"truth": "true_v1"}}, '`columns["truth"]` names true velocities'),
    ({"overrides": PUSHES | {"measurement.delay": 0.01}}, "read late"),
    ({"force": "absent"}, "absent"),
]


@pytest.mark.long("given0")
@pytest.mark.parametrize(("given", "message"), REFUSED)
def test_what_cannot_be_compared_is_refused(given, message):
    log = workflow.simulate("oscillator", duration=2.0, rate=50.0, noise=1e-4, push=[0.6]).to_pandas()
    arguments = {"force": FORCES, "overrides": PUSHES} | given
    with pytest.raises(ValueError, match=re.escape(message)):
        workflow.compare_force("oscillator", log, **arguments)


def test_pushes_need_a_mechanical_model_and_a_force_for_each_velocity():
    with pytest.raises(ValueError, match="push needs 2 finite numbers"):
        workflow.simulate("pendulum_chain", duration=1.0, push=[1.0])
    with pytest.raises(ValueError, match="pushes are for mechanical ones"):
        workflow.simulate("duffing", duration=1.0, push=[1.0])
