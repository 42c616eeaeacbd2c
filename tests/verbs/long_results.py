"""What takes long of `test_results.py`."""

import ast
import json
import re

import numpy as np
import pytest
from commands import command, leave
from test_results import MODEL, log

import covariant
from scalargraph.errors import InputError

NOISE = {"measurement.std": 1e-3, "uncertainty.acceleration": 2.0}


SET = [word for key, value in NOISE.items() for word in ("--set", f"{key}={value}")]


@pytest.fixture(scope="module")
def estimate(log):
    return covariant.estimate(MODEL, log, overrides=NOISE, score=True)


def test_a_function_and_its_command_give_the_same_text_and_numbers(estimate, log, tmp_path):
    asked = ("estimate", MODEL, log, *SET, "--score")
    assert leave(*asked, "-o", tmp_path / "a.csv")[:2] == (0, f"{estimate}\nwrote {tmp_path / 'a.csv'}\n")
    assert command(*asked) == json.loads(json.dumps(estimate.summary))
    estimate.save(tmp_path / "b.csv")
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_an_estimate_is_a_table_with_units(estimate):
    table, dataset = estimate.to_pandas(), estimate.to_xarray()
    assert [*table] == ["t", "q1", "q2", "v1", "v2"]
    np.testing.assert_array_equal(table[["v1", "v2"]].to_numpy(), estimate.velocity)
    np.testing.assert_array_equal(dataset["v2"].to_numpy(), estimate.velocity[:, 1])
    assert dataset["v1"].attrs["units"] == "rad/s"
    assert estimate.units["t"] == "s"
    assert all(type(column) is np.ndarray for column in estimate.columns.values())


def test_a_result_is_short_where_it_is_looked_at(estimate, log):
    assert repr(estimate).startswith("<EstimateResult: velocity from 601 rows by intrinsic, RMSE ")
    assert len(repr(estimate)) < 200
    model = covariant.models.load("double_pendulum").model
    assert repr(model) == "<MechanicalSystem: shoulder [rad], elbow [rad]>"
    observer = covariant.observers.Intrinsic(model, alpha=3.0, beta=9.0)
    assert len(repr(observer).splitlines()) == 1
    assert "alpha=3.0" in repr(observer)


def test_a_notebook_shows_the_figure(estimate, log):
    pytest.importorskip("matplotlib")
    assert estimate.plot()._repr_png_().startswith(b"\x89PNG")
    assert '<img src="data:image/png;base64,iVBOR' in estimate._repr_html_()
    assert "<img" not in covariant.simulate("oscillator", duration=0.1)._repr_html_()


@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".parquet"])
def test_only_a_table_of_the_same_columns_is_replaced_unasked(estimate, tmp_path, suffix):
    path = tmp_path / f"v{suffix}"
    estimate.save(path, overwrite=False)
    estimate.save(path, overwrite=False)
    covariant.logs.write(path, {"t": np.arange(3.0), "q1": np.arange(3.0)})
    before = path.read_bytes()
    with pytest.raises(ValueError, match=f"v{suffix}: there is such a file already; write to another file, or say"):
        estimate.save(path, overwrite=False)
    assert path.read_bytes() == before
    estimate.save(path)
    assert path.read_bytes() != before


def test_it_is_said_where_an_estimate_had_no_measurement(estimate):
    missing = np.isnan(np.asarray(estimate.loaded.record.y)).any(axis=1)
    assert estimate.warnings[0].startswith(f"{missing.sum()} of 601 samples: no measurement")
    assert "the longest at t = " in estimate.warnings[0]
    begin = float(estimate.warnings[0].partition("the longest at t = ")[2].split()[0].rstrip(","))
    assert missing[np.argmin(np.abs(estimate.t - begin))]


@pytest.mark.exhaustive
def test_a_comparison_is_a_table_in_order_of_error(log, tmp_path):
    result = covariant.compare(MODEL, log, overrides=NOISE, until=1.0)
    table = result.to_pandas()
    assert [*table["estimator"]] == [*result.ranking]
    reference = result.loaded.reference
    size = np.sqrt(np.mean(reference.v[reference.scored] ** 2, axis=0))
    relative = np.linalg.norm(table[["v1_rmse", "v2_rmse"]].to_numpy() / size, axis=1)
    assert (np.diff(relative) >= 0).all()
    result.save(tmp_path / "table.csv")
    head = "rank,estimator,v1_rmse,v2_rmse,v1_median_error,v2_median_error,nis,nees,microseconds\n1,"
    assert (tmp_path / "table.csv").read_text().startswith(head)
    assert set(result.outcomes) == {row["estimator"] for row in result.summary["ranking"]}


@pytest.mark.parametrize("form", ["text", "json"])
def test_what_is_computed_is_saved_and_printed_although_the_page_cannot_be_drawn(form, log, tmp_path, monkeypatch):
    def fail(*_):
        raise InputError("no ink")

    monkeypatch.setattr("covariant.verbs.base.pages.write_report", fail)
    words = ("estimate", MODEL, log, *SET, "-o", tmp_path / "a.csv", "--report", tmp_path / "page.html")
    code, out, error = leave(*words, *(["--json"] if form == "json" else []))
    assert (code, "no ink" in error, "innovation" in out) == (2, True, True)
    assert (tmp_path / "a.csv").exists()
    if form == "json":
        assert json.loads(out)["report"] == []


def test_a_model_may_be_an_object(log):
    by_name = covariant.estimate(MODEL, log, alpha=20.0, beta=300.0)
    model = covariant.models.load(MODEL).model
    by_object = covariant.estimate(model, log, alpha=20.0, beta=300.0)
    by_file = covariant.estimate(covariant.models.load(MODEL, NOISE), log, alpha=20.0, beta=300.0)
    np.testing.assert_array_equal(by_name.velocity, by_object.velocity)
    assert by_object.summary["model"] == "Lagrangian"
    assert by_file.loaded.file.measurement_std == NOISE["measurement.std"]
    with pytest.raises(ValueError, match="Lagrangian: parameters is for models that are made from a file or by name"):
        covariant.estimate(model, log, overrides={"parameters.mass": [1.0, 2.0]})


def test_every_missing_number_is_named_at_once_with_what_the_log_suggests(log):
    with pytest.raises(ValueError, match=r"measurement\.std and uncertainty\.acceleration") as refusal:
        covariant.estimate(MODEL, log)
    settings = ast.literal_eval(re.search(r"suggests `overrides=(.*?)`", str(refusal.value))[1])
    suggested = dict(setting.split("=") for setting in settings)
    std = np.array(json.loads(suggested["measurement.std"]))
    np.testing.assert_allclose(std, 1e-3, rtol=0.2)  # the noise it was simulated with
    assert covariant.estimate(MODEL, log, overrides=settings).velocity.shape[1] == 2


def test_columns_may_be_lists_or_a_text(log):
    one = covariant.estimate(MODEL, log, alpha=9.0, beta=40.0, columns={"q": ["q1", "q2"]})
    two = covariant.estimate(MODEL, log, alpha=9.0, beta=40.0, columns={"q": "q1, q2"})
    np.testing.assert_array_equal(one.velocity, two.velocity)


def test_a_file_that_exists_is_replaced_only_where_that_is_allowed(estimate, tmp_path):
    results = {"estimate.csv": estimate, "log.csv": covariant.simulate("oscillator", duration=0.5, q0=1.0)}
    for name, result in results.items():
        path = tmp_path / name
        path.write_text("mine")
        with pytest.raises(ValueError, match="there is such a file already"):
            result.save(path, overwrite=False)
        assert path.read_text() == "mine"
        assert result.save(path).read_text() != "mine"
