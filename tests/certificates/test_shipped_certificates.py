"""The certificates that come along still hold, and simulated estimates do as they say."""

from pathlib import Path

import pytest

from covariant.certificates import parse

FOLDER = Path(__file__).parents[2] / "examples/certificates"


@pytest.mark.long("scara", "ur5e_three_joints")
@pytest.mark.parametrize("name", ["heavy_top", "dfki_double_pendulum", "scara", "ur5e_three_joints"])
def test_large_ones_are_as_they_were_written(name):
    """Their leaves take longer (`covariant certify --check`); here their form and digest, and that no leaf is open."""
    assert not parse(FOLDER / f"{name}.json").open
