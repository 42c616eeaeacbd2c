"""What takes long of `test_excitation_verb.py`."""

import re

import numpy as np
import pytest
from test_excitation_verb import folder

from covariant.verbs import design_excitation
from covariant.verbs._excitation import ExcitationResult

REGION = {"shoulder": (-1.0, 1.0), "elbow": (-1.5, 1.5)}


SHORT = {"duration": 5.0, "rate": 100.0, "harmonics": 3, "starts": 1, "region": REGION, "velocity": [4.0, 5.0]}


@pytest.fixture(scope="module")
def found(folder) -> ExcitationResult:
    steps = []
    result = design_excitation(
        folder / "arm.toml",
        ["armature"],
        **SHORT,
        progress=lambda text, fraction=None: steps.append(fraction),
    )
    done = [fraction for fraction in steps if fraction is not None]
    assert done == sorted(done)
    assert 0 <= done[0] < done[-1] <= 1
    return result


@pytest.mark.exhaustive
def test_the_table_is_a_motion_within_the_limits(found):
    assert list(found.columns) == ["t", "s", "e", "v1", "v2", "a1", "a2", "ts", "te"]
    t, *columns = found.si_columns.values()
    q, v, a, u = (np.stack(columns[i : i + 2], axis=1) for i in (0, 2, 4, 6))
    assert len(t) == 501
    np.testing.assert_allclose(t[-1], 5.0)
    for each, limit in ((q, (1.0, 1.5)), (v, (4.0, 5.0)), (u, (2.0, 1.0))):
        assert (np.abs(each).max(axis=0) <= 0.9 * np.array(limit) + 1e-9).all()
    np.testing.assert_allclose([v[0], v[-1], a[0], a[-1]], 0, atol=1e-9)
    np.testing.assert_allclose(q[0], q[-1], atol=1e-12)
    np.testing.assert_allclose(np.gradient(q, t, axis=0)[5:-5], v[5:-5], atol=0.02)
    np.testing.assert_allclose(found.columns["s"], np.degrees(q[:, 0]))
    assert found.units["s"] == "deg"
    assert found.units["a2"] == "rad/s^2"
    assert found.to_pandas().attrs["units"] == found.units


@pytest.mark.exhaustive
def test_it_says_what_to_expect_and_what_it_does_not_look_at(found):
    text = str(found)
    assert "501 rows over 5 s: 1 period of 5 s, 3 harmonics" in text
    assert "| armature.shoulder [kg m^2] | 0" in text
    assert re.search(r"largest torque .* of 2 N m", text, re.DOTALL)
    assert "Collisions are not looked at" in text
    assert found.standard_errors.prod() < found.reference_errors.prod()
    noise = found.summary["joints"][1]
    assert noise["noise"] == pytest.approx(1e-3 / np.sqrt(12))
    assert noise["torque"]["noise"] == pytest.approx(0.01)
    assert found.warnings == ()


@pytest.mark.exhaustive
def test_it_is_drawn_with_its_limits(found, folder):
    figure = found.plot(folder / "motion.png")
    assert len(figure.axes) == 6
    assert (folder / "motion.png").stat().st_size > 10_000
