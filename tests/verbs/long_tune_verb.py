"""`covariant.tune` from Python: what it finds, saves and draws."""

import numpy as np
import pytest

from covariant import models
from covariant.verbs import simulate, tune
from covariant.verbs._tune import TuneResult

NOISE = {"measurement.std": 0.1, "uncertainty.acceleration": 9.0}


@pytest.fixture(scope="module")
def log():
    """An oscillator with noise of 0.2 mm, a gap of two seconds, and an outlier."""
    table = simulate("oscillator", duration=16.0, rate=50.0, q0=1.0, noise=2e-4).to_pandas()
    table.loc[300, "q"] = 7.0
    return table[(table["t"] < 4.0) | (table["t"] > 6.0)].reset_index(drop=True)


@pytest.fixture(scope="module")
def tuned(log) -> TuneResult:
    return tune("oscillator", log, overrides=NOISE)


@pytest.mark.exhaustive
def test_the_noise_of_a_table_is_found(tuned):
    assert tuned.lines["measurement"]["std"] == pytest.approx(2e-4, rel=0.2)
    assert tuned.tuning.after.likelihood > tuned.tuning.before.likelihood + 2
    assert tuned.summary["model"] == "oscillator"
    assert repr(tuned).startswith("<TuneResult: natural frequency ")


@pytest.mark.exhaustive
def test_the_new_file_is_saved_once(tuned, tmp_path):
    path = tuned.save(tmp_path / "tuned.toml")
    assert models.load(str(path)).measurement_std == tuned.lines["measurement"]["std"]
    written = path.read_text()
    with pytest.raises(ValueError, match="there is such a file already"):
        tuned.save(path)
    assert path.read_text() == written
    assert tuned.save(path, overwrite=True).read_text() == written


@pytest.mark.exhaustive
def test_a_force_that_is_forgotten_is_taken_out_where_there_is_none(log):
    fading = {"uncertainty.external_force_std": 0.3, "uncertainty.external_force_time": 0.5}
    result = tune("oscillator", log, overrides=NOISE | fading)
    assert set(result.lines["uncertainty"]) == {"acceleration", "correlation_time"}


@pytest.mark.exhaustive
@pytest.mark.parametrize("engine", ["c", "jax"])
def test_a_page_is_drawn_after_either_engine(log, tmp_path, engine):
    result = tune("oscillator", log, overrides=NOISE, engine=engine)
    assert f"engine: {result.summary['engine']}" in str(result)
    pages = result.report(tmp_path / "page.html")
    assert pages[0] == tmp_path / "page.html"
    assert all(page.stat().st_size > 1000 for page in pages)


@pytest.mark.exhaustive
def test_a_system_itself_is_tuned_and_has_no_file(log, tmp_path):
    result = tune(models.oscillator(), [log], overrides=NOISE)
    assert np.isfinite(result.tuning.natural_frequency)
    with pytest.raises(ValueError, match="the model has no file"):
        result.save(tmp_path / "tuned.toml")
    assert not list(tmp_path.iterdir())
