"""Bad input gives one clear line on standard error and exit code 2, and nothing is written."""

import sys
from pathlib import Path

import pytest
from commands import leave, refused

MODEL = """
system = "pendulum_chain"
[parameters]
mass = [1.0]
length = [0.5]
[measurement]
quantum = 1e-3
[uncertainty]
acceleration = 1.0
"""
GOOD = "t,q1,u1\n0,0,0\n0.01,0.1,0\n0.02,0.2,0\n0.03,0.3,0\n"
MODELS = """
import jax.numpy as jnp
from covariant.models import Lagrangian

def wrong_shape():
    return Lagrangian(lambda q: jnp.ones(3), lambda q: 0.0 * q[0], coordinates=("q1",))

def indefinite():
    return Lagrangian(lambda q: -jnp.eye(1), lambda q: 0.0 * q[0], coordinates=("q1",))

not_a_model = 3
"""
LOGS = {
    "missing column": (GOOD.replace("q1", "angle"), ["log.csv", "'q1'", "angle"]),
    "text in a number column": (GOOD.replace("0.2,", "abc,"), ["log.csv", "'q1'", "row 3", "'abc'"]),
    "empty file": ("", ["log.csv", "empty"]),
    "a row of NaN": (GOOD.replace("0.02,0.2,0", "nan,nan,nan"), ["log.csv", "'t'", "row 3"]),
    "an infinite input": (GOOD.replace("0.2,0\n", "0.2,inf\n"), ["log.csv", "row 3"]),
    "no measurement in the first row": (GOOD.replace("0,0,0\n", "0,,0\n", 1), ["log.csv", "row 1"]),
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "model.toml").write_text(MODEL)
    (tmp_path / "log.csv").write_text(GOOD)
    (tmp_path / "refused_models.py").write_text(MODELS)
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "refused_models", raising=False)
    return tmp_path


ESTIMATE = ("estimate", "model.toml", "log.csv", "-o", "out/v.csv")


@pytest.mark.core(7)
@pytest.mark.parametrize("command", ["estimate", "compare"])
@pytest.mark.parametrize("case", LOGS)
def test_a_bad_log(folder, command, case):
    text, named = LOGS[case]
    (folder / "log.csv").write_text(text)
    refused(command, "model.toml", "log.csv", "-o", "out/v.csv", "--report", "out/r.html", named=named)


@pytest.mark.parametrize(
    ("spec", "named"),
    [
        ("refused_models:wrong_shape", ["metric", "(1, 1)", "(3,)"]),
        ("refused_models:indefinite", ["positive definite", "-1"]),
        ("refused_models:not_a_model", ["not_a_model", "int"]),
        ("refused_models:absent", ["absent"]),
        ("no_such_module:x", ["no_such_module"]),
    ],
)
def test_a_bad_model(folder, spec, named):
    refused("estimate", spec, "log.csv", "-o", "out/v.csv", named=named)


@pytest.mark.core(12)
@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((*ESTIMATE, "--observer", "magic"), ["magic", "intrinsic", "geodesic"]),
        ((*ESTIMATE, "--report", "out/r.pdf"), ["r.pdf", ".html"]),
        (("estimate", "model.toml", "log.csv", "-o", "out/v.xlsx"), ["v.xlsx", ".csv"]),
        ((*ESTIMATE, "--observer", "salcudean"), ["salcudean does not fit model.toml", "intrinsic", "savitzky-golay"]),
        ((*ESTIMATE, "--set", 'columns.matrix=["a"]'), ["columns.matrix", "columns.q"]),
        ((*ESTIMATE, "--alpha", "3"), ["--alpha and --beta", "both"]),
        ((*ESTIMATE, "--alpha", "-3", "--beta", "1"), ["positive", "-3"]),
        ((*ESTIMATE, "--alpha", "3", "--beta", "1", "--observer", "ekf"), ["ekf"]),
        ((*ESTIMATE, "--alpha", "inf", "--beta", "inf"), ["positive", "inf"]),
        ((*ESTIMATE, "--alpha", "nan", "--beta", "1"), ["positive", "nan"]),
        ((*ESTIMATE, "--report", "absent/r.html"), ["absent", "make it first"]),
        (("estimate", "model.toml", "log.csv", "-o", "absent/v.csv"), ["absent", "make it first"]),
        (("compare", "model.toml", "log.csv", "-o", "absent/v.csv"), ["absent", "make it first"]),
        ((*ESTIMATE, "--until", "0.005"), ["log.csv", "until=0.005", "1 of 4 rows"]),
        ((*ESTIMATE, "--set", "parameters.mas=[1.0]"), ["mas", "mass"]),
        ((*ESTIMATE, "--set", "nonsense"), ["nonsense"]),
        ((*ESTIMATE, "--set", "design.damping=1_0"), ["design.damping=1_0", "plain decimals"]),
        ((*ESTIMATE, "--set", "parameters.mass=[0x10]"), ["parameters.mass=[0x10]", "plain decimals"]),
        (("simulate", "model.toml", "-o", "out/l.csv", "--q0", "1_0"), ["--q0", "'1_0'"]),
        (("simulate", "model.toml", "-o", "out/l.csv", "--q0", "١"), ["--q0", "'١'"]),
        ((*ESTIMATE, "--q", "a,b"), ["1 positions"]),
        (("estimate", "pendulum_chain", "log.csv", "--u", "u1,u1", "--q", "q1,q1", "-o", "out/v.csv"), []),
        (("simulate", "model.toml", "-o", "out/l.csv", "--q0", "1,2"), ["q0", "1 finite"]),
        (("simulate", "model.toml", "-o", "out/l.csv", "--v0", "fast"), ["--v0", "'fast'"]),
        (("simulate", "model.toml", "-o", "out/l.csv", "--dropout", "1.5"), ["dropout"]),
        (("simulate", "model.toml", "-o", "out/l.csv", "--q0", "nan"), ["q0", "nan"]),
        (("simulate", "model.toml", "-o", "out/l.csv", "--rate", "inf"), ["rate", "inf"]),
        (("simulate", "model.toml", "-o", "out/l.csv", "--duration", "inf"), ["inf s"]),
        (("simulate", "model.toml", "-o", "out/l.xlsx"), ["l.xlsx", ".csv"]),
        (("simulate", "model.toml", "-o", "absent/l.csv"), ["absent", "make it first"]),
        (("simulate", "model.toml", "-o", "out/l.csv", "--frequency", "inf"), ["frequency", "inf"]),
        (("simulate", "model.toml", "-o", "out/l.csv", "--frequency", "-1"), ["frequency", "-1"]),
        (("simulate", "model.toml", "-o", "out/l.csv", "--noise", "-1"), ["noise", "-1"]),
        (("simulate", "model.toml", "-o", "out/l.csv", "--noise", "1,2"), ["noise", "1 finite", "q1"]),
        (("simulate", "model.toml", "-o", "out/l.csv", "--quantum", "1e-3,"), ["--quantum", "'1e-3,'"]),
        (("simulate", "model.toml", "-o", "out/l.csv", "--jitter", "nan"), ["jitter", "nan"]),
        (("simulate", "model.toml", "-o", "out/l.csv", "--duration", "0.02", "--v0", "1e300"), ["the finite numbers"]),
        (("reproduce", "aghannan-rouchon", "-o", "out/figure.pdf"), ["figure.pdf", ".png"]),
    ],
)
def test_a_bad_argument(folder, arguments, named):
    refused(*arguments, named=named)


CHAIN = ("model.toml", "log.csv")
NOISE = ("--set", "measurement.std=1.0", "--set", "uncertainty.process=1.0")
WATCHED = ("lorenz", "log.csv", "--q", "q1", "-o", "out/v.csv")


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("estimate", *WATCHED), ["lorenz", "measurement.std"]),
        (("compare", "odin", "log.csv", "--q", "q1,q2", "-o", "out/c.csv"), ["odin has 6 positions"]),
        (("estimate", *WATCHED, *NOISE, "--alpha", "1", "--beta", "1"), ["do not apply to covariance-ekf"]),
        (("estimate", *WATCHED, *NOISE, "--observer", "ekf"), ["covariance-ekf, information-ekf, riccati"]),
        (("estimate", *WATCHED, "--set", "uncertainty.process=[1, 2]"), ["uncertainty.process lists 2", "give 3"]),
        (("estimate", *CHAIN, "--set", "initial.std=1"), ["initial.std is for a state-space model"]),
        (("simulate", "lorenz", "-o", "out/l.csv", "--q0", "1"), ["q0 needs 3 finite"]),
        (("simulate", "lorenz", "-o", "out/l.csv", "--v0", "1,2,3"), ["v0", "no velocities", "q0"]),
        (("simulate", "lorenz", "-o", "out/l.csv", "--amplitude", "1"), ["amplitude needs 0 finite"]),
        (("simulate", "duffing", "-o", "out/l.csv", "--set", 'columns.q=["a", "b"]'), ["2 columns", "1 outputs"]),
    ],
)
def test_a_bad_argument_with_a_state_space_model(folder, arguments, named):
    refused(*arguments, named=named)


TOP = """
system = "heavy_top"
[columns]
quaternion_wxyz = ["qw", "qx", "qy", "qz"]
[measurement]
std = 1e-3
[uncertainty]
acceleration = 1.0
"""
UNIT = "t,qw,qx,qy,qz,u1,u2,u3\n0,1,0,0,0,0,0,0\n0.01,0.8,0.6,0,0,0,0,0\n0.02,1,0,0,0,0,0,0\n0.03,1,0,0,0,0,0,0\n"
ENTRIES = [f"r{i}{j}" for i in "123" for j in "123"]
SQUARE = "\n".join([",".join(["t", *ENTRIES, "u1,u2,u3"]), *(f"{k},1,0,0,0,1,0,0,0,1,0,0,0" for k in range(4))])
BY_MATRIX = TOP.replace('quaternion_wxyz = ["qw", "qx", "qy", "qz"]', f"matrix = {ENTRIES}")
GROUP_LOGS = {
    "a long quaternion": (TOP, UNIT.replace("0.8,0.6", "0.8,0.8"), ["'qw', 'qx'", "row 2", "length 1.13", "normalise"]),
    "a quaternion of zeros": (TOP, UNIT.replace("0.8,0.6", "0,0"), ["row 2", "length 0", "leave the row empty"]),
    "no measurement in the first row": (TOP, UNIT.replace("0,1,0,0,0,0", "0,1,,0,0,0", 1), ["row 1 lacks", "cut"]),
    "text in an attitude": (TOP, UNIT.replace("0.8", "abc"), ["'qw'", "row 2", "'abc'"]),
    "no such column": (TOP, UNIT.replace("qw", "w"), ["no column 'qw'"]),
    "a stretched matrix": (BY_MATRIX, SQUARE.replace("2,1,0", "2,1.1,0"), ["row 3", "not orthogonal", "1.1 times"]),
    "a reflection": (BY_MATRIX, SQUARE.replace("2,1,0", "2,-1,0"), ["row 3", "reflection", "left-handed"]),
}


@pytest.mark.parametrize("command", ["estimate", "compare"])
@pytest.mark.parametrize("case", GROUP_LOGS)
def test_a_bad_log_of_attitudes(folder, command, case):
    model, text, named = GROUP_LOGS[case]
    (folder / "top.toml").write_text(model)
    (folder / "log.csv").write_text(text)
    arguments = (command, "top.toml", "log.csv", "-o", "out/v.csv", "--report", "out/r.html")
    assert refused(*arguments, named=named).startswith("covariant: log.csv: ")


ATTITUDE = ("estimate", "top.toml", "log.csv", "-o", "out/v.csv")
BARE = ("log.csv", "-o", "out/v.csv")


@pytest.mark.core(7)
@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("estimate", "heavy_top", *BARE), ["never guessed", "quaternion_wxyz, quaternion_xyzw, matrix", "--set"]),
        (("estimate", "underwater_vehicle", *BARE), ["never guessed"]),
        (("compare", "satellite", *BARE), ["never guessed"]),
        (("estimate", "both.toml", *BARE), ["columns.quaternion_wxyz and columns.matrix both give", "keep one"]),
        ((*ATTITUDE, "--set", 'columns.quaternion_xyzw=["a", "b", "c"]'), ["quaternion_xyzw names 3", "has 4 entries"]),
        ((*ATTITUDE, "--set", 'columns.position=["a", "b", "c"]'), ["columns.position names 3", "has 0"]),
        ((*ATTITUDE, "--set", 'columns.q=["qw", "qx", "qy"]'), ["columns.q", "no coordinates", "name one of"]),
        ((*ATTITUDE, "--q", "qw,qx,qy,qz"), ["--q", "on a group", "--set"]),
        ((*ATTITUDE, "--u", "u1"), ["3 inputs", "name 0 and 1"]),
        (("estimate", "hovercraft", *BARE, "--set", 'columns.matrix=["a"]'), ["no attitude", "position and angle"]),
        (
            (*ATTITUDE, "--observer", "savitzky-golay"),
            [
                "savitzky-golay does not fit",
                "geodesic, lagrangian-metric, copy, intrinsic-kalman, ekf, ukf, tracking-loop, salcudean",
            ],
        ),
        ((*ATTITUDE, "--observer", "ekf", "--alpha", "3", "--beta", "1"), ["ekf", "intrinsic, intrinsic2"]),
        ((*ATTITUDE, "--set", "measurement.std=0"), ["measurement.std", "positive"]),
        (("simulate", "top.toml", "-o", "out/l.csv", "--quantum", "1e-3"), ["quantum", "group", "noise"]),
        (("simulate", "top.toml", "-o", "out/l.csv", "--q0", "1,0,0,0"), ["q0 needs 3 finite"]),
        (("simulate", "underwater_vehicle", "-o", "out/l.csv", "--v0", "1"), ["v0 needs 6 finite"]),
    ],
)
def test_a_bad_argument_on_a_group(folder, arguments, named):
    (folder / "top.toml").write_text(TOP)
    (folder / "both.toml").write_text(TOP.replace("[measurement]", f"matrix = {ENTRIES}\n[measurement]"))
    (folder / "log.csv").write_text(UNIT)
    refused(*arguments, named=named)


def test_only_what_fits_a_pose_is_offered(folder):
    (folder / "log.csv").write_text(UNIT.replace("qw,qx,qy,qz,u1,u2,u3", "px,py,angle,right_thrust,left_thrust,a,b"))
    message = refused("estimate", "hovercraft", *BARE, "--observer", "salcudean")
    these = "intrinsic, intrinsic2, intrinsic-force, geodesic, "
    these += "lagrangian-metric, copy, intrinsic-kalman, ekf, ukf, tracking-loop"
    assert f"salcudean does not fit hovercraft; these do: {these}\n" in message


def test_a_name_that_the_estimate_needs_itself(folder):
    (folder / "top.toml").write_text(TOP.replace('"qz"', '"w1"'))
    (folder / "log.csv").write_text(UNIT.replace("qz", "w1"))
    assert "two columns named 'w1'; rename" in refused(*ATTITUDE)


def test_a_model_file_without_the_numbers_of_a_design(folder):
    (folder / "model.toml").write_text(MODEL.split("[uncertainty]")[0])
    refused(*ESTIMATE, named=["uncertainty.acceleration"])


@pytest.mark.parametrize("command", ["estimate", "compare"])
def test_the_log_is_never_written_over(folder, command):
    (folder / "same.csv").symlink_to(folder / "log.csv")
    for out in ("log.csv", "./out/../log.csv", "same.csv"):
        assert "log itself" in refused(command, "model.toml", "log.csv", "-o", out)
    assert (folder / "log.csv").read_text() == GOOD


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("estimate", "model.toml"), "LOG"),
        ((*ESTIMATE, "--every", "0"), "--every"),
        ((*ESTIMATE, "--until", "soon"), "--until"),
        ((*ESTIMATE, "--observr", "copy"), "--observr"),
        (("simulate", "model.toml", "-o", "out/l.csv", "--seed", "-1"), "--seed"),
        (("estimat", "model.toml", "log.csv"), "estimat"),
    ],
)
def test_options_that_cannot_be_read_are_named(folder, arguments, named):
    ended = leave(*arguments)
    assert (ended.code, ended.out) == (2, "")
    assert named in ended.error
    assert "Traceback" not in ended.error
    assert not [*Path("out").iterdir()]


def test_developers_get_the_traceback(folder, monkeypatch):
    monkeypatch.setenv("COVARIANT_DEBUG", "1")
    with pytest.raises(FileNotFoundError, match=r"absent\.csv"):
        leave("estimate", "model.toml", "absent.csv")
