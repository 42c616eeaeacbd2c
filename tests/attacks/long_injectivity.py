"""What takes long of `test_injectivity.py`."""

import pytest
from systems import RATE, Q, line, wheel
from test_injectivity import PAIR, beyond_half_a_turn, damped, on

from covariant.certificates import certify


@pytest.mark.exhaustive
@pytest.mark.parametrize("error", [0.3, 3.0])
def test_smaller_errors_are_proved(error):
    for observer, bounds in ((wheel(damped), {}), (line(damped, circles=(0,)), {"position": (-3, 3)})):
        found = certify(observer, velocity=1.0, error=error, input=1.0, rate=RATE, q=Q, **bounds)
        assert found.statement.verdict == "holds"
        assert (beyond_half_a_turn(found.radius, error) < 1.02).all()


@pytest.mark.exhaustive
def test_a_product_of_small_errors_is_proved():
    assert on(PAIR, 0.3) == "holds"
