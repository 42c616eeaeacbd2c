"""Gains in the lifted kinetic metric, against geodesics, eigenvalues and simulations that know nothing of them."""

import math

import numpy as np
import pytest

from covariant import models, observers
from covariant.certificates import certify_distance, least_gain, observability, tangent_metric
from covariant.certificates.theory import DistanceBounds, lifted_gain
from covariant.models import state_space

BEAM = models.ball_and_beam()
M, SIGMA = 12.0, 1.5
Q = np.array([[M + SIGMA**2, -SIGMA], [-SIGMA, 1.0]])
NEAR = DistanceBounds(0.3, 0.4, 0.3, (-8.0, 8.0), (-1.0, 0.0))


@pytest.mark.parametrize("k", [-3.0, 0.0, 0.7, 40.0])
@pytest.mark.parametrize("rate", [0.1, 1.2])
def test_rho_is_the_least_with_which_the_first_condition_holds(k, rate):
    """ξ' = ζ, ζ' = −kξ, whose matrix inequality is solved by bisection."""
    a = np.array([[0.0, 1.0], [-k, 0.0]])
    low, high = 0.0, 1e6
    for _ in range(200):
        rho = (low + high) / 2
        worst = np.linalg.eigvalsh(Q @ a + a.T @ Q + 2 * rate * Q - np.diag([rho, 0.0]))[-1]
        low, high = (low, rho) if worst <= 0 else (rho, high)
    found = lifted_gain(M, SIGMA, rate, DistanceBounds(0.0, 1.0, 0.0, (k, k)))
    assert found.rho == pytest.approx(max(high, 0.0), rel=1e-6, abs=1e-6)
    assert (found.k, found.beta) == (pytest.approx(found.rho / 2), pytest.approx(SIGMA * found.alpha))


@pytest.mark.parametrize(
    "model", [BEAM, pytest.param(models.pendulum_chain((1.0, 1.0), (1.0, 1.0)), marks=pytest.mark.long)]
)
def test_the_first_condition_holds_at_twice_sigma_and_the_second_where_geodesics_turn_little(model):
    points = np.random.default_rng(0).uniform(-1, 1, (10, 4))
    metric = tangent_metric(model.space, Q)
    found = observability(state_space(model), metric, points)
    assert found.condition_1.margin == pytest.approx(2 * SIGMA, abs=1e-9)
    assert (found.condition_2.verdict, found.witness) == ("holds", None)
    assert "turn by less than π/2" in found.verdict
    # The same metric without the knowledge that it is a lift: straight, of which several outputs decide nothing.
    found = observability(state_space(model), lambda x: metric(0.0 * x[0], x), points)
    assert (found.condition_2.verdict, found.witness) == ("undecided", None)


@pytest.mark.long
def test_an_output_that_is_no_position_is_not_taken_for_one():
    model = models.StateSpace(
        state_space(BEAM).f, lambda t, x, u: x[:2] + 0.1 * x[2:], coordinates=("r", "theta", "v", "w"), inputs=2
    )
    found = observability(model, tangent_metric(BEAM.space, Q), np.random.default_rng(0).uniform(-1, 1, (4, 4)))
    assert "turn by less" not in found.verdict
    assert found.condition_2.verdict != "holds"


def test_more_curvature_speed_or_error_needs_more_gain_and_far_starts_have_none():
    gain = least_gain(SIGMA, SIGMA / 2, NEAR)
    for worse in (
        {"curvature": (-4.0, 0.0)},
        {"riemann": 3.0},
        {"speed": 0.9},
        {"error": 0.8},
        {"velocity_error": 0.9},
        {"stiffness": (-30.0, 30.0)},
    ):
        assert least_gain(SIGMA, SIGMA / 2, NEAR._replace(**worse)).alpha > gain.alpha
    assert least_gain(SIGMA, SIGMA / 2, NEAR._replace(injectivity=0.3)).alpha == math.inf
    assert lifted_gain(0.1, SIGMA, 0.5, NEAR).alpha == math.inf  # turns by more than a right angle
    with pytest.raises(ValueError, match=r"rate must be below sigma, which is 1\.5 1/s; got 2"):
        lifted_gain(M, SIGMA, 2.0, NEAR)


@pytest.mark.parametrize("kappa", [1.0, 0.04])
def test_speeds_and_velocity_errors_of_any_size_have_a_gain_and_positions_up_to_a_right_angle(kappa):
    limit = math.sqrt(math.pi / 2 / kappa)
    for error, speed in ((0.97 * limit, 0.1), (0.5 * limit, 100.0)):
        fast = DistanceBounds(speed, error, speed, (-1.0, 1.0), (-kappa, 0.0))
        assert least_gain(2.0, 0.1, fast).alpha < math.inf
        assert least_gain(2.0, 0.1, fast._replace(error=1.01 * limit)).alpha == math.inf
    flat = DistanceBounds(100.0, 1e4, 100.0, (-1.0, 1.0))
    assert least_gain(2.0, 0.1, flat).alpha < math.inf


BOUNDS = {"position": ([-2.5, -4.0], [2.5, 4.0]), "velocity": 0.25, "error": 0.25}


def test_a_ball_on_a_beam_converges_from_where_it_is_said_to():
    statement = certify_distance(observers.LagrangianMetric(BEAM, 80.0, 400.0), **BOUNDS).statement
    assert statement.short == "holds (proved)"
    low = certify_distance(observers.LagrangianMetric(BEAM, 4.0, 20.0), **BOUNDS)
    assert low.statement.short == "undecided"
    remedy = next(h.place for h in low.statement.hypotheses if h.verdict == "undecided")
    alpha, beta = (float(part.split(" = ")[1].split(" ")[0]) for part in remedy.split(","))
    again = certify_distance(observers.LagrangianMetric(BEAM, 1.01 * alpha, 1.01 * beta), **BOUNDS)
    assert again.statement.short == "holds (proved)"
    far = certify_distance(observers.LagrangianMetric(BEAM, 80.0, 400.0), **BOUNDS | {"error": 5.0})
    assert far.statement.short == "undecided"
