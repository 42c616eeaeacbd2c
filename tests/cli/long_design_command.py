"""`covariant design metric`: what it prints, how it goes on, and what it refuses: what takes long."""

import re
from pathlib import Path

import jax
import numpy as np
import pytest
from commands import command, leave
from test_design_command import SHAPE, folder, inside, refused

from covariant import metrics
from covariant.models import load, state_space
from covariant.verbs import _metric


def said(*arguments: str) -> str:
    """What the command prints for a person."""
    ended = leave("design", "metric", *arguments)
    assert (ended.code, ended.error) == (0, "")
    return ended.out


@pytest.fixture(scope="module")
def made(folder):
    """The summary of a metric over the model's own box, which is in paper.zarr."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return command("design", "metric", "unknown_frequency", *SHAPE, "--rate", "8", "-o", "paper.zarr")


@pytest.mark.exhaustive
def test_the_summary_is_that_of_the_store(made):
    store = metrics.open_grid("paper.zarr", complete=True)
    low, high = np.quantile(np.linalg.eigvalsh(store["metric"].values), [0, 1])
    assert {key: made[key] for key in ("model", "out", "points")} == {
        "model": "unknown_frequency",
        "out": "paper.zarr",
        "points": 125,
    }
    assert made["results"] == {"ok": 125}
    assert made["seconds"] > 0
    assert made["p_low"] == pytest.approx(low, rel=1e-6)
    assert made["p_high"] == pytest.approx(high, rel=1e-12)
    assert made["reconstructibility"] == store["reconstructibility"].values.min()
    assert made["error_bound"] == store["error_bound"].values.max() <= 1e-8
    assert store["x2"].values.tolist() == [1.0, 1.125, 1.25, 1.375, 1.5]
    assert store.attrs["provenance"]["equation"] == {"rate": 8.0, "process_cov": None, "measurement_cov": None}


@pytest.mark.exhaustive
def test_a_finished_store_is_summed_up_again_for_a_person(made):
    text = said("unknown_frequency", *SHAPE, "--rate", "8", "-o", "paper.zarr")
    first, codes, least, bounds, error_bound = text.splitlines()
    assert re.fullmatch(r"wrote paper\.zarr: 125 points, λ = 8 1/s, \d+\.\d s", first)
    assert codes == "  125 ok"
    assert least == f"smallest reconstructibility {made['reconstructibility']:.3g}"
    assert f"p_low = {made['p_low']:.3g}, p_high = {made['p_high']:.3g}" in bounds
    assert error_bound == f"largest error bound {made['error_bound']:.2g}"


@pytest.mark.exhaustive
def test_the_rate_may_come_from_gramians(made):
    done = command("design", "metric", "unknown_frequency", *SHAPE, "--window", "30", "-o", "window.zarr")
    assert 0.1 < done["rate"] < 1
    assert metrics.open_grid("window.zarr").attrs["provenance"]["equation"]["rate"] == done["rate"]


@pytest.mark.exhaustive
def test_options_reach_the_equation_of_a_mechanical_model(made):
    arguments = ("--box", "q=-1:1,q_dot=-2:2", "--grid", "4,5", "--process-cov", "1e-3,0.5", "--measurement-cov", "0.1")
    more = ("--domain", "q_dot=-2.5:2.5", "--input", "0.3", "--start", "2", "--tolerance", "1e-6")
    done = command("design", "metric", "oscillator", *arguments, *more, "-o", "spring.zarr")
    store = metrics.open_grid("spring.zarr", complete=True)
    assert store["metric"].shape == (4, 5, 2, 2)
    assert sum(done["results"].values()) == 20
    equation = metrics.Equation(
        process_cov=jax.numpy.diag(jax.numpy.array([1e-3, 0.5])), measurement_cov=jax.numpy.array([[0.1]])
    )
    model = state_space(load("oscillator").model)
    domain = jax.numpy.array([-np.inf, -2.5]), jax.numpy.array([np.inf, 2.5])
    x = jax.numpy.array([float(store["q"][2]), float(store["q_dot"][1])])
    expected = metrics.metric_at(model, equation, x, start=2.0, tolerance=1e-6, domain=domain, u=jax.numpy.array([0.3]))
    assert int(store["result"][2, 1]) == int(expected.result)
    np.testing.assert_allclose(store["metric"].values[2, 1], expected.metric, rtol=1e-8)  # each to 1e-6
    assert store.attrs["provenance"]["domain"] == [[None, -2.5], [None, 2.5]]
    assert store.attrs["provenance"]["u"] == [0.3]


@pytest.mark.exhaustive
def test_results_without_a_metric_are_told_in_words():
    """At rest the frequency cannot be told, and a point outside the domain has no metric."""
    box = ("--box", "x1=0:1,x2=0:1.5", "--domain", "x3=0.7:2")
    text = said("unknown_frequency", *SHAPE, *box, "--rate", "8", "-o", "rest.zarr")
    found = metrics.metric_summary("rest.zarr")
    assert sum(found.results.values()) == 125
    assert "  25 outside the domain: there is no metric\n" in text
    assert "  4 not reconstructible: the past output does not determine the state there\n" in text
    store = metrics.open_grid("rest.zarr")
    assert np.isnan(store["metric"].values[0, 0]).all()
    assert found.reconstructibility < 1e-9
    assert 0 < found.low < found.high


def interrupted(monkeypatch, blocks: int, *arguments: str) -> str:
    """Run the command, with Ctrl-C after so many blocks; return the line it prints."""
    solve = metrics.metric_on_grid

    def metric(*given, on_progress, **settings):
        calls = iter(range(blocks + 1))

        def stop(done, total):
            on_progress(done, total)
            if next(calls) == blocks:
                raise KeyboardInterrupt

        return solve(*given, on_progress=stop, **settings)

    with monkeypatch.context() as patch:
        patch.setattr(_metric, "metric_on_grid", metric)
        ended = leave("design", "metric", *arguments)
    assert (ended.code, ended.out) == (130, "")
    return ended.error


@pytest.mark.exhaustive
def test_a_stopped_run_goes_on_where_it_stopped(made, monkeypatch):
    arguments = ("unknown_frequency", *SHAPE, "--rate", "8", "--workers", "1", "-o", "again.zarr")
    line = interrupted(monkeypatch, 3, *arguments)
    assert re.fullmatch(
        r"covariant: stopped after \d+ of 125 points; the same command goes on where it stopped\n", line
    )
    kept = {path: path.stat().st_mtime_ns for path in Path("again.zarr/metric").rglob("*") if path.is_file()}
    with pytest.raises(ValueError, match="not complete"):
        metrics.load_metric("again.zarr")
    done = command("design", "metric", *arguments)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert {key: done[key] for key in ("results", "p_low", "p_high", "error_bound")} == {
        key: made[key] for key in ("results", "p_low", "p_high", "error_bound")
    }


def test_the_store_of_another_equation_is_left_alone(made):
    message = refused("unknown_frequency", *SHAPE, "--rate", "9", "-o", "paper.zarr")
    assert "paper.zarr holds another map: provenance.equation.rate is 8.0 there and 9.0 here" in message


def test_what_is_set_is_part_of_what_a_store_is_of(monkeypatch):
    spring = ("oscillator", "--box", "q=-1:1,q_dot=-2:2", "--grid", "4,5", "--rate", "1", "-o", "set.zarr")
    assert "after 0 of 20 points" in interrupted(monkeypatch, 0, *spring, "--set", "parameters.stiffness=2.0")
    refused(*spring, named=["parameters.stiffness", "2.0"])
