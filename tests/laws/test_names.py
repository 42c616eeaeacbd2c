"""Names and units in tables, lines and figures are those of the machine, of every system of the library."""

import re

import numpy as np
import pytest

from covariant import logs, models
from covariant.models.files._systems import SYSTEMS
from covariant.verbs.base.kinds import kind_of

ATTITUDES = {"columns.quaternion_wxyz": ["qw", "qx", "qy", "qz"]}
NEEDED = {
    "heavy_top": ATTITUDES,
    "free_body": ATTITUDES,
    "underwater_vehicle": ATTITUDES,
    "satellite": ATTITUDES,
    "satellite_arm": ATTITUDES,
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
