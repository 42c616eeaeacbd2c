"""The shipped certificates, attacked at random points and by descent from the slowest of them.

`COVARIANT_ATTACKS=500` looks at a million points of each, instead of at some twenty thousand.
"""

import os
from pathlib import Path

import numpy as np
import pytest

from covariant.certificates import ContractionCertificate, falsify

FOLDER = Path(__file__).parents[2] / "examples/certificates"
COUNT = int(os.environ.get("COVARIANT_ATTACKS", "12"))
POINTS, STARTS = 2_000 * COUNT, 8 * COUNT
MARGINS = {"ball_and_beam": 1.01, "heavy_top": 1.01, "dfki_double_pendulum": 1.0}
"""The slowest point that is found is so many times as fast as what is certified, at least."""


@pytest.mark.exhaustive("dfki_double_pendulum")
@pytest.mark.long
@pytest.mark.parametrize("name", MARGINS)
def test_no_point_is_slower_than_what_is_certified(name):
    certificate = ContractionCertificate.load(FOLDER / f"{name}.json")
    found = falsify(
        certificate.error_system, certificate.domain, certificate.rate, attempts=POINTS, starts=STARTS, seed=COUNT
    )
    assert found.verdict == "holds", found
    assert found.margin >= MARGINS[name] * certificate.rate
    print(f"{name}: {found.margin:.6g} 1/s at the slowest of {POINTS} points and {STARTS} descents")


@pytest.mark.long
@pytest.mark.parametrize("name", ["ball_and_beam", "heavy_top"])
def test_a_faster_claim_would_be_found_false(name):
    """On a region that is twelve times the certified one the certified rate is not kept, and that is found."""
    certificate = ContractionCertificate.load(FOLDER / f"{name}.json")
    domain = certificate.domain
    larger = domain._replace(low=12 * domain.low, high=12 * domain.high)
    found = falsify(certificate.error_system, larger, certificate.rate, attempts=20_000, starts=32)
    assert found.verdict == "fails"
    point = np.array(found[-1])
    assert (point >= larger.low).all()
    assert (point <= larger.high).all()
