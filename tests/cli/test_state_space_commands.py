"""The commands on state-space models: a log of outputs, with the true states beside them."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from commands import command

from covariant import logs
from covariant.models import load
from covariant.simulation import hold, simulate


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_simulate_writes_outputs_inputs_and_the_true_state():
    done = command(
        *("simulate", "duffing", "-o", "log.csv", "--duration", "2", "--rate", "100", "--noise", "1e-2"),
        *("--q0", "0.5,-0.2", "--amplitude", "0.3", "--dropout", "0.1"),
    )
    assert (done["rows"], done["truth_columns"]) == (201, "true_q,true_q_dot")
    truth = tuple(done["truth_columns"].split(","))
    log = logs.read("log.csv", load("duffing").columns._replace(truth=truth))
    t, u, y = (jnp.asarray(part) for part in log.record[:3])
    header = Path("log.csv").read_text(encoding="utf-8").splitlines()[0]
    assert header.replace('"', "") == "t,q,u1,true_q,true_q_dot"
    np.testing.assert_array_equal(log.truth[0], [0.5, -0.2])
    seen = np.isfinite(y[:, 0])
    assert 150 < seen.sum() < 201
    assert 0.5e-2 < np.std(y[seen, 0] - log.truth[seen, 0]) < 2e-2
    # The input of the log, held between its stamps, gives nearly the same motion.
    again = simulate(load("duffing").model, jnp.asarray(log.truth[0]), t, hold(t, u)).x
    assert np.ptp(u) > 0.5
    np.testing.assert_allclose(again, log.truth, rtol=0, atol=1e-2)
