"""What takes long of `test_every_observer.py`."""

import pytest
from test_every_observer import allowed, each, followed, relative_error, seen

from covariant.signals import StepCode


@pytest.mark.exhaustive(
    "pll-ball and beam",
    "high-gain-ball and beam",
    "body on SO(3)",
    "copy",
    "ekf",
    "filtered",
    "geodesic",
    "intrinsic",
    "intrinsic2",
    "kalman",
    "ukf",
)
@each
def test_from_rest_it_finds_the_motion_at_irregular_stamps(entry, name):
    v, _, codes = followed(entry, name, seen(name).y)
    assert relative_error(entry, name, v, slice(1)) > 0.1
    assert relative_error(entry, name, v) < allowed(entry)
    assert set(codes) == {StepCode.OK}
