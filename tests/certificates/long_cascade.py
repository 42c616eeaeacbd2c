"""What takes long of `test_cascade.py`."""

import pytest
from test_cascade import built


@pytest.mark.exhaustive
def test_printed_verdict_depends_on_units_and_the_weighted_one_does_not():
    units = (("m", "rad/s"), ("m", "rad/s"))
    found = built(gain=0.2, units=units)
    assert found.printed
    assert found.depends_on_units
    assert "depends on units" in str(found)
    assert found.verdict == "holds"
    for gain in (0.01, 100.0):
        assert built(gain=gain).verdict == "holds"
    assert not built(gain=100.0).printed
