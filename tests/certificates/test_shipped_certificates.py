"""The certificates that come along still hold."""

from pathlib import Path

import pytest

from covariant.certificates._check import check, read

FOLDER = Path(__file__).parents[2] / "examples/certificates"


@pytest.mark.parametrize(("name", "rate"), [("ball_and_beam", 0.1), ("heavy_top", 2.0)])
def test_small_ones_are_verified_whole(name, rate):
    assert check(FOLDER / f"{name}.json").rate == rate


def test_the_large_one_is_as_it_was_written():
    """Its 58 526 leaves take minutes; here its digest, its verdict and that no leaf is open."""
    document = read(FOLDER / "dfki_double_pendulum.json")
    assert document["verdict"] == "holds"
    assert document["model"]["parameters"]["coulomb"] == [0.093, 0.078]
    assert not any("?" in level for claim in document["claims"] for level in claim["levels"])
