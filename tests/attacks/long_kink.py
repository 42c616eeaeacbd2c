"""What takes long of `test_kink.py`."""

import pytest
from systems import Case, falsehood, on_any_circle, verdict, wheel


def test_friction_that_brakes_on_both_sides_is_proved_on_a_group():
    case = on_any_circle(Case(lambda xp, g, v: -v * xp.abs(v), size=1e-3))
    assert falsehood(case, on_group=True) < 1.01
    assert verdict(wheel(case.law), velocity=1.0, error=0.5, input=1.0) == "holds"
