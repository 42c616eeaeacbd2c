"""What takes long of `test_fit_machines.py`."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_fit_machines import FIRST, FRICTION, INERTIA, arms, fitted

import covariant
from covariant import logs
from covariant.verbs import fit


@pytest.fixture(scope="module")
def found(arms) -> dict[str, tuple[float, float]]:
    return fitted(arms, "viscous")


@pytest.mark.exhaustive
def test_machines_share_a_number_and_have_their_own_friction(arms, found):
    truth = {"inertia[0]": INERTIA} | {f"viscous[0]@{arm}": viscous for arm, viscous in FRICTION.items()}
    assert list(found) == list(truth)
    for name, (value, error) in found.items():
        assert abs(value - truth[name]) < 4 * error, (name, value, error)
        assert error < 0.03 * value
    # The third, with the most friction and noise, knows its inertia least, and spoils nothing.
    alone = [fitted(arms[arm], None)["inertia[0]"][1] for arm in ("arm1", "arm2")]
    assert found["inertia[0]"][1] < min(alone), (found, alone)


@pytest.mark.exhaustive
def test_a_shared_number_that_a_machine_contradicts_is_named(arms, found):
    """Friction that differs by three, taken as one number; where only what is its own differs, nothing is said."""
    machines = {arm: arms[arm] for arm in ("arm1", "arm2")}
    wrong = fit("pendulum_chain", machines, "inertia,viscous", each="inertia", overrides=FIRST)
    said = [sentence for sentence in wrong.warnings if "viscous[0] is shared" in sentence]
    assert said, wrong.warnings
    assert all("alone change it by -" in s if "arm1" in s else "alone change it by +" in s for s in said), said
    # A machine with few rows contradicts nothing, whatever they say.
    short = [record._replace(t=record.t[:80], u=record.u[:80], y=record.y[:80]) for record in arms["arm3"]]
    short = [covariant.Record(record.t, record.u, record.y) for record in short]
    both = machines | {"arm3": short}
    right = fit("pendulum_chain", both, "inertia,viscous", each="viscous", overrides=FIRST)
    assert not right.warnings


def with_fault(arms: dict[str, list[Any]], sign: float, late: int) -> tuple[list[str], list[dict[str, Any]]]:
    """Logs written to a folder for each machine, those of arm2 with a fault, and the first values of each."""
    paths = []
    for arm, records in arms.items():
        Path(arm).mkdir()
        for k, record in enumerate(records):
            t, u, q = (np.asarray(each).reshape(len(record.t), -1)[:, 0] for each in record[:3])
            if arm == "arm2":
                t, u, q = t[: len(t) - late], sign * u[late:], q[: len(q) - late]
            paths.append(f"{arm}/log{k}.csv")
            logs.write(Path(paths[-1]), {"t": t, "u": u, "q": q})
    return paths, [FIRST | {"columns.q": ["q"], "columns.u": ["u"]} for _ in paths]


@pytest.mark.exhaustive
def test_a_reversed_input_of_one_machine_is_named_and_mended(arms, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    paths, overrides = with_fault(arms, -1.0, 0)
    misread = fit("pendulum_chain", paths, "inertia,viscous", each="viscous", overrides=overrides, anyway=True)
    assert not misread.better
    assert re.match(r'In the logs of arm2 u .* \[units\] u = "-1".* in overrides', misread.details["suspicion"])
    mended = [each | ({"units.u": "-1"} if "arm2" in path else {}) for each, path in zip(overrides, paths, strict=True)]
    right = fit("pendulum_chain", paths, "inertia,viscous", each="viscous", overrides=mended)
    assert right.better
    assert (np.abs(right.values - [INERTIA, *FRICTION.values()]) < 4 * right.standard_errors).all(), right


@pytest.mark.exhaustive
def test_late_positions_of_one_machine_are_named(arms, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    paths, overrides = with_fault(arms, 1.0, 4)
    late = fit("pendulum_chain", paths, "inertia,viscous", each="viscous", overrides=overrides, anyway=True)
    assert re.match(r"In the logs of arm2 positions seem to follow u by about 0\.08 s", late.details["suspicion"])
    assert not late.better


@pytest.mark.exhaustive
def test_a_shared_number_of_robots_that_one_contradicts_is_named():
    """Three rotors that the fit takes for one; friction, which is each arm's own, is no contradiction."""
    arms = {}
    for k, (rotor, viscous) in enumerate([(0.004, 0.02), (0.004, 0.04), (0.012, 0.06)]):
        law = {"elbow": {"viscous": viscous, "coulomb": 0.0}}
        truth = {"parameters.friction": law, "parameters.armature": {"elbow": rotor}}
        motion: dict[str, Any] = {"duration": 8.0, "rate": 200.0, "amplitude": [2.2, 0.5], "frequency": 0.6}
        log = covariant.simulate("double_pendulum", **motion, noise=1e-4, seed=k, overrides=truth)
        arms[f"arm{k}"] = [log.record]
    first = {"inputs.between": "held"}
    names = "friction.elbow.viscous,armature.elbow"
    (sentence,) = fit("double_pendulum", arms, names, each="friction", overrides=first).details["unlike"]
    assert sentence.startswith("armature.elbow is shared, but the logs of arm2 alone change it by +0.00")


@pytest.mark.exhaustive
def test_the_order_of_machines_changes_nothing(arms, found):
    turned = fitted(dict(reversed(arms.items())), "viscous")
    for name, (value, error) in found.items():
        np.testing.assert_allclose(turned[name], (value, error), rtol=1e-4)


@pytest.mark.exhaustive
def test_one_machine_is_fitted_as_without_numbers_of_its_own(arms):
    plain, own = fitted(arms["arm2"], None), fitted({"arm2": arms["arm2"]}, "viscous")
    assert list(own) == ["inertia[0]", "viscous[0]@arm2"]
    assert list(own.values()) == list(plain.values())


DRIVES = '''
import jax.numpy as jnp

from covariant.models import Lagrangian


def drives(gain=(1.0, 1.0), viscous=0.1):
    """Two masses on springs, each with its drive, under the same friction."""
    return Lagrangian(
        lambda q: jnp.eye(2),
        lambda q: jnp.sum(q**2) / 2,
        lambda t, q, u: jnp.asarray(gain) * u,
        lambda q, v: viscous * v,
        coordinates=("x", "y"),
    )
'''


@pytest.mark.exhaustive
def test_what_no_machine_shows_alone_all_show_together(tmp_path, monkeypatch):
    """Each machine drives one of its two masses."""
    monkeypatch.chdir(tmp_path)
    Path("drives.py").write_text(DRIVES)
    Path("rough.toml").write_text(
        'system = "drives:drives"\n[parameters]\ngain = [2.0, 2.0]\nviscous = 0.1\n[inputs]\nbetween = "held"\n'
    )
    motion: dict[str, Any] = {"duration": 10.0, "rate": 50.0, "q0": [0.3, 0.3], "noise": 1e-3}
    gains = {"parameters.gain": [3.0, 5.0]}
    logs = {
        arm: [
            covariant.simulate(
                "rough.toml",
                amplitude=amplitude,
                frequency=0.2 + 0.1 * k,
                seed=k,
                overrides=gains | {"parameters.viscous": viscous},
                **motion,
            ).record
            for k in range(2)
        ]
        for arm, amplitude, viscous in (("left", [0.5, 0.0], 0.2), ("right", [0.0, 0.5], 0.4))
    }
    both = fit("rough.toml", logs, "gain,viscous", each="viscous")
    assert both.columns["parameter"].tolist() == ["gain[0]", "gain[1]", "viscous@left", "viscous@right"]
    assert both.columns["determined"].all(), both
    assert (np.abs(both.values - [3.0, 5.0, 0.2, 0.4]) < 4 * both.standard_errors).all(), both
    *gain, left, right = both.values.tolist()
    assert {arm: content["parameters"] for arm, content in both.machines.items()} == {
        arm: {"gain": gain, "viscous": viscous} for arm, viscous in (("left", left), ("right", right))
    }
    # With nothing shared each machine is fitted by itself.
    own = fit("rough.toml", logs, "gain,viscous", each="gain,viscous")
    sentences = "\n".join(own.details["undetermined"])
    assert "gain[1]@left cannot be told from this log" in sentences
    assert "gain[0]@right cannot be told from this log" in sentences
    assert [path.name for path in own.written_files("fitted.toml")] == ["fitted_left.toml", "fitted_right.toml"]


@pytest.mark.exhaustive
def test_each_log_may_have_a_delay_of_its_own():
    """Inputs that act later in the second log: with its delay both tell one stiffness, without it another."""
    truth = {"parameters.stiffness": 4.0, "inputs.between": "held"}
    motion: dict[str, Any] = {"duration": 10.0, "rate": 50.0, "amplitude": 2.0, "noise": 1e-3}
    delays = ({"inputs.delay": 0.0}, {"inputs.delay": 0.3}, {"inputs.delay": 0.0})
    logs = [
        covariant.simulate("oscillator", frequency=0.5, seed=k, overrides=truth | delay, **motion).record
        for k, delay in enumerate(delays)
    ]
    first = {"parameters.stiffness": 3.0, "inputs.between": "held"}
    told = fit("oscillator", logs, "stiffness", overrides=[first | delay for delay in delays])
    untold = fit("oscillator", logs, "stiffness", overrides=first, anyway=True)
    assert abs(told.values[0] - 4.0) < 4 * told.standard_errors[0] < 0.1
    assert abs(untold.values[0] - 4.0) > 10 * abs(told.values[0] - 4.0)
