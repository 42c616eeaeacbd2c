"""The default after `tune` on simulated twins of machines, beside the best gains that a search finds on judged rows."""

import runpy
from pathlib import Path

import pytest
from numpy.testing import assert_array_less

import covariant

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def bench(tmp_path_factory) -> dict:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        return runpy.run_path(str(BENCHMARKS / "degraded.py"))


@pytest.mark.exhaustive
@pytest.mark.parametrize(("name", "most"), [("acrobot late", 1.05), ("passive elbow", 1.05)])
def test_the_tuned_default_is_near_the_best_constant_gains(bench, name, most):
    twin = bench["TWINS"][name]()
    log = bench["FAULTS"]["none"](twin, None)
    model, sheet = twin.file.model, bench["DataSheet"](twin.std, 1.0)
    result = covariant.tune(twin.file, log.record, anyway=True)
    tuned = covariant.estimate(bench["with_lines"](twin.file, result.lines), log.record, anyway=True)
    family = next(bench["informed"](log, model, result.tuning, sheet._replace(speed=1.0)))
    best = family.searched(log, model)
    assert_array_less(log.error(tuned.velocity), most * best)
    assert_array_less(log.error(tuned.velocity), bench["best_polynomial"](log))
