"""A first model file for a log of servos: a robot whose joints follow their commands, with or without its file."""

import json
from typing import Any

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from covariant import models, verbs
from covariant.signals import Record
from covariant.verbs.base.placeholders import placeholders


@pytest.fixture(scope="module")
def recorded():
    """Positions that follow their commands, late and without weight, as servos do."""
    t = np.arange(0.0, 6.0, 0.02)
    waves = [lambda s: 0.5 * np.sin(4.4 * s), lambda s: 0.4 * np.sin(5.6 * s + 1)]
    u, y = (np.stack([wave(t - late) for wave in waves], 1) for late in (0.0, 0.1))
    return Record(t, u, y + 1e-4 * np.random.default_rng(0).normal(size=y.shape))


def data_set(folder, record, names=("shoulder.pos", "elbow.pos"), unit=180 / np.pi, **more):
    """Write a log as a data set of LeRobot: lists of float32, stamps from 0, and a description beside the data."""
    path = folder / "data" / "chunk-000" / "file-000.parquet"
    path.parent.mkdir(parents=True)
    kind = pa.list_(pa.float32(), record.y.shape[1])
    rows = {"episode_index": [0] * len(record.t), "index": list(range(len(record.t)))} | more
    table = pa.table(
        {
            "action": pa.array((unit * record.u).tolist(), kind),
            "observation.state": pa.array((unit * record.y).tolist(), kind),
            "timestamp": pa.array(record.t, pa.float32()),
            **rows,
        }
    )
    pq.write_table(table, path)
    (folder / "meta").mkdir()
    features = {name: {"dtype": "float32", "names": list(names)} for name in ("action", "observation.state")}
    (folder / "meta" / "info.json").write_text(json.dumps({"fps": 50, "features": features}))
    return path


def test_without_a_robot_each_joint_moves_by_itself(tmp_path, recorded):
    log = data_set(tmp_path, recorded, names=("left arm.pos", "left-elbow/2.pos"))
    result = verbs.init(log, overrides={"units.q": "deg"})
    assert list(result.texts("bench")) == ["bench.urdf", "bench.toml"]
    path = result.save(tmp_path / "bench.toml")
    assert result.written_files(path) == [path, tmp_path / "bench.urdf"]
    model: Any = models.load(path).model
    assert model.coordinates == ("left_arm", "left_elbow_2")
    assert "each joint moves by itself, without weight" in str(result)
    q = jnp.array([0.4, -0.2])
    assert np.asarray(model.force(jnp.zeros(()), q, q)) == pytest.approx([0.0, 0.0])
    inertia = np.asarray(model.space(q))
    assert inertia == pytest.approx(np.diag(np.diag(inertia)))
    with pytest.raises(ValueError, match="there is such a file already"):
        result.save(path)


def test_first_values_come_from_the_lag_and_are_placeholders(tmp_path, recorded):
    path = verbs.init(data_set(tmp_path, recorded, unit=1.0)).save(tmp_path / "draft.toml")
    servo = models.document(str(path))["servo"]["elbow"]
    lag = 2 * servo["delay"]
    assert lag == pytest.approx(0.1, abs=0.015)
    assert servo["damping"] == pytest.approx(servo["stiffness"] * lag / 2, rel=0.01)
    assert servo["armature"] == pytest.approx(servo["stiffness"] * lag**2 / 16, rel=0.01)
    named = placeholders(path, {"servo.elbow.damping": 0.7})
    assert named["servo.elbow.stiffness"] == 10.0
    assert "servo.elbow.damping" not in named
    assert len(named) == 7


def test_a_switch_is_an_input_of_each_servo(tmp_path, recorded):
    on = np.where(np.arange(len(recorded.t)) % 200 < 150, 1.0, 0.0)
    frame = pd.DataFrame({"t": recorded.t, "q_a": recorded.y[:, 0], "q_b": recorded.y[:, 1], "torque_enabled": on})
    frame = frame.assign(cmd_a=recorded.u[:, 0], cmd_b=recorded.u[:, 1], volts_a=7.4)
    result = verbs.init(frame)
    path = result.save(tmp_path / "draft.toml")
    file = models.load(path)
    assert file.columns.u == ("cmd_a", "cmd_b", "torque_enabled", "torque_enabled")
    assert file.model.logged_units["u"] == ("rad", "rad", "1", "1")
    assert "# volts_a: supply" in path.read_text()


def test_ticks_have_their_middle_as_zero(tmp_path, recorded):
    ticks = np.round(recorded.y / (2 * np.pi) * 4096) + 2048
    goals = np.round(recorded.u / (2 * np.pi) * 4096) + 2048
    frame = pd.DataFrame({"t": recorded.t, "present_position": ticks[:, 0], "goal_position": goals[:, 0]})
    path = verbs.init(frame).save(tmp_path / "draft.toml")
    document = models.document(str(path))
    assert document["units"] == {"q": "turn/4096", "u": "turn/4096"}
    (offset,) = document["parameters"]["offsets"].values()
    assert offset == pytest.approx(-np.pi, abs=1e-4)
    assert document["measurement"]["quantum"] == pytest.approx(2 * np.pi / 4096, rel=1e-4)
    assert "guessed from the numbers" in path.read_text()


@pytest.mark.parametrize(("episodes", "what"), [(1, "LOG"), (2, "FOLDER")])
def test_the_fit_of_what_was_drafted_from_is_advised(episodes, what, tmp_path, recorded):
    numbers = np.repeat(np.arange(episodes), len(recorded.t) // episodes).tolist()
    log = data_set(tmp_path, recorded, unit=1.0, episode_index=numbers)
    assert f"covariant fit MODEL {what} -o FITTED" in str(verbs.init(log if episodes == 1 else tmp_path))
