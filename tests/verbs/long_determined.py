"""Which slow states a log determines, alone and in combination."""

import pandas
import pytest

import covariant

WHEEL = """
system = "pendulum_chain"
[parameters]
mass = [1.0]
length = [0.5]
gravity = 0.0
[columns]
q = ["q1"]
[measurement]
std = 2e-3
bias = 0.1
[uncertainty]
acceleration = 1.0
correlation_time = 0.02
[sensors.rate]
kind = "tachometer"
of = ["q1"]
columns = ["rate"]
std = 0.01
bias = 0.2
[sensors.motor]
kind = "encoder"
of = ["q1"]
columns = ["motor"]
reduction = 20.0
std = 1e-2
bias = 2.0
"""


@pytest.mark.exhaustive
def test_only_the_difference_of_two_offsets_is_determined(tmp_path):
    """Without gravity no motion shows where zero is; two encoders show how far their zeros are apart."""
    path = tmp_path / "wheel.toml"
    path.write_text(WHEEL)
    log = covariant.simulate(str(path), duration=2.0, rate=50.0, v0=[1.0], noise=2e-3, seed=1)
    result = covariant.estimate(str(path), pandas.DataFrame(log.columns), observer="intrinsic-kalman")
    found = {each.name: each for each in result.determined}
    # A rate of 2 s of positions with noise: its bias is known to much less than 0.2 rad/s.
    assert found["rate_bias"].ratio < 0.05
    assert found["rate_bias"].unit == "rad/s"
    # Half the variance of each is the difference, which is known; the sum is as at first.
    assert found["bias1"].ratio == pytest.approx(0.5**0.5, rel=0.02)
    assert found["motor_bias"].ratio == pytest.approx(0.5**0.5, rel=0.02)
    assert found["bias1 + motor_bias"].ratio == pytest.approx(1.0, abs=0.01)
    assert found["bias1 - motor_bias"].ratio < 0.05
    text = str(result)
    assert "bias1 + motor_bias: not determined (nothing in the log shows it)" in text
    assert "rate_bias: determined to" in text
    assert [each["name"] for each in result.summary["determined"]] == list(found)
