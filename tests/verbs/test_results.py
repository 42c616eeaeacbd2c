"""Results of `estimate` and `compare`: the same numbers by function and by command, complete before they are drawn."""

import dataclasses

import numpy as np
import pytest
from commands import leave

import covariant

MODEL = "pendulum_chain"


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("logs") / "log.csv"
    motion = ("--duration", "1.2", "--noise", "1e-3", "--q0", "0.5,-0.3", "--dropout", ".02")
    assert leave("simulate", MODEL, "-o", path, *motion).code == 0
    return path


@pytest.mark.parametrize(("beta", "said"), [(0.01, True), (100.0, False)])
def test_gains_that_are_larger_at_first_for_long_are_said(log, beta, said):
    """Else two pairs of slow gains would give the same numbers without a reason."""
    noise = {"measurement.std": 1e-3, "uncertainty.acceleration": 1.0}
    given = {"alpha": 2 * beta**0.5, "beta": beta, "overrides": noise}
    result = covariant.estimate(MODEL, log, **given, engine="jax")
    assert ("In the first 24.5 s gains are larger" in str(result)) == said
    assert (result.outcome.observer.start_length > 1) == said


def test_a_notebook_shows_tables_warnings_and_links(tmp_path):
    @dataclasses.dataclass(frozen=True, repr=False)
    class Shown(covariant.verbs.AbstractResult):
        summary, headline, warnings = {}, "one <row>", ("x < 3",)

        def __str__(self):
            return "| a_std | b |\n|---|---|\n| 1 | *2* |\n\n<script>\nx < 3"

        def _write_page(self, path):
            return [path]

    text = Shown()._repr_html_()
    assert "<td>*2*</td>" in text
    assert "<script>" not in text
    assert "<b>one &lt;row&gt;</b>" in text
    assert text.count("x &lt; 3") == 1
    written = Shown().report(tmp_path / "a b.html")
    assert written == [tmp_path / "a b.html"]
    assert 'a b.html">' in written._repr_html_()


def test_a_log_with_the_columns_of_the_result_is_not_taken_for_one(tmp_path):
    names = ("mine.csv", "other.csv")
    t = np.arange(0.0, 4.0, 0.02)
    for name in names:
        covariant.logs.write(tmp_path / name, {"t": t, "q1": np.cos(t), "v1": -np.sin(t)})
    log, columns = str(tmp_path / "mine.csv"), {"q": "q1", "u": "v1"}
    result = covariant.estimate("oscillator", log, alpha=40.0, beta=800.0, columns=columns, anyway=True)
    assert list(result.columns) == ["t", "q", "v"]
    with pytest.raises(ValueError, match=r"other.csv: there is such a file already"):
        result.save(tmp_path / "other.csv", overwrite=False)
    with pytest.raises(ValueError, match=r"mine.csv: this is the log itself"):
        result.save(tmp_path / "mine.csv")
