"""`covariant.fit` of a robot: what it finds, what it writes and where, and what it says of the rest."""

import numpy as np
import pytest

from covariant import models
from covariant.calibration import RobotFit
from covariant.calibration.identification import Combinations
from covariant.verbs import check_model_output, fit, simulate
from covariant.verbs._fit import FitResult
from covariant.verbs.base.fit_sentences import robot_details

MODEL = """system = "robot"

[parameters]
path = "arm.urdf"  # from the works

[inputs]
between = "held"
"""
LAW = {"elbow": {"viscous": 0.06, "coulomb": 0.08, "asymmetry": -0.02}}
TRUTH = {"parameters.friction": LAW, "parameters.armature": {"elbow": 0.004}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A model file in a folder of its own, beside the URDF file that it names."""
    folder = tmp_path_factory.mktemp("robot")
    (folder / "machine").mkdir()
    text = models.robots.located("double_pendulum").read_text()
    (folder / "machine" / "arm.urdf").write_text(text)
    (folder / "machine" / "arm.toml").write_text(MODEL)
    return folder


@pytest.fixture(scope="module")
def fitted(folder) -> FitResult:
    drive = {"duration": 16.0, "rate": 250.0, "amplitude": [2.2, 0.5], "frequency": 0.6, "noise": 1e-4}
    log = simulate("double_pendulum", **drive, overrides=TRUTH).record
    names = "friction.elbow,armature.2,inertia.upper"
    return fit(str(folder / "machine" / "arm.toml"), log, names)


def test_a_urdf_file_in_the_way_is_named_before_the_fit(tmp_path):
    (tmp_path / "fitted.urdf").touch()
    check_model_output("double_pendulum", tmp_path / "fitted.toml")
    with pytest.raises(ValueError, match=r"fitted\.urdf: there is such a file already"):
        check_model_output("double_pendulum", tmp_path / "fitted.toml", urdf=True)
    check_model_output("double_pendulum", tmp_path / "fitted.toml", overwrite=True, urdf=True)


def test_the_urdf_file_of_the_robot_itself_is_never_replaced(folder):
    machine = folder / "machine"
    for model in (machine / "arm.toml", machine / "arm.urdf"):
        with pytest.raises(ValueError, match=r"arm\.urdf: the robot is read from this file.*such as arm_fitted\.toml"):
            check_model_output(model, machine / "arm.toml", overwrite=True, urdf=True)


def made_up(**numbers: tuple[float, float, bool]) -> RobotFit:
    """A fit with values, standard errors, and whether these are determined."""
    names = tuple(name.replace("_", ".") for name in numbers)
    values, errors, determined = (np.array(column) for column in zip(*numbers.values(), strict=True))
    one, none = np.ones(1), Combinations((), (), 1)
    return RobotFit(names, values, values, errors, determined, none, one, 0.03, values, one)


def test_what_cannot_be_told_from_zero_is_named_with_its_standard_error():
    result = robot_details(made_up(friction_elbow_coulomb=(0.0, 0.78, False), gravity=(9.8, 0.1, True)))
    assert result["undetermined"] == ["friction.elbow.coulomb cannot be told from zero by this log: 0 ± 0.78"]


def test_a_load_with_offsets_is_said_to_have_two_solutions():
    place, offset = {"payload_lower_x": (0.1, 0.01, True)}, {"offsets_elbow": (0.1, 0.01, True)}
    (sentence,) = robot_details(made_up(**place, **offset))["undetermined"]
    assert "on which side of its link the load is" in sentence
    assert robot_details(made_up(payload_lower_mass=(0.1, 0.01, True), **offset))["undetermined"] == []
    assert robot_details(made_up(**place))["undetermined"] == []


def test_the_numbers_of_a_joint_that_is_predicted_worse_stay():
    family = models.robot_family("double_pendulum", ["friction", "armature"])
    names, count = family.names, len(family.names)
    x, one, none = np.full(count, 0.1), np.ones(count), Combinations((), (), 1)
    values = np.asarray(family.values(x))
    whole = RobotFit(names, family.first, values, 0.1 * one, one > 0, none, one[:2], 0.03, x, one)
    parted = whole.without(family, np.array([False, True]))
    assert parted is not None
    assert parted.kept == ("elbow",)
    elbow = np.array(["elbow" in name for name in names])
    np.testing.assert_array_equal(parted.values[elbow], family.first[elbow])
    np.testing.assert_array_equal(parted.values[~elbow], values[~elbow])
    assert not parted.determined[elbow].any()
    assert parted.determined[~elbow].all()
    assert "the numbers of elbow stay as they are" in robot_details(parted)["undetermined"][0]
    assert whole.without(family, np.array([False, False])) is None
    assert whole.without(family, np.array([True, True])) is None
