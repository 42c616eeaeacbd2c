"""What takes long of `test_everywhere.py`: the arms of `docs/proved-for-your-arm.md`."""

import numpy as np
import pytest

from covariant import models
from covariant.certificates import certify_globally, check_globally
from covariant.observers import MeasuredCoefficients

STEP = (0.001, 0.001)


def links(n):
    return models.recipe("pendulum_chain", {"parameters.mass": [1.0] * n, "parameters.length": [1.0] * n})


@pytest.mark.parametrize(
    ("recipe", "least", "most", "boxes"),
    [(links(2), 10.9, 11.6, 27), (links(3), 33.2, 39.3, 867), (models.recipe("scara"), 11.9, 27.4, 403)],
)
def test_arms_in_all_configurations(recipe, least, most, boxes, tmp_path):
    made = certify_globally(models.from_recipe(recipe), velocity=1.0, interval=STEP, recipe=recipe)
    assert made.statement.proved
    assert least < made.document.omega.min()
    assert made.document.omega.max() < most
    assert made.proof.boxes <= boxes
    checked = check_globally(made.document.save(tmp_path / "arm.json"))
    assert checked is not None
    assert checked.statement.proved


@pytest.mark.core(60)
def test_four_links_in_all_configurations():
    made = certify_globally(models.from_recipe(links(4)), velocity=1.0, interval=STEP)
    assert made.statement.proved
    assert made.document.omega.max() < 88
    assert made.proof.boxes < 106_000


@pytest.mark.core(60)
def test_a_panda_near_its_ready_pose(tmp_path):
    """Within 0.1 rad, joints 1 and 7 anywhere."""
    recipe = models.recipe("panda")
    arm = models.from_recipe(recipe)
    pose = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
    low, high = pose - 0.1, pose + 0.1
    low[[0, 6]] = high[[0, 6]] = np.nan  # the limits of the file
    observer = MeasuredCoefficients(arm, 80.0 * 1.92**0.5, 6400.0, 1.0)
    made = certify_globally(observer, position=(low, high), interval=STEP, recipe=recipe)
    assert made.statement.proved
    assert made.proof.boxes < 32
    checked = check_globally(made.document.save(tmp_path / "panda.json"))
    assert checked is not None
    assert checked.statement.proved


@pytest.mark.core(20)
def test_a_whole_panda_is_undecided_and_says_why():
    made = certify_globally(models.load("panda").model, velocity=1.0, interval=STEP, boxes=2000)
    assert made.statement.verdict == "undecided"
    assert "boxes are too large for a bound" in str(made.statement)
