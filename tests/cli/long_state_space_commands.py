"""The commands on state-space models: a log of outputs, with the true states beside them: what takes long."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from commands import command, unpacked
from test_state_space_commands import folder

from covariant import logs
from covariant.models import load
from covariant.simulation import hold, simulate


@pytest.mark.exhaustive
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
    # The input of the log, held between its stamps, gives the same motion.
    again = simulate(load("duffing").model, jnp.asarray(log.truth[0]), t, hold(t, u)).x
    assert np.ptp(u) > 0.5
    np.testing.assert_allclose(again, log.truth, rtol=0, atol=1e-8)


NOISY = """
system = "duffing"
[measurement]
std = 1e-2
[uncertainty]
process = [1e-3, 5e-2]
[initial]
std = 1.0
"""


TRUTH = ("--truth", "true_q,true_q_dot")


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """The text of a log of the model, simulated once."""
    folder = tmp_path_factory.mktemp("simulated")
    (folder / "model.toml").write_text(NOISY)
    start = ("--q0", "0.5,-0.2", "--amplitude", "0.3", "--noise", "1e-2")
    out = str(folder / "log.csv")
    command("simulate", str(folder / "model.toml"), "-o", out, "--duration", "4", "--rate", "100", *start)
    return Path(out).read_text()


@pytest.fixture
def log(simulated):
    Path("model.toml").write_text(NOISY)
    Path("log.csv").write_text(simulated)
    return "log.csv"


@pytest.mark.exhaustive
def test_estimate_writes_states_and_how_certain_they_are(log):
    words = ("-o", "states.csv", "--report", "page.html", "--engine", "jax")
    done = command("estimate", "model.toml", log, *words, *TRUTH)
    assert done["observer"] == "covariance-ekf"
    assert done["scored_against"] == "true state"
    assert Path("states.csv").read_text().splitlines()[0] == "t,q,q_dot,q_std,q_dot_std"
    assert np.all(np.array(done["state_rmse"]) < [5e-3, 0.1])
    assert 0.8 < done["nis"] < 1.2
    assert 0.1 < done["nees"] < 2.5
    assert "State error" in unpacked(Path("page.html").read_text(), "figures")
    assert Path("page_velocity.png").exists()
    known = logs.read("states.csv", logs.Columns(q=("q", "q_dot"), v=("q_std", "q_dot_std")))
    true = logs.read(log, load("model.toml").columns._replace(truth=("true_q", "true_q_dot"))).truth
    # The last second: errors are as large as the filter says.
    off = (np.asarray(known.record.y) - true)[-100:] / known.v[-100:]
    assert np.sqrt(np.mean(off**2)) < 2.0


@pytest.mark.exhaustive
def test_compare_ranks_by_the_states_or_by_the_outputs(log):
    with_truth = command("compare", "model.toml", log, "-o", "table.csv", *TRUTH)
    names = {row["estimator"] for row in with_truth["ranking"]}
    assert names == {"covariance-ekf", "information-ekf", "riccati"}
    assert all(np.all(np.array(row["state_rmse"]) < [0.01, 0.1]) for row in with_truth["ranking"]), with_truth[
        "ranking"
    ]
    assert Path("table.csv").read_text().startswith("rank,estimator,q_rmse,q_dot_rmse,q_median_error,")
    without = command("compare", "model.toml", log)
    assert without["scored_against"] == "outputs, one sample ahead"
    assert without["design"] == with_truth["design"]
