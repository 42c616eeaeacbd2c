"""The certificates that come along still hold."""

from pathlib import Path

import pytest

from covariant.certificates._check import check, read

FOLDER = Path(__file__).parents[2] / "examples/certificates"


def test_a_small_one_is_verified_whole():
    assert check(FOLDER / "ball_and_beam.json").rate == 0.1


@pytest.mark.parametrize("name", ["heavy_top", "dfki_double_pendulum"])
def test_large_ones_are_as_they_were_written(name):
    """Their leaves take longer (`covariant certify --check`); here digest and verdict, and that no leaf is open."""
    document = read(FOLDER / f"{name}.json")
    assert document["verdict"] == "holds"
    assert not any("?" in level for claim in document["claims"] for level in claim["levels"])
