"""The certificates that come along still hold, and simulated estimates do as they say: what takes long."""

import functools
import json

import numpy as np
import pytest
from balls import check_sample
from test_shipped_certificates import FOLDER

from covariant.certificates import ContractionCertificate, check
from covariant.certificates.base._inequalities import contraction
from scalargraph.proofs import PROVED, leaves
from scalargraph.proofs._entries import Entries
from scalargraph.proofs._judge import judge


@functools.cache
def loaded(name: str) -> ContractionCertificate:
    """A certificate that comes along; to read one, its observer is traced, which takes seconds for a robot."""
    return ContractionCertificate.load(FOLDER / f"{name}.json")


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("name", "rate"), [("ball_and_beam", 0.1), ("ball_and_beam_100hz", 4.0), ("heavy_top_100hz", 1.0)]
)
def test_small_ones_are_verified_whole(name, rate):
    assert check(FOLDER / f"{name}.json").rate == pytest.approx(rate, rel=0.1)


@pytest.mark.parametrize("name", ["heavy_top", "dfki_double_pendulum"])
def test_some_leaves_are_looked_at_in_balls(name):
    assert check_sample(FOLDER / f"{name}.json", 4)[0] == 4


@pytest.mark.exhaustive("ball_and_beam_100hz", "scara", "ur5e_three_joints")
@pytest.mark.parametrize(
    "name",
    [
        *("ball_and_beam", "heavy_top", "dfki_double_pendulum", "scara", "ur5e_three_joints"),
        *("ball_and_beam_100hz", "heavy_top_100hz"),
    ],
)
def test_a_certificate_is_read_as_it_was_written(name):
    document = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    found = loaded(name)
    assert found.document() == document
    assert (found.statement.verdict, found.statement.evidence, found.verified) == ("holds", "claimed", False)
    assert found.statement.claim.endswith("(read from a file, not verified again)")


@pytest.mark.exhaustive
def test_leaves_of_a_robot_are_proved_by_the_prover_again():
    """By its Taylor models, on some of the leaves; and where shoulder and lift are does not enter."""
    certificate = loaded("scara")
    domain, levels = certificate.domain, certificate.claims[0].proof.levels
    formed = contraction(certificate.error_system, certificate.rate).graph(domain.low)
    matrix = Entries.of(formed.entries, domain)
    assert [domain.names[i] for i in matrix.free if i < 4] == ["elbow", "twist"]
    low, high = (np.concatenate(ends)[::100] for ends in list(zip(*leaves(domain, levels), strict=True))[1:])
    assert (judge(matrix, low, high)[0] == PROVED).all()
    # A rate beyond that of the gains is found wrong.
    wrong = contraction(certificate.error_system, 30 * certificate.rate).graph(domain.low)
    assert judge(Entries.of(wrong.entries, domain), low, high)[1] is not None
