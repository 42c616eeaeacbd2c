"""The rule for the gains against the stationary Riccati and Lyapunov equations."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import linalg

from covariant import calibration
from covariant.models import Lagrangian
from covariant.observers import Intrinsic, run
from covariant.signals import Record


def test_gains_are_those_of_the_stationary_kalman_filter():
    std, rate, acceleration, time = 1e-3, 500.0, 2.0, 0.01
    found = calibration.gains(std, rate, acceleration, time)
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
    found = calibration.predict_errors(alpha, beta, 0.3, 0.7)
    assert np.allclose(np.sqrt(np.diag(cov)), [found.position_std, found.velocity_std])


def test_predicted_errors_of_a_sampled_observer_are_those_of_its_runs():
    """A mass that random forces push, seen by the observer; and fast samples as in the differential law."""
    alpha, beta, rate, std, density = 8.0, 25.0, 5.0, 0.1, 0.02
    rng, count, dt = np.random.default_rng(0), 4000, 1 / rate
    spread = density * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    pushes = rng.normal(size=(count, 2)) @ np.linalg.cholesky(spread).T
    x = [np.zeros(2)]
    for push in pushes[1:]:
        x.append(np.array([x[-1][0] + dt * x[-1][1], x[-1][1]]) + push)
    x = np.array(x)
    mass = Lagrangian(lambda q: jnp.eye(1))
    record = Record(np.arange(count) * dt, np.zeros((count, 1)), x[:, :1] + std * rng.normal(size=(count, 1)))
    error = (np.asarray(run(Intrinsic(mass, alpha, beta), record).estimate) - x)[100:]
    found = calibration.predict_sampled_errors(alpha, beta, rate, std, density)
    assert np.sqrt(np.mean(error**2, axis=0)) == pytest.approx([found.position_std, found.velocity_std], rel=0.05)
    continuous = calibration.predict_errors(alpha, beta, std**2 / rate, density)
    assert continuous.position_std > 1.2 * found.position_std
    fast = calibration.predict_sampled_errors(alpha, beta, 1e5, std * (1e5 / rate) ** 0.5, density)
    assert fast[2:] == pytest.approx(continuous[2:], rel=1e-3)
    with pytest.raises(ValueError, match="rate must be a positive, finite number"):
        calibration.predict_sampled_errors(alpha, beta, 0.0, std)


@pytest.mark.parametrize("name", ["measurement_std", "rate", "acceleration_std", "correlation_time", "damping"])
def test_gains_name_the_number_that_makes_no_sense(name):
    numbers = {"measurement_std": 1.0, "rate": 1.0, "acceleration_std": 1.0, "correlation_time": 1.0, "damping": 1.0}
    with pytest.raises(ValueError, match=name):
        calibration.gains(**(numbers | {name: -1.0}))
