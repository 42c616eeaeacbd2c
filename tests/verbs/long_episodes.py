"""A folder of recorded episodes of an arm: a draft, a fit without options, and a verb over all of them."""

import runpy
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from commands import command, leave
from test_servo_draft import data_set

from covariant import logs, many, models
from covariant.signals import Record

bench = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "servo_machines.py"))
EPISODES, JUMP, SIZE = 16, 9, 0.15
"""Number of episodes, the one from which on a zero is another, and by how much [rad]."""
NAMES = ("upper_joint.pos", "lower_joint.pos")
TRUTH = {"stiffness": 14.0, "damping": 0.6, "armature": 0.02, "coulomb": 0.06, "delay": 0.03, "limit": 6.0}


def simulated(seed, rate, more=0.0):
    """An episode of the arm, the zero of whose second joint is another by so much."""
    machine = bench["two_joints"]()
    servo = bench["Servo"].of(2, offset=np.array([0.02, -0.03 + more]), **TRUTH)
    t, command = bench["commands"](machine, 4.0, rate, np.random.default_rng(seed))
    log = bench["simulate"](machine, servo, t, command)
    return Record(log.t, log.command, log.q)


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """A folder with the URDF of an arm of two joints, and its episodes in a data set; MuJoCo moves it."""
    folder = tmp_path_factory.mktemp("arm")
    (folder / "arm.urdf").write_text(bench["two_joints"]().urdf, encoding="utf-8")
    each = [simulated(k, 50, SIZE * (k >= JUMP)) for k in range(EPISODES)]
    numbers = np.repeat(np.arange(EPISODES), [len(record.t) for record in each]).tolist()
    whole = Record(*(np.concatenate(part) for part in zip(*(record[:3] for record in each), strict=True)))
    data_set(folder / "set", whole, NAMES, episode_index=numbers)
    return folder


@pytest.fixture(scope="module")
def fitted(arm):
    """The arm as it is drafted and fitted by commands, without options."""
    known = ("--set", f'parameters.path="{arm / "arm.urdf"}"')
    assert leave("init", arm / "set", "-o", arm / "arm.toml", *known).code == 0
    return command("fit", arm / "arm.toml", arm / "set", "-o", arm / "fitted.toml")


@pytest.mark.long
def test_a_zero_that_changes_is_named_with_its_episode(fitted):
    (zero,) = (each for each in fitted["changes"] if "zero" in each)
    assert zero.startswith("the zero of lower_joint changes by")
    assert zero.endswith(f"#{JUMP} on")
    assert float(zero.split()[6]) == pytest.approx(SIZE, abs=0.02)
    assert [row["log"].partition("#")[2] for row in fitted["each"]] == [str(k) for k in range(EPISODES)]


@pytest.mark.long
def test_numbers_are_near_those_of_the_arm_and_their_errors_say_how_near(fitted, arm):
    # The longer stretch of episodes is that before the change.
    truth = {"upper_joint": TRUTH | {"offset": 0.02}, "lower_joint": TRUTH | {"offset": -0.03}}
    rows = [row for row in fitted["parameters"] if row["determined"]]
    off = {}
    for row in rows:
        _, joint, key = row["name"].split(".")
        off[row["name"]] = (row["after"] - truth[joint].get(key, 0.0)) / row["standard_error"]
    assert len(off) >= 10
    assert all(abs(each) < 4.0 for each in off.values()), off
    assert max(fitted["held_out_errors"]["after"]["position"]) < 0.01
    servo = models.document(str(arm / "fitted.toml"))["servo"]
    assert servo["lower_joint"]["offset"] == pytest.approx(-0.03, abs=0.01)
    assert servo["lower_joint"]["stiffness"] == pytest.approx(14.0, rel=0.1)


@pytest.mark.long
def test_a_verb_goes_over_the_episodes_and_goes_on_where_it_was_stopped(fitted, arm, tmp_path):
    said = []
    noise = {"uncertainty.acceleration": 5.0, "uncertainty.correlation_time": 0.02}

    def run():
        said.clear()
        told = lambda text, fraction=None: said.append(text)  # noqa: E731
        settings = {"overrides": noise, "out": tmp_path / "out", "progress": told}
        return many.over_logs("estimate", arm / "fitted.toml", [arm / "set"], **settings)

    first = run()
    assert said[0] == f"estimate: 0 of {EPISODES} logs"
    assert not first.failed
    assert first.columns["rows"].tolist() == [200.0] * EPISODES
    files = [row["file"] for _, row in first.each]
    assert len({*files}) == EPISODES
    (tmp_path / "out" / files[3]).unlink()
    again = run()
    assert said[0] == f"estimate: {EPISODES - 1} of {EPISODES} logs"
    assert again.each == first.each
    sets = [part for key, value in noise.items() for part in ("--set", f"{key}={value}")]
    log = logs.episodes(arm / "set")[3]
    assert leave("estimate", arm / "fitted.toml", log, "-o", tmp_path / "v.parquet", *sets).code == 0
    assert pq.read_table(tmp_path / "out" / files[3]).equals(pq.read_table(tmp_path / "v.parquet"))


@pytest.mark.long
def test_episodes_that_cannot_be_used_are_named_and_those_of_another_rate_count(fitted, arm, tmp_path):
    path = data_set(tmp_path / "set", simulated(0, 50), NAMES)
    for k in range(1, 8):
        own = data_set(tmp_path / f"set{k}", simulated(k, (50, 30)[k % 2]), NAMES)
        own.rename(path.with_name(f"file-{k:03d}.parquet"))
    path.with_name("file-008.parquet").write_bytes(b"PAR1 and no more")
    short = pq.read_table(path).slice(0, 3)
    pq.write_table(short, path.with_name("file-009.parquet"))
    asked = ("--parameters", "servo.lower_joint.offset", "--set", "servo.lower_joint.offset=0.1")
    result = command("fit", arm / "fitted.toml", tmp_path / "set", *asked, "-o", tmp_path / "again.toml")
    assert "2 could not be used, the first: " in result["chosen"]
    assert "file-008.parquet: cannot be read as .parquet" in result["chosen"]
    failed = {Path(row["log"]).name: row.get("failed", "") for row in result["each"]}
    assert [name for name, why in failed.items() if why] == ["file-008.parquet", "file-009.parquet"]
    assert failed["file-009.parquet"].endswith("3 rows have positions, and 10 are needed")
    assert all(row["lower_joint.offset"] == pytest.approx(-0.03, abs=0.02) for row in result["each"][:8])


@pytest.mark.long
def test_the_arm_whose_joint_has_another_zero_is_named_among_arms_of_one_kind(arm, tmp_path):
    for k, name in enumerate("abcd"):
        for number in range(5):
            record = simulated(100 + 5 * k + number, 50, SIZE * (name == "b"))
            own = data_set(tmp_path / name / str(number), record, NAMES)
            folder = tmp_path / "arms" / name / "data" / "chunk-000"
            folder.mkdir(parents=True, exist_ok=True)
            own.rename(folder / f"file-{number:03d}.parquet")
        (folder.parents[1] / "meta").mkdir()
        (tmp_path / name / "0" / "meta" / "info.json").rename(folder.parents[1] / "meta" / "info.json")
    known = ("--set", f'parameters.path="{arm / "arm.urdf"}"')
    assert leave("init", tmp_path / "arms" / "a", "-o", tmp_path / "arm.toml", *known).code == 0
    found = command("fit", tmp_path / "arm.toml", tmp_path / "arms", "-o", tmp_path / "fitted.toml")
    (zero,) = found["changes"]
    assert zero.startswith(f"the zero of lower_joint is another on {tmp_path / 'arms' / 'b'}: ")
    assert float(zero.split(": ")[1].split()[0]) == pytest.approx(SIZE, abs=0.02)
    odd = [Path(row["log"]).parents[2].name for row in found["each"] if row["odd"]]
    assert odd == ["b"] * 5
    assert models.document(str(tmp_path / "fitted.toml"))["servo"]["lower_joint"]["offset"] == pytest.approx(
        -0.03, abs=0.01
    )
