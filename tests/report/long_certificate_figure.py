"""The figure of a certificate: a pendulum whose numbers were proved once, its boxes drawn as given: what takes long."""

import math

import numpy as np
import pytest
from PIL import Image
from test_certificate_figure import RADIUS, RATE, SQUARES, canned

from covariant.certificates import trajectories
from covariant.report import _certificate, certificate_figure, save_figure


@pytest.fixture(scope="module")
def followed():
    return trajectories(canned(), count=3, stamps=60)


@pytest.mark.exhaustive
def test_the_motion_stays_in_the_region_and_estimates_in_the_tube(followed):
    np.testing.assert_allclose(canned().half_widths, RADIUS * np.sqrt(SQUARES))
    assert np.abs(followed.positions).max() <= 3.0
    assert 0.1 < np.abs(followed.velocities).max() <= 4.0
    off = np.concatenate(
        [followed.estimated_positions - followed.positions, followed.estimated_velocities - followed.velocities], axis=2
    )
    assert (np.abs(off) <= followed.half_widths).all()
    assert np.abs(off[:, 0] / followed.half_widths).max() > 0.5  # they begin near its border
    assert np.ptp(off[:, 0], axis=0).min() > 0


@pytest.mark.exhaustive
def test_distances_begin_at_the_radius_and_stay_under_the_line(followed):
    seen = followed.distances
    np.testing.assert_allclose(seen.high[:, 0], RADIUS, rtol=1e-9)
    assert seen.holds
    assert (seen.low <= seen.high * (1 + 1e-9)).all()
    assert (seen.high <= seen.bound * (1 + 1e-6)).all()
    np.testing.assert_allclose(seen.bound[0, -1], RADIUS * math.exp(-RATE * followed.t[-1] / 2))


@pytest.mark.exhaustive
@pytest.mark.parametrize("verdict", ["holds", "undecided", "fails"])
def test_four_panels(verdict, followed, tmp_path, monkeypatch):
    if verdict == "holds":
        monkeypatch.setattr(_certificate, "trajectories", lambda certificate: followed)
    path = save_figure(certificate_figure(canned(verdict)), tmp_path / "proof.png")
    with Image.open(path) as image:
        drawn = np.asarray(image.convert("L")) < 250
        assert image.width == round(150 * 2 * 4.5)
    assert not np.concatenate([drawn[0], drawn[-1], drawn[:, 0], drawn[:, -1]]).any()  # no text runs out of the figure
    for row in np.array_split(drawn, 2):
        for panel in np.array_split(row, 2, axis=1):
            assert panel.mean() > 0.005
