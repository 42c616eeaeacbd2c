"""`covariant.simulate` from Python: its record, its tables, and the units of the model file."""

import numpy as np
import pytest

from covariant.workflow import simulate

ARM = {
    "columns.q": ["shoulder", "elbow"],
    "units.q": ["deg", "mrad"],
    "parameters.mass": [1.0, 0.5],
    "parameters.length": [0.5, 0.4],
}


@pytest.mark.core(2)
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"amplitude": [1.0]}, r"amplitude needs 2 finite numbers, for u1, u2; got 1"),
        ({"amplitude": [np.nan, 1.0]}, "amplitude must be finite numbers; got nan, 1"),
        ({"quantum": [1e-3, 1e-3, 1e-3]}, "quantum needs one number, or 2 finite numbers, for shoulder, elbow"),
        ({"quantum": -1e-3}, "quantum: bounds must not be negative"),
        ({"duration": 0.0}, "0.0 s at 500.0 Hz do not hold two samples"),
        ({"rate": -5.0}, "rate must be positive .*-5"),
        ({"seed": -1}, "seed must be a whole number ≥ 0; got -1"),
        ({"q0": "up"}, "q0: 'up' is not a list of numbers"),
    ],
)
def test_arguments_that_make_no_sense_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        simulate("pendulum_chain", overrides=ARM, **arguments)
