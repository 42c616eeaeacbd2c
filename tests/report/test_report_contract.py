"""What a report is of: velocities, positions and velocities, or states, from the arrays of any engine."""

import re

import jax.numpy as jnp
import numpy as np
import pytest

from covariant.report import EstimateReport, figure, write_report
from covariant.report._panels import quantities

ARRAYS = pytest.mark.parametrize("array", [np.asarray, jnp.asarray], ids=["numpy", "jax"])


def chart(report: EstimateReport) -> EstimateReport:
    """Positions and velocities in coordinates."""
    return report


def velocities_in_a_chart(report: EstimateReport) -> EstimateReport:
    """Velocities alone, beside measured positions."""
    return report._replace(estimates={label: x[:, -3:] for label, x in report.estimates.items()})


def group(report: EstimateReport) -> EstimateReport:
    """Velocities of a system whose configuration is no curve."""
    return velocities_in_a_chart(report)._replace(q_measured=None, coordinates=("p", "q", "r"), units=("rad/s",) * 3)


def states(report: EstimateReport) -> EstimateReport:
    """States of a state-space model; its outputs are other quantities, so there is no innovation to draw."""
    return group(report)._replace(estimated="state", units=("A", "A", "rad/s"), innovation={}, distance={})


KINDS = {
    chart: ["position", "velocity", "error", "innovation", "distance"],
    velocities_in_a_chart: ["position", "velocity", "error", "innovation", "distance"],
    group: ["velocity", "error", "innovation", "distance"],
    states: ["velocity", "error"],
}


@pytest.mark.long("chart", "group", "jax", "velocities_in_a_chart")
@ARRAYS
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_kind_is_drawn_from_the_arrays_of_any_engine(kind, array, make, tmp_path):
    whole = make()
    report = kind(whole)
    report = report._replace(
        estimates={label: array(x) for label, x in report.estimates.items()},
        innovation={label: array(e) for label, e in report.innovation.items()},
        v_reference=array(report.v_reference),
        t=array(report.t),
    )
    panels = quantities(report.check())
    assert list(panels) == KINDS[kind]
    for drawn, x in zip(panels["error"].curves, whole.estimates.values(), strict=True):
        np.testing.assert_allclose(drawn.values, x[:, 3:] - whole.v_reference, atol=1e-12)
    drawn = panels["position"].curves if "position" in panels else ()
    assert len(drawn) == {chart: 4, velocities_in_a_chart: 1}.get(kind, 0)
    page, *figures = write_report(report, tmp_path / "page.html")
    assert page.stat().st_size > 1e5
    assert figures
    assert len(figure(report).axes) == 6


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        (chart, 4, "(400, 3) (velocities) or (400, 6) (positions and then velocities); got (400, 4)"),
        (group, 6, "(400, 3) (velocities); got (400, 6)"),
        (states, 6, "(400, 3) (states); got (400, 6)"),
    ],
)
def test_an_estimate_of_another_shape_is_told_what_is_expected(kind, change, message, make):
    report = kind(make())._replace(estimates={"EKF": np.zeros((400, change))}, innovation={}, distance={})
    with pytest.raises(ValueError, match=re.escape(f"estimates['EKF'] must have the shape {message}")):
        report.check()


def test_states_have_no_measured_positions_beside_them(make):
    with pytest.raises(ValueError, match="q_measured belongs to velocities"):
        velocities_in_a_chart(make())._replace(estimated="state").check()
    with pytest.raises(ValueError, match="velocity, state; got 'acceleration'"):
        make()._replace(estimated="acceleration").check()
