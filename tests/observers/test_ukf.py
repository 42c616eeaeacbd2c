"""The unscented Kalman filter where nothing is linear: against the EKF, and against Monte Carlo."""

import numpy as np
import pytest
from plants import MEASUREMENT, PROCESS, masses

from covariant.observers import UKF


@pytest.mark.long("wrong2")
@pytest.mark.parametrize("wrong", [{"spread": 0.3}, {"process_cov": -np.eye(2)}, {"measurement_cov": np.zeros((2, 2))}])
def test_what_is_no_covariance_is_refused(wrong):
    with pytest.raises(ValueError, match=f"UKF: {next(iter(wrong))} must"):
        UKF(masses(), **({"process_cov": PROCESS, "measurement_cov": MEASUREMENT} | wrong))
