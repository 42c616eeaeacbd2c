"""The sampled step contracts where its certificate says so, and nothing else is proved or accepted."""

from fractions import Fraction

import numpy as np
import pytest

from covariant import models
from covariant.certificates import certify
from covariant.certificates.base import UNPROVED, Given, PredictionClaim, Sampling, Setting, StartClaim
from covariant.certificates.base._radius_recursion import Recursion
from covariant.observers import Intrinsic
from scalargraph.proofs import Field

RECIPE = {"system": "pendulum_chain", "parameters": {"mass": [1.0], "length": [0.5]}}
NO_BOUNDS = Given(np.zeros((2, 1)), np.zeros((2, 0)), np.zeros(2), np.zeros(1), np.zeros(1), np.zeros((1, 1)))
BOUNDS = {"position": (-3.0, 3.0), "velocity": 4.0, "error": 0.1, "input": 0.5}


def swing() -> models.MechanicalSystem:
    system = models.from_recipe(RECIPE)
    assert isinstance(system, models.MechanicalSystem)
    return system


def pendulum(alpha=10.0, beta=50.0, substeps=4, **options):
    return Intrinsic(swing(), alpha, beta, substeps=substeps, **options)


Q = np.array([[0.2, -0.016], [-0.016, 0.005]])


def test_ages_cover_every_multiple_of_the_interval():
    sampling = Sampling(np.array([0.0019, 0.0021]), 2)
    for count, (first, last) in enumerate(sampling.ages.tolist(), start=1):
        assert Fraction(first) <= count * Fraction(0.0019)
        assert Fraction(last) >= count * Fraction(0.0021)
    assert sampling.ages[0].tolist() == [0.0019, 0.0021]


# What is proved.


# What is not right is neither proved nor accepted.


@pytest.mark.parametrize("order", range(5))
def test_errors_of_steps_are_the_integral_of_their_defect(order):
    claim, sampling = PredictionClaim(UNPROVED, 9.0, order), Sampling(np.array([0.05, 0.08]), substeps=4)
    lengths = (np.arange(10_000) + 0.5) * 0.02 / 10_000
    steps = Recursion.of(sampling, Q, 1.0, None, [claim]).steps
    assert steps == pytest.approx((3 * lengths**order).mean(), rel=1e-6)
    assert steps >= claim.defect(0.02)


def test_a_file_states_the_order_of_a_bound_of_steps_where_it_is_not_that_of_the_steps():
    setting = Setting(-np.ones(7), np.ones(7), 1, Sampling(np.array([0.05, 0.08]), substeps=4), NO_BOUNDS, 1)
    plain = {"kind": "prediction", "square": 9.0, "levels": ["."]}
    for content, order in ((plain, 4), (plain | {"order": 1}, 1), (plain | {"order": 0}, 0)):
        claim = PredictionClaim.read(Field("a file", "claims[5]", content), 0, setting)
        assert claim.order == order
        assert claim.document() == content
    for wrong in (-1, 5, 1.5, True, None, "1"):
        with pytest.raises(ValueError, match=r"claims\[5\]\.order must be a whole number from 0 to 4"):
            PredictionClaim.read(Field("a file", "claims[5]", plain | {"order": wrong}), 0, setting)
    with pytest.raises(ValueError, match="order"):
        StartClaim.read(Field("a file", "claims[6]", {"kind": "start"} | plain | {"order": 1}), 0, setting)


# What is not covered is refused by name.

INTERVAL = "interval must be two positive, finite numbers, the lower one first"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"interval": (0.0, 0.1)}, INTERVAL),
        ({"interval": (0.2, 0.1)}, INTERVAL),
        ({"interval": 0.1}, INTERVAL),
        ({"lost": -1}, "lost must be"),
        ({"q": np.eye(2)}, "leave q out"),
        ({"noise": 0.2}, "noise must be below"),
    ],
    ids=str,
)
def test_arguments_that_do_not_fit_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        certify(pendulum(), **(BOUNDS | {"interval": (0.01, 0.02)} | change))
