"""Of several faults that look alike the plain one is named, and nothing that it explains: what takes long."""

import numpy as np
import pytest
from test_causes import TORQUE, T, pendulum, read, swing, wrong

from covariant.calibration import diagnose
from covariant.signals import Record


@pytest.mark.exhaustive("0.9")
@pytest.mark.parametrize("coulomb", [0.3, 0.6, 0.9])
def test_a_unit_by_its_prefix_and_friction_are_no_delay_and_no_odd_scale(coulomb):
    found = diagnose(pendulum(), Record(T, 1e3 * TORQUE[:, None], read(swing(coulomb=coulomb)))).findings
    assert [each.what for each in found[:2]] == ["unit of an input", "friction"]
    assert found[0].line == '[units] u = "mN m"'
    assert abs(found[1].numbers["Coulomb friction of q1"] / coulomb - 1) < 0.1
    assert not {"delay against the inputs", "scale of an input"} & {each.what for each in found}


@pytest.mark.parametrize("constant", [0.05, 40.0])
def test_an_odd_constant_of_the_motor_and_friction_are_no_delay(constant):
    found = diagnose(pendulum(), Record(T, TORQUE[:, None] / constant, read(swing(coulomb=0.6)))).findings
    whats = [each.what for each in found if each.wrong]
    assert whats == ["friction", "scale of an input"]
    scale = next(each for each in found if each.what == "scale of an input")
    assert abs(scale.numbers["scale"] / constant - 1) < 0.05


@pytest.mark.parametrize(
    ("coulomb", "factor", "whats"),
    [
        (0.0, 1.0, ["gravity"]),
        (0.4, 1.0, ["gravity and friction"]),
        pytest.param(0.0, 1e3, ["unit of an input", "gravity"], marks=pytest.mark.long),
        pytest.param(0.0, -1.0, ["sign of an input", "gravity"], marks=pytest.mark.long),
    ],
)
def test_torques_beyond_gravity_compensation_are_no_rotor(coulomb, factor, whats):
    log = Record(T, factor * TORQUE[:, None], read(swing(coulomb=coulomb, gravity=0.0)))
    found = [each for each in diagnose(pendulum(), log).findings if each.wrong]
    assert [each.what for each in found] == whats
    assert found[-1].line.startswith("[parameters] gravity = 0")
    weightless = pendulum(**{"parameters.gravity": 0.0, "parameters.coulomb": [coulomb * 2 / np.pi]})
    assert "gravity" not in wrong(weightless, log._replace(u=log.u / factor))


@pytest.mark.exhaustive
def test_a_wrong_mass_is_not_called_gravity_compensation():
    for mass in (0.3, 3.0):
        found = wrong(
            pendulum(**{"parameters.mass": [mass], "parameters.com": [0.1]}), Record(T, TORQUE[:, None], read(swing()))
        )
        assert not any(what.startswith("gravity") for what in found)


def test_a_row_for_each_edge_of_an_encoder_is_not_read_in_quanta():
    t = np.arange(0.0, 8.0, 5e-4)
    x, quantum = swing(t, np.zeros_like(t), 1.4)[:, 0], 2 * np.pi / 400
    counts = np.round(x / quantum)
    edges = np.concatenate([[True], np.diff(counts) != 0])
    log = Record(t[edges], np.zeros((edges.sum(), 0)), quantum * counts[edges, None])
    free = {"parameters.actuated": []}
    for stated, is_wrong in (({}, False), ({"measurement.quantum": quantum}, True)):
        (found,) = diagnose(pendulum(**free, **stated), log).findings
        assert (found.what, found.wrong) == ("ticks", is_wrong)
        assert "put the mean of each reading and the one before" in found.line
        assert "quantum" not in found.line
    midway = log._replace(y=np.concatenate([log.y[:1], (log.y[1:] + log.y[:-1]) / 2]))
    assert wrong(pendulum(**free, **{"measurement.std": 0.1 * quantum}), midway) == []


def test_a_machine_on_a_slope_has_some_of_its_weight():
    log = Record(T, TORQUE[:, None], read(swing(gravity=2.5)))
    found = diagnose(pendulum(), log).findings
    assert any(each.wrong for each in found)
    assert not any(each.what.startswith("gravity") for each in found)
