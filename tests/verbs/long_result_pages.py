"""What takes long of `test_result_pages.py`."""

import re

import numpy as np
import pytest
from test_result_pages import text_of

import covariant

FORCE = {"uncertainty.external_force_std": 1.0, "uncertainty.external_force_time": 0.3}


NOISE = {"measurement.std": 1e-4, "uncertainty.acceleration": 0.1}


@pytest.mark.exhaustive
def test_pages_of_a_filter_and_its_smoother_show_pushes_forces_and_the_difference(tmp_path):
    log = covariant.simulate("oscillator", duration=4.0, rate=100.0, noise=1e-4, push=[3.0]).record
    log = log._replace(y=np.where(np.arange(401)[:, None] % 50 == 10, np.nan, log.y))
    estimated = covariant.estimate("oscillator", log, observer="intrinsic-kalman", overrides=NOISE | FORCE)
    page = estimated._page()
    assert page.along.units == ("N",)
    assert page.marks["no measurement"].sum() == 8
    assert 2 <= len(page.shaded) <= 4
    begin, end = page.shaded.T
    rows = estimated.pushes.rows
    assert rows[((estimated.t[:, None] >= begin) & (estimated.t[:, None] <= end)).any(1)].mean() > 0.9
    assert np.isnan(page.innovation["intrinsic-kalman"][10]).all()
    smoothed = covariant.smooth("oscillator", log, overrides=NOISE | FORCE)._page()
    assert list(smoothed.innovation) == ["intrinsic-kalman"]
    paths = covariant.smooth("oscillator", log, overrides=NOISE | FORCE).report(tmp_path / "smooth.html")
    assert paths[0].stat().st_size < 3e6
    assert "Difference to the smoothed one" not in text_of(paths[0])  # in the figures, which are packed


@pytest.mark.exhaustive
def test_a_page_of_a_comparison_shows_four_curves_and_says_who_is_as_good(tmp_path):
    log = covariant.simulate("oscillator", duration=2.0, rate=100.0, noise=1e-4, q0=[1.0]).record
    result = covariant.compare("oscillator", log, overrides=NOISE)
    text = result.report(tmp_path / "compare.html")[0].read_text("utf-8")
    assert len(re.findall('aria-pressed="true"', text)) == 4 + 1 + (result.loaded.reference is not None)
    assert text.count('<tr class="best">') == len(result._equals)
    assert "with the model differ by" in text
    assert all(outcome.microseconds > 0 for outcome in result.outcomes.values())
