"""What takes long of `test_fit_verb.py`."""

import json
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from test_fit_verb import DRIVEN, FIRST, TRUTH, driven, fitted

import covariant
from covariant import logs, models, simulation
from covariant.signals import Record
from covariant.verbs import fit, simulate
from covariant.verbs._fit import FitResult


@pytest.mark.exhaustive
def test_a_fit_to_a_simulated_log_gives_the_truth(fitted):
    _, result = fitted
    off = (result.values - [0.001, 0.5]) / result.standard_errors
    assert np.abs(off).max() < 3.0, (result.values, result.standard_errors)
    assert result.standard_errors[0] < 2e-4
    assert result.better


@pytest.mark.exhaustive
def test_the_way_inputs_go_between_stamps_is_found_named_and_written(fitted, tmp_path):
    word, result = fitted
    inputs = result.summary["inputs"]
    assert (inputs["between"], inputs["stated"]) == (word, False)
    assert inputs["log_likelihood_gain"] > 3 * inputs["gain_standard_error"] > 0
    assert inputs["sentence"] in str(result)
    assert "explain the log better" in inputs["sentence"]
    path = result.save(tmp_path / "calibrated.toml")
    assert models.load(str(path)).input_between == word
    assert f'between = "{word}"' in path.read_text()


@pytest.mark.exhaustive
def test_a_log_that_does_not_show_how_inputs_go_decides_nothing(tmp_path):
    """A torque so slow and small that it is the same held and linear, within the noise."""
    slow: dict[str, Any] = DRIVEN | {"frequency": 0.05, "amplitude": 0.02}
    log = simulate("pendulum_chain", **slow, overrides=TRUTH | {"inputs.between": "linear"})
    result = fit("pendulum_chain", log.record, ["length"], overrides=FIRST)
    inputs = result.summary["inputs"]
    assert inputs["between"] == "held"
    assert inputs["log_likelihood_gain"] < 2 * inputs["gain_standard_error"]
    assert "hardly tells that from linear" in inputs["sentence"]
    assert "between" not in result.save(tmp_path / "new.toml").read_text()


@pytest.mark.exhaustive
def test_what_the_model_file_says_is_not_tried_otherwise(tmp_path):
    log = driven(between="held").record
    result = fit("pendulum_chain", log, "viscous", overrides=FIRST | {"inputs.between": "linear"}, until=8.0)
    assert result.summary["inputs"] == {
        "between": "linear",
        "stated": True,
        "log_likelihood_gain": None,
        "gain_standard_error": None,
        "sentence": "",
    }


@pytest.mark.exhaustive
def test_a_log_without_inputs_says_nothing_of_them():
    swing = simulate("pendulum_chain", duration=12.0, rate=50.0, q0=1.0, noise=2e-4, overrides=TRUTH)
    calls = []

    def progress(description: str, fraction: float | None = None) -> None:
        calls.append((description, fraction))

    result = fit("pendulum_chain", swing.record, ["length"], overrides=FIRST, progress=progress)
    assert result.summary["inputs"]["log_likelihood_gain"] is None
    fractions = [fraction for _, fraction in calls if fraction is not None]
    assert fractions == sorted(fractions)
    assert (fractions[0], fractions[-1]) == (0.0, 1.0)
    table = result.to_pandas()
    assert list(table.columns) == ["parameter", "before", "after", "standard_error", "determined"]
    assert repr(result).startswith("<FitResult: length[0] = 0.5")


@pytest.mark.exhaustive
def test_masses_and_frictions_that_are_far_off_are_found_together():
    """By steps in the logarithms of these positive numbers the search ends where it begins."""
    held = {"inputs.between": "held"}
    known = {"parameters.length": [0.5, 0.4], "parameters.com": [0.25, 0.2]}
    true = {"viscous": [0.3, 0.1], "coulomb": [0.2, 0.05], "inertia": [0.02, 0.01], "mass": [1.0, 0.5]}
    first = {"viscous": [0.001, 0.001], "coulomb": [0.001, 0.001], "inertia": [0.002, 0.05], "mass": [0.2, 2.0]}
    motion: dict[str, Any] = {"q0": [0.8, -0.3], "amplitude": [2.0, 0.6], "noise": 2e-4, "seed": 3}
    truth, guess = (known | held | {f"parameters.{k}": v for k, v in numbers.items()} for numbers in (true, first))
    log = simulate("pendulum_chain", duration=20.0, rate=100.0, **motion, overrides=truth).record
    result = fit("pendulum_chain", log, list(true), overrides=guess, anyway=True)
    assert np.isfinite(result.standard_errors).all()
    np.testing.assert_allclose(result.values, np.concatenate(list(true.values())), rtol=0.05)


@pytest.mark.exhaustive
def test_outliers_do_not_hide_that_a_fit_predicts_worse():
    """A spring that is softer in the last third of the log: as soft as the model file says."""
    swing: dict[str, Any] = {"rate": 50.0, "noise": 1e-3}
    stiff = simulate("oscillator", duration=20.0, q0=1.0, **swing, overrides={"parameters.stiffness": 1.4})
    end = dict(zip(("q0", "v0"), np.asarray(stiff.record.x)[-1], strict=True))
    soft = simulate("oscillator", duration=10.0, **end, **swing, overrides={"parameters.stiffness": 1.0})
    y = np.concatenate([np.asarray(stiff.record.y), np.asarray(soft.record.y)[1:]])
    y[np.random.default_rng(0).choice(np.arange(1010, len(y)), 10, replace=False)] += 3.0
    log = Record(0.02 * np.arange(len(y)), np.zeros((len(y), 1)), y)
    result = fit("oscillator", log, "stiffness", overrides={"parameters.stiffness": 1.0}, anyway=True)
    assert result.values[0] == pytest.approx(1.4, rel=0.02)
    assert (result.better, result.exit_code) == (False, 1)
    assert result.summary["growth"] > 2


@pytest.mark.exhaustive
def test_short_flights_of_a_body_are_fitted_together(tmp_path):
    """Six of .6 s, of which one alone is too short to be held out; no force is logged."""
    body = models.free_body((1.0, 2.0, 3.5))
    stamps = 0.01 * np.arange(61)
    names = [f"r{i}{j}" for i in range(3) for j in range(3)]
    paths, random = [], np.random.default_rng(0)
    for k in range(6):
        start = models.Motion(jnp.eye(3), jnp.asarray(random.normal(0, 4, 3)))
        turned = simulation.simulate(body, start, jnp.asarray(stamps)).x.q
        paths.append(tmp_path / f"flight{k}.csv")
        logs.write(paths[-1], {"t": stamps, **dict(zip(names, np.asarray(turned).reshape(-1, 9).T, strict=True))})
    model = tmp_path / "body.toml"
    model.write_text(
        'system = "free_body"\n[parameters]\ninertia = [1.0, 2.4, 3.5]\n[columns]\nu = []\n'
        f"matrix = {json.dumps(names)}\n"
    )
    result = fit(model, paths, "inertia[1]")
    assert abs(result.values[0] - 2.0) < 0.02
    assert result.details["held_out"] == "the last 2 logs"
    head = result.save(tmp_path / "fitted.toml").read_text().splitlines()[0]
    assert "to flight0.csv, flight1.csv, flight2.csv, flight3.csv; " in head


@pytest.mark.parametrize(("verb", "named"), [(fit, {"parameters": "stiffness"}), (covariant.tune, {})])
def test_an_edit_while_the_model_is_read_is_refused(verb, named, tmp_path, monkeypatch):
    """Several readers of one file would see different texts."""
    path = tmp_path / "spring.toml"
    path.write_text('system = "oscillator"\n[parameters]\nstiffness = 1.0\n')
    log = simulate("oscillator", duration=10.0, rate=50.0, q0=1.0, noise=1e-3).record
    read = logs.read

    def edits(*args, **kwargs):
        path.write_text(path.read_text().replace("1.0", "1.1"))
        return read(*args, **kwargs)

    monkeypatch.setattr(logs, "read", edits)
    with pytest.raises(ValueError, match=r"spring.toml: it was changed while it was read; run the command again"):
        verb(path, log, **named)
