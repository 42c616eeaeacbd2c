"""The benchmark of velocities: its scores on errors that are known, its search, and its checksums."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def velocity() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))
        from benchmarks.velocity import cases, estimators, scores, search

        yield SimpleNamespace(cases=cases, estimators=estimators, scores=scores, search=search)
        for name in [name for name in sys.modules if name.split(".")[0] == "benchmarks"]:
            del sys.modules[name]


@pytest.fixture
def case(velocity) -> Any:
    """A case of two joints, as far as scores read it."""
    t = np.arange(4000) / 100
    v = np.stack([np.cos(3 * t), 20 * np.cos(2 * t + 1)], axis=1)
    rows = t > 10
    return SimpleNamespace(t=t, v=v, judge=rows, tune=~rows, second=None)


def test_scores_of_errors_that_are_known(velocity, case):
    scores, size = velocity.scores.scores, np.sqrt(0.5) * np.array([1.0, 20.0])
    late = np.roll(case.v, 3, axis=0)
    assert_allclose(scores(case, late, None)["lag"], 0.03, atol=1e-3)
    assert "band" not in scores(case, late, None)
    noise = np.random.default_rng(0).normal(size=case.v.shape) * 0.02 * size
    found = scores(case, case.v + noise, np.broadcast_to(0.02 * size, case.v.shape))
    assert_allclose([found["error"], found["noise"]], 0.02, rtol=0.05)
    assert_allclose(found["band"], 0.95, atol=0.01)
    burst = np.zeros_like(case.v)
    burst[3000:3060, 0] = size[0]
    assert_allclose(scores(case, case.v + burst, None)["worst_tenth"], np.sqrt(0.5 * 60 / (3000 / 50) / 5), rtol=0.01)
    assert velocity.scores.relative_error(np.full_like(case.v, np.nan), case.v, case.judge) == np.inf


def test_a_ratio_has_its_interval(velocity, case):
    random = np.random.default_rng(1)
    first, second = (case.v + scale * random.normal(size=case.v.shape) for scale in (0.1, 0.2))
    value, low, high = velocity.scores.ratio(case, first, second)
    assert low < value < high < 1
    assert_allclose(value, 0.5, atol=0.03)


@pytest.mark.parametrize("best", [{"a": 0.3}, {"a": 0.3, "b": 20.0}])
def test_the_search_comes_near_the_best_numbers(velocity, case, best):
    class Known(velocity.estimators.AbstractEstimator):
        name = "known"

        def ranges(self, case):
            return {"a": (1e-2, 10.0), "b": (1.0, 1e3)} if "b" in best else {"a": (1e-2, 10.0)}

        def run(self, case, numbers, rows):
            off = [sum(np.log(one[name] / best[name]) ** 2 for name in best) ** 0.5 for one in numbers]
            return [velocity.estimators.Estimate(case.v * (1 + each)) for each in off]

    found = velocity.search.searched(Known(), case)
    assert_allclose(np.log(list(found.values())), np.log(list(best.values())), atol=0.1 if len(best) == 1 else 0.6)


def test_a_recording_must_have_its_checksum(velocity, tmp_path, monkeypatch):
    monkeypatch.setenv("COVARIANT_DATA", str(tmp_path))
    entry = {"name": "one", "file": "log.csv", "sha256": "0" * 64}
    assert velocity.cases.located(entry) is None
    (tmp_path / "log.csv").write_text("t,q\n0,0\n", encoding="utf-8")
    with pytest.raises(SystemExit, match=r"log.csv: its SHA-256 is [0-9a-f]{64}, but the manifest has 0{64}"):
        velocity.cases.located(entry)


def test_every_twin_is_judged_and_every_span_is_apart(velocity):
    entries = velocity.cases.entries().values()
    from benchmarks.twins import TWINS

    assert {entry["twin"] for entry in entries if "twin" in entry} == set(TWINS)
    assert all(entry["tune"][1] < entry["judge"][0] for entry in entries if "tune" in entry)


def test_the_page_is_not_written_from_some_of_the_logs(tmp_path):
    """Its tables would be replaced by those of one log."""
    results = ROOT / "benchmarks" / "velocity" / "results.json"
    before = results.read_bytes()
    command = [sys.executable, "-m", "benchmarks.velocity", "--page", "double pendulum 05"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COVARIANT_DATA": str(tmp_path)}
    run = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert "run --page without names" in run.stderr
    assert results.read_bytes() == before
