"""Names, units and words in tables, lines and figures are those of the machine, of every system of the library."""

import re

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import logs, models
from covariant.calibration.diagnosis import _missing_torques as torques
from covariant.calibration.diagnosis._case import Case, in_coordinates, names_of
from covariant.calibration.diagnosis._columns import COLUMNS
from covariant.calibration.diagnosis._finding import Rows
from covariant.calibration.diagnosis._readings import still_findings
from covariant.calibration.diagnosis._repeats import find_repeats, stuck
from covariant.calibration.diagnosis._sensor_findings import standstill
from covariant.calibration.diagnosis._stages import compared
from covariant.models.files._systems import OF_LINKS, SYSTEMS
from covariant.observers import REGISTRY
from covariant.signals import Record
from covariant.verbs.base.kinds import kind_of

ATTITUDES = {"columns.quaternion_wxyz": ["qw", "qx", "qy", "qz"]}
NEEDED = {
    "heavy_top": ATTITUDES,
    "free_body": ATTITUDES,
    "underwater_vehicle": ATTITUDES,
    "satellite": ATTITUDES,
    "robot": {"parameters.path": "panda"},
}


def kinds():
    for name in SYSTEMS:
        try:
            file = models.load(name, NEEDED.get(name, {}))
        except models.ModelError:
            assert name == "legged_base"  # which needs a robot on legs
            continue
        yield name, kind_of(file)


KINDS = dict(kinds())
OF_A_ROBOT = re.compile(r"\b(arm|encoder|gear|joint|link|motor|robot|rotor|servo)s?\b", re.IGNORECASE)
"""Words of links, joints and motors, which a machine without them must not read."""


def two_slides():
    """A machine of the user's own: two masses on rails, each with an input."""
    model = models.Lagrangian(
        lambda q: jnp.eye(2),
        lambda q: jnp.zeros(()),
        force=lambda t, q, u: u,
        coordinates=("x", "y"),
        units=("m", "m"),
        inputs=2,
    )
    return models.ModelFile("slides", model, logs.Columns(q=("x", "y"), u=("fx", "fy")))


FILES = {name: kind.file for name, kind in KINDS.items() if in_coordinates(kind.file)} | {"slides": two_slides()}


def sentences_of_a_check(file):
    """Whatever the parts of a check may say that know the machine, of a log of sines with nonsense as residuals."""
    n, random = file.dimension, np.random.default_rng(0)
    t = np.arange(0.0, 5.0, 0.01)
    y = np.sin(t[:, None] * np.arange(1, n + 1))
    record = Record(t, np.zeros((len(t), len(file.columns.u))), y)
    case = Case(file, file.model, names_of(file), record, np.zeros(n))
    suspicions = [each for family in COLUMNS for each in family(case)]
    held_out = np.arange(40) % 2 == 0
    regression = torques._Regression(random.random((3 * n, 40, n)), np.ones((40, n)), held_out, None)  # pyright: ignore
    for needed in (range(2 * n), range(2 * n, 3 * n), range(3 * n)):
        for weightless in (False, True):
            suspicions.append(torques._suspicion(case, regression, list(needed), np.ones(n), "rotors", weightless))
    repeated, held = np.repeat(y[::2], 2, axis=0), np.where((t > 2.0) & (t < 3.0), y[200, 0], y[:, 0])
    read = np.column_stack([held, y[:, 1:]])
    suspicions += stuck(case.with_readings(read), read, Rows(t))
    findings = [
        *still_findings(0.0 * y, case.names.q, case.names.units)[0],
        standstill(record, (), case.names, case.ticks),
    ]
    if n > 1:
        findings += still_findings(y * (np.arange(n) > 0), case.names.q, case.names.units)[0]
    findings += find_repeats(repeated, case.ticks, case.names.q, Rows(t))[1]
    yield from compared(file)
    yield from (text for each in suspicions for text in (each.what, each.words, each.remedy, *each.numbers))
    yield from (text for each in findings for text in (each.what, each.evidence, each.line))


@pytest.mark.parametrize("name", FILES)
def test_a_check_speaks_of_joints_to_machines_with_joints_alone(name):
    sentences = list(sentences_of_a_check(FILES[name]))
    assert any("inertia" in each for each in sentences)
    assert any("in each other's place" in each for each in sentences) or len(FILES[name].columns.q) < 2
    foreign = [each for each in sentences if OF_A_ROBOT.search(each)]
    if name in OF_LINKS:
        assert any("rotor inertia" in each for each in foreign)
    else:
        assert foreign == []


def test_observers_for_any_machine_are_described_without_joints():
    plain = [kind.model for name, kind in KINDS.items() if name not in OF_LINKS]
    entries = [each for each in REGISTRY if any(each.fits(model) for model in plain)]
    assert len(entries) > 15
    assert [each.name for each in entries if OF_A_ROBOT.search(f"{each.about} {each.when}")] == []


@pytest.mark.parametrize("name", KINDS)
def test_a_system_with_names_never_has_numbered_columns(name):
    kind = KINDS[name]
    model, estimates = kind.model, kind.estimates
    own = {*model.coordinates, *model.velocities}
    for given in (*estimates.names, *kind.positions.names):
        assert given in own or not re.fullmatch(r"[qv]\d+", given) or re.sub("v", "q", given) in own, given
    assert len(estimates.units) == len(estimates.names)
    assert not set(kind.positions.names) & set(estimates.names)


@pytest.mark.parametrize("name", KINDS)
def test_an_innovation_has_the_unit_of_what_is_measured(name):
    kind = KINDS[name]
    units = kind.measured.units
    assert len(units) == len(kind.measured.names)
    assert not {"s", "1/s"} & set(units)
    if kind.file.mechanical:  # velocities are rates of what is measured
        pairs = zip(units, kind.estimates.units, strict=True)
        assert all(rate == (f"{unit}/s" if unit else "1/s") or not unit for unit, rate in pairs)
    else:
        known = dict(zip(kind.model.coordinates, kind.model.units, strict=True))
        assert units == tuple(known.get(output, "") for output in kind.model.outputs)


def test_a_column_comes_out_in_the_unit_in_which_it_went_in():
    columns = logs.Columns(q=("lift", "arm"), angle=("heading",), units={"q": ("mm", "deg"), "angle": ("deg",)})
    table = {"t": np.ones(1), "arm": np.full(1, np.pi), "arm_filtered_std": np.full(1, np.pi), "v1": np.ones(1)}
    found = columns.as_logged(table | {"lift": np.ones(1), "heading_std": np.full(1, np.pi)})
    assert {name: float(x[0]) for name, x in found.items()} == pytest.approx(
        {"t": 1.0, "arm": 180.0, "arm_filtered_std": 180.0, "v1": 1.0, "lift": 1000.0, "heading_std": 180.0}
    )
    assert columns.units_of(("arm", "v1", "heading")) == {"arm": "deg", "heading": "deg"}
    assert logs.Columns(position=("x", "y")).units_of(("x", "v1")) == {"x": "m"}
