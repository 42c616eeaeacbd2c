"""In the loop of a controller: the exported observer that estimates an unknown force, against a filtered difference."""

import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest

from covariant.observers import FilteredDerivative

loop = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "loop.py"))


@pytest.mark.long
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")
def test_equal_ripple_allows_a_higher_gain(tmp_path, monkeypatch):
    """Twice the gain, with a third of the tracking error; without its force the observer tracks worst."""
    monkeypatch.syspath_prepend(tmp_path)
    arm = loop["exported"](str(tmp_path / "c"))
    rival = loop["run"](lambda: loop["Source"](FilteredDerivative(2 * np.pi * 20)), 75.0)
    found = loop["run"](loop["with_force"](arm), 150.0)
    without = loop["run"](loop["with_force"](arm, third=0.0), 150.0)
    assert found.ripple < rival.ripple
    assert found.tracking < rival.tracking / 3
    assert without.tracking > 2 * found.tracking
