"""The figure of a certificate: a pendulum whose numbers were proved once, its boxes drawn as given."""

import numpy as np
import pytest

from covariant import models
from covariant.certificates import (
    ContractionCertificate,
    Hypothesis,
    Statement,
    error_system,
    optimal_lyapunov,
    projection,
    trajectories,
)
from covariant.certificates.base import CLAIMS, Given
from covariant.observers import Intrinsic
from covariant.report import new_figure, save_figure
from scalargraph.proofs import Box, Proof

SQUARES, RADIUS, RATE = (56.0, 2178.0), 0.01336, 3.33
HALVED = [np.array([0]), np.array([1, -1]), np.array([-1, -2])]
"""The angle is halved, then the velocity of the lower half, whose upper half stays open."""


def canned(verdict: str = "holds") -> ContractionCertificate:
    """Three boxes, one of them open unless the verdict is "holds", and a counter-example where it fails."""
    observer = Intrinsic(models.pendulum_chain(mass=(1.0,), length=(0.5,)), 10.0, 50.0)
    q = optimal_lyapunov(10.0, 50.0, 20 / 3)
    about = error_system(observer, q)
    domain = Box(about.names, about.units, -np.array([3.1, 4.7, 0.1, 5.4]), np.array([3.1, 4.7, 0.1, 5.4]))
    levels = [np.where(codes == -2, -1, codes) for codes in HALVED] if verdict == "holds" else HALVED
    wrong = np.stack([domain.high] * 2) if verdict == "fails" else None
    left = np.zeros((0 if verdict == "holds" else 1, 2, 4))
    claims = [CLAIMS["contraction"](Proof(verdict, domain, levels, wrong, left, 5, 1.0))]
    if verdict == "holds":
        whole = Proof("holds", domain, [np.array([-1])], None, left, 1, 0.1)
        claims += [CLAIMS["reach"](whole, row, square, 0.1) for row, square in enumerate(SQUARES)]
    bounds = np.array([[-3.0], [3.0]]), np.array([[-0.5], [0.5]])
    given = Given(*bounds, np.zeros(2), *np.zeros((2, 1)), np.zeros((1, 1)))
    return ContractionCertificate(
        Statement(
            "squared lengths shrink at 3.33 1/s or faster on the region", (), (Hypothesis("", "proved", verdict),), RATE
        ),
        RATE,
        RADIUS if verdict == "holds" else 0.0,
        observer,
        q,
        about,
        domain,
        np.array([4.0]),
        given,
        tuple(claims),
        None,
    )


def test_the_boxes_are_projected_on_the_variables_that_are_halved():
    seen = projection(canned("undecided"))
    assert (seen.names, seen.units, seen.kind) == (("q1", "v_q1"), ("rad", "rad/s"), ("estimate", "velocity"))
    np.testing.assert_array_equal(seen.proved, [[[-3.1, -4.7], [0.0, 0.0]], [[0.0, -4.7], [3.1, 4.7]]])
    np.testing.assert_array_equal(seen.open, [[[-3.1, 0.0], [0.0, 4.7]]])
    assert seen.counterexample is None
    np.testing.assert_array_equal(projection(canned("fails")).counterexample, [3.1, 4.7])
    assert canned().kinds == ("estimate", "velocity", "error", "force")


def test_the_share_left_open():
    certificate = canned("undecided")
    assert certificate.claims[0].proof.open_share == 0.25
    assert canned().claims[0].proof.open_share == 0.0


def test_nothing_proved_is_no_tube():
    with pytest.raises(ValueError, match="nothing is proved"):
        _ = canned("undecided").half_widths
    with pytest.raises(ValueError, match="nothing is proved"):
        trajectories(canned("fails"))


def test_a_figure_needs_a_format(tmp_path):
    with pytest.raises(ValueError, match="suffix"):
        save_figure(new_figure(), tmp_path / "proof")
    assert not list(tmp_path.iterdir())
