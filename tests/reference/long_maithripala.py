"""The heavy top of Maithripala, Berg & Dayawansa 2004, and what their misprints do to it."""

import numpy as np
import pytest

from covariant.papers import maithripala
from covariant.report import write_article


@pytest.fixture(scope="module")
def results():
    return maithripala.reproduce()


@pytest.mark.exhaustive
def test_velocity_error_decays_at_the_rate_of_the_theory(results):
    """The slow root of s² + αs + β: 0.513 1/s with the doubled α, 1.127 1/s otherwise."""
    top = results["top"]
    assert top["rate_doubled"] == pytest.approx(0.513, rel=0.01)
    assert top["rate"] == pytest.approx(1.127, rel=0.01)
    assert top["theory_doubled"] == pytest.approx(10 - np.sqrt(90), rel=1e-12)
    assert len(top["t"]) == len(top["error"]) == len(top["error_doubled"])
    assert top["error"][0] > 5
    assert top["error"][-1] < 1e-8


@pytest.mark.exhaustive
def test_the_simulated_top_keeps_what_it_must(results):
    assert max(results["top"]["conserved"].values()) < 1e-9


@pytest.mark.exhaustive
def test_the_print_converges_on_a_top_and_fails_on_a_disc(results):
    printed = results["printed"]
    assert printed["top"]["printed"] < 0.05
    assert printed["disc"]["corrected"] == pytest.approx(0.061, rel=0.02)
    assert printed["disc"]["printed"] == pytest.approx(1.4, rel=0.05)


def test_the_group_logarithm_is_too_long_and_aside(results):
    one, two = results["logarithm"]["1 rad"], results["logarithm"]["2 rad"]
    assert one["too_long_largest"] == pytest.approx(0.016, rel=0.05)
    assert one["degrees_largest"] == pytest.approx(17.7, rel=0.03)
    assert two["too_long_largest"] == pytest.approx(0.067, rel=0.05)
    assert two["degrees_largest"] == pytest.approx(36.0, rel=0.03)
    assert one["too_long_largest"] > one["too_long_mean"] > 0


@pytest.mark.exhaustive
def test_everything_is_ready_for_json(results):
    import json

    assert json.loads(json.dumps(results))["top"]["rate"] == results["top"]["rate"]


@pytest.mark.exhaustive
def test_page_and_figures_are_written(results, tmp_path):
    figures = maithripala.draw(tmp_path / "top.png")
    page = write_article(maithripala.TITLE, maithripala.page(results, figures), tmp_path / "top.html")
    assert all(path.stat().st_size > 10_000 for path in (*figures, page))
