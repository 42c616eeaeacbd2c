"""In the loop of a controller: the exported observer that estimates an unknown force, against a filtered difference."""

import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest

loop = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "loop.py"))


@pytest.mark.exhaustive
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")
def test_equal_ripple_allows_a_higher_gain(tmp_path, monkeypatch):
    """At less ripple 1.8 times the gain and half of the tracking error, on an arm that tuned neither."""
    monkeypatch.syspath_prepend(tmp_path)
    folder, poles, bandwidth = str(tmp_path), loop["poles"], {"bandwidth": 2 * np.pi * 17.5}
    arm, difference = loop["panda"](folder), loop["exported"]("panda", folder, "filtered-derivative", ["bandwidth"])
    rival = loop["run"](lambda: difference.Observer(bandwidth), 105.0, seed=20)
    own = loop["run"](lambda: arm.Observer(poles(100.0, 1.0)), 1.8 * 105.0, seed=20)
    without = loop["run"](lambda: arm.Observer(poles(215.0, 0.0)), 1.8 * 105.0, seed=20)
    assert own.ripple < rival.ripple
    assert own.tracking < rival.tracking / 2
    assert without.tracking > 1.5 * own.tracking
