"""What is drawn, and how much of it is shown: what takes long."""

import numpy as np
from hypothesis import given, settings, strategies as st
from test_report_panels import panel

from covariant.report._condensed import NUMBERS, condensed
from covariant.report._panels import Curve, Quantity


@settings(max_examples=20)
@given(st.integers(NUMBERS + 1, 2 * NUMBERS), st.integers(0, 99))
def test_thinned_curves_keep_extremes_and_long_gaps(samples, seed):
    rng = np.random.default_rng(seed)
    t, y = np.arange(samples, dtype=float), rng.standard_normal(samples)
    y[rng.integers(0, samples // 2, 2)] = 50.0, -60.0
    y[samples // 2 : samples // 2 + samples // 10] = np.nan
    long = Quantity("panel", "Panel", ("y",), (Curve(t, y[:, None], "one"),), np.ones(1))
    (line,) = condensed({"panel": long})["panel"].curves
    assert len(line.t) <= NUMBERS + 2
    assert (np.diff(line.t) > 0).all()
    assert (np.nanmax(line.values), np.nanmin(line.values)) == (np.nanmax(y), np.nanmin(y))
    assert np.isnan(line.values).any()
    assert np.isin(line.values[np.isfinite(line.values)], y).all()
