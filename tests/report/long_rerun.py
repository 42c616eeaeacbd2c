"""Recordings for the Rerun viewer hold what the result holds."""

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import covariant
from covariant.models import robots
from covariant.verbs.base.outcome import slow_units
from covariant.verbs.base.recording import _bodies

rerun = pytest.importorskip("rerun")


@pytest.fixture(scope="module")
def result():
    log = covariant.simulate("oscillator", duration=0.5, rate=100.0, q0=[1.0], noise=1e-4).record
    return covariant.estimate("oscillator", log, alpha=40.0, beta=800.0, engine="jax")


def columns_of(path: Path) -> dict[str, np.ndarray]:
    found = {}
    if importlib.util.find_spec("rerun.chunk") is None:  # an older Rerun reads its files as data frames
        view = importlib.import_module("rerun.dataframe").load_recording(path).view(index="t", contents="/**")
        table = view.select().read_all()
        ending = ":Scalars:scalars"
        names = [name for name in table.schema.names if name.endswith(ending)]
        return {name.removesuffix(ending): np.concatenate(table[name].drop_null().to_pylist()) for name in names}
    for chunk in rerun.chunk.RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.endswith("Scalars:scalars"):
                values = np.array([cell[0] for cell in batch.column(name).to_pylist()])
                found.setdefault(chunk.entity_path, []).append(values)
    return {entity: np.concatenate(parts) for entity, parts in found.items()}


def test_curves_of_a_recording_are_the_columns_of_the_result(result, tmp_path):
    columns = columns_of(result.rerun(tmp_path / "run.rrd"))
    entity = rerun.new_entity_path(["velocity", "v", "estimated [m/s]"])
    assert np.array_equal(columns[entity], result.velocity[:, 0])
    assert len(columns) == 3  # measured, and estimated position and velocity


def test_a_recording_without_rerun_names_the_extra(result, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ImportError, match=r"pip install 'covariant\[live\]'"):
        result.rerun(tmp_path / "run.rrd")
    assert not list(tmp_path.iterdir())


def test_a_recording_has_its_suffix(result, tmp_path):
    with pytest.raises(ValueError, match=r"must end in \.rrd"):
        result.rerun(tmp_path / "run.csv")


@pytest.mark.exhaustive
def test_bodies_stand_in_the_frames_of_their_links():
    model, q = robots.load("double_pendulum"), jnp.array([1.0, 0.5])
    kind = SimpleNamespace(positions=SimpleNamespace(names=("q1", "q2")))
    given = SimpleNamespace(
        loaded=SimpleNamespace(model=model, kind=kind), run=SimpleNamespace(estimate=np.array([[1.0, 0.5, 0.0, 0.0]]))
    )
    drawn = _bodies(given, np.array([0]))
    assert {(body.name, body.label) for body in drawn} == {("base", ""), ("upper", "q1"), ("lower", "q2")}
    for body in drawn:
        np.testing.assert_allclose(body.poses[0], model.space.pose(q, body.name), rtol=0, atol=1e-12)
        assert len(body.segments) == (body.name != "base")


def test_a_parameter_before_a_force_does_not_take_its_unit(result):
    """Units are found by name: a friction that is estimated along comes before the force in the order of the filter."""
    units = slow_units(result.loaded)
    assert units == {"external_force1": "N"}
    wrenches = result.loaded._replace(file=result.loaded.file._replace(wrenches={"tip": {}}))
    assert slow_units(wrenches) == units | {f"f{x}_tip": "N" for x in "xyz"} | {f"t{x}_tip": "N m" for x in "xyz"}
