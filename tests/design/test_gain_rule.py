"""The rule for the gains against the stationary Riccati and Lyapunov equations."""

import numpy as np
import pytest
from scipy import linalg

from covariant import design


def test_gains_are_those_of_the_stationary_kalman_filter():
    std, rate, acceleration, time = 1e-3, 500.0, 2.0, 0.01
    found = design.gains(std, rate, acceleration, time)
    double, input_, output = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
    sensed, disturbed = std**2 / rate, 2 * acceleration**2 * time
    cov = linalg.solve_continuous_are(double.T, output.T, disturbed * input_ @ input_.T, np.array([[sensed]]))
    assert np.allclose((cov @ output.T / sensed)[:, 0], [found.alpha, found.beta], rtol=1e-8)
    assert np.allclose(np.sqrt(np.diag(cov)), [found.position_std, found.velocity_std], rtol=1e-8)


@pytest.mark.parametrize(("alpha", "beta"), [(3.0, 5.0), (10.0, 2.0)])
def test_predicted_errors_solve_the_lyapunov_equation(alpha, beta):
    error = np.array([[-alpha, 1.0], [-beta, 0.0]])
    noise = 0.3 * np.outer([alpha, beta], [alpha, beta]) + 0.7 * np.diag([0.0, 1.0])
    cov = linalg.solve_continuous_lyapunov(error, -noise)
    found = design.predict_errors(alpha, beta, 0.3, 0.7)
    assert np.allclose(np.sqrt(np.diag(cov)), [found.position_std, found.velocity_std])


def test_constant_acceleration_leaves_the_bias_it_should():
    error = np.array([[-3.0, 1.0], [-5.0, 0.0]])
    assert np.allclose(np.linalg.solve(error, [0.0, -2.0]), design.bias(3.0, 5.0, 2.0))


@pytest.mark.parametrize("name", ["measurement_std", "rate", "acceleration_std", "correlation_time", "damping"])
def test_gains_name_the_number_that_makes_no_sense(name):
    numbers = {"measurement_std": 1.0, "rate": 1.0, "acceleration_std": 1.0, "correlation_time": 1.0, "damping": 1.0}
    with pytest.raises(ValueError, match=name):
        design.gains(**(numbers | {name: -1.0}))
