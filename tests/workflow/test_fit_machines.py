"""`fit(..., each=...)`: logs of several machines fitted together, with shared numbers and numbers of their own."""

import re
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import covariant
from covariant import logs, models
from covariant.calibration.identification import held_out_logs
from covariant.workflow import FitResult, check_machine_files, fit, over_logs
from covariant.workflow._inputs import Job

FRICTION = {"arm1": 0.05, "arm2": 0.12, "arm3": 0.3}
KNOWN = {"parameters.mass": [1.0], "parameters.length": [0.5], "parameters.com": [0.25], "inputs.between": "held"}
FIRST = KNOWN | {"parameters.inertia": [0.02], "parameters.viscous": [0.1]}
INERTIA = 0.03
NOISE = {"arm1": 1e-3, "arm2": 1e-3, "arm3": 5e-3}


def swings(viscous: float, noise: float, seed: int) -> list[Any]:
    truth = KNOWN | {"parameters.inertia": [INERTIA], "parameters.viscous": [viscous]}
    motion: dict[str, Any] = {"duration": 10.0, "rate": 50.0, "amplitude": 0.6, "noise": noise}
    return [
        covariant.simulate("pendulum_chain", q0=q0, frequency=f, seed=seed + k, overrides=truth, **motion).record
        for k, (q0, f) in enumerate([(0.6, 0.5), (-0.4, 0.7)])
    ]


@pytest.fixture(scope="module")
def arms() -> dict[str, list[Any]]:
    return {arm: swings(viscous, NOISE[arm], 10 * k) for k, (arm, viscous) in enumerate(FRICTION.items())}


def fitted(arms: dict[str, list[Any]] | list[Any], each: str | None) -> dict[str, tuple[float, float]]:
    result = fit("pendulum_chain", arms, "inertia,viscous", each=each, overrides=FIRST, horizon=0.6)
    rows = zip(result.columns["parameter"], result.values, result.standard_errors, strict=True)
    return {name: (value, error) for name, value, error in rows}


@pytest.fixture(scope="module")
def found(arms) -> dict[str, tuple[float, float]]:
    return fitted(arms, "viscous")


@pytest.mark.long
def test_machines_share_a_number_and_have_their_own_friction(arms, found):
    truth = {"inertia[0]": INERTIA} | {f"viscous[0]@{arm}": viscous for arm, viscous in FRICTION.items()}
    assert list(found) == list(truth)
    for name, (value, error) in found.items():
        assert abs(value - truth[name]) < 4 * error, (name, value, error)
        assert error < 0.03 * value
    # The third, with the most friction and noise, knows its inertia least, and spoils nothing.
    alone = [fitted(arms[arm], None)["inertia[0]"][1] for arm in ("arm1", "arm2")]
    assert found["inertia[0]"][1] < min(alone), (found, alone)


@pytest.mark.long
def test_a_shared_number_that_a_machine_contradicts_is_named(arms, found):
    """Friction that differs by three, taken as one number; where only what is its own differs, nothing is said."""
    machines = {arm: arms[arm] for arm in ("arm1", "arm2")}
    wrong = fit("pendulum_chain", machines, "inertia,viscous", each="inertia", overrides=FIRST, horizon=0.6)
    said = [sentence for sentence in wrong.warnings if "viscous[0] is shared" in sentence]
    assert said, wrong.warnings
    assert all("alone change it by -" in s if "arm1" in s else "alone change it by +" in s for s in said), said
    # A machine with few windows contradicts nothing, whatever they say.
    short = [record._replace(t=record.t[:80], u=record.u[:80], y=record.y[:80]) for record in arms["arm3"]]
    short = [covariant.Record(record.t, record.u, record.y) for record in short]
    both = machines | {"arm3": short}
    right = fit("pendulum_chain", both, "inertia,viscous", each="viscous", overrides=FIRST, horizon=0.6)
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


@pytest.mark.long
def test_a_reversed_input_of_one_machine_is_named_and_mended(arms, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    paths, overrides = with_fault(arms, -1.0, 0)
    misread = fit("pendulum_chain", paths, "inertia,viscous", each="viscous", overrides=overrides, anyway=True)
    assert not misread.better
    assert re.match(r'The input u in the logs of arm2 .* \[units\] u = "-1" in overrides', misread.details["suspicion"])
    mended = [each | ({"units.u": "-1"} if "arm2" in path else {}) for each, path in zip(overrides, paths, strict=True)]
    right = fit("pendulum_chain", paths, "inertia,viscous", each="viscous", overrides=mended)
    assert right.better
    assert (np.abs(right.values - [INERTIA, *FRICTION.values()]) < 4 * right.standard_errors).all(), right


@pytest.mark.long
def test_late_positions_of_one_machine_are_named(arms, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    paths, overrides = with_fault(arms, 1.0, 4)
    late = fit("pendulum_chain", paths, "inertia,viscous", each="viscous", overrides=overrides, anyway=True)
    assert re.match(r"Positions in the logs of arm2 seem to follow u by about 0\.08 s", late.details["suspicion"])
    assert not late.better


@pytest.mark.long
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


@pytest.mark.long
def test_the_order_of_machines_changes_nothing(arms, found):
    turned = fitted(dict(reversed(arms.items())), "viscous")
    for name, (value, error) in found.items():
        np.testing.assert_allclose(turned[name], (value, error), rtol=1e-5)


@pytest.mark.long
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


@pytest.mark.long
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


def test_the_last_log_of_each_machine_is_held_out():
    stamps = [np.arange(0.0, 10.0, 0.01)] * 6
    assert held_out_logs(stamps, 0.5, [0, 0, 1, 2, 1, 0]).tolist() == [False, False, False, False, True, True]
    assert held_out_logs(stamps[:3], 0.5, [2, 0, 1]).tolist() == [False] * 3
    # Of short logs two are held out, if there are as many more.
    assert held_out_logs(stamps, 2.0, [0] * 5 + [1]).tolist() == [False] * 3 + [True] * 2 + [False]


def test_each_machine_has_a_file_with_its_numbers(tmp_path):
    rows = [
        {"name": name, "before": 1.0, "after": value, "standard_error": 0.1, "determined": True}
        for name, value in (("mass", 2.0), ("viscous@arm1", 3.0), ("viscous@arm2", 4.0))
    ]
    contents = {arm: {"system": "oscillator", "parameters": {"stiffness": k}} for arm, k in (("arm1", 3), ("arm2", 4))}
    details = {"parameters": rows, "undetermined": [], "fitted_to": "a.csv", "better": True}
    result = FitResult([Job("oscillator", None)], {}, details, None, contents)
    assert result.save(tmp_path / "fitted.toml") == tmp_path / "fitted_arm1.toml"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fitted_arm1.toml", "fitted_arm2.toml"]
    text = (tmp_path / "fitted_arm2.toml").read_text()
    assert "stiffness = 4" in text
    assert "viscous@arm2 = 4 ±" in text
    assert "arm1" not in text
    (tmp_path / "fitted_arm1.toml").unlink()
    with pytest.raises(ValueError, match=r"fitted_arm2\.toml: there is such a file already"):
        result.save(tmp_path / "fitted.toml")
    assert not (tmp_path / "fitted_arm1.toml").exists()


def test_a_urdf_file_in_the_way_of_one_machine_leaves_no_file_of_another(tmp_path):
    inertia = {"lower": [0.6, 0.0, 0.0, -0.1, 0.02, 0.02, 0.001, 0.0, 0.0, 0.0]}
    robot = {"system": "robot", "parameters": {"path": "double_pendulum", "inertia": inertia}}
    details = {"parameters": [], "undetermined": [], "fitted_to": "a.csv", "better": True}
    result = FitResult([Job("double_pendulum", None)], {}, details, None, dict.fromkeys(("arm1", "arm2"), robot))
    (tmp_path / "fitted_arm2.urdf").write_text("mine\n")
    with pytest.raises(ValueError, match=r"fitted_arm2\.urdf: there is such a file already"):
        result.save(tmp_path / "fitted.toml")
    assert [path.name for path in tmp_path.iterdir()] == ["fitted_arm2.urdf"]
    result.save(tmp_path / "fitted.toml", overwrite=True)
    written: Any = models.load(str(tmp_path / "fitted_arm2.toml")).model
    expected = models.robots.load("double_pendulum", inertia=inertia)
    q = jnp.array([0.3, -0.8])
    np.testing.assert_allclose(written.space(q), expected.space(q), rtol=1e-9)
    names = [path.name for path in result.written_files(tmp_path / "fitted.toml")]
    assert names == ["fitted_arm1.toml", "fitted_arm1.urdf", "fitted_arm2.toml", "fitted_arm2.urdf"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names


def test_a_file_of_a_machine_that_exists_is_refused_before_the_fit(tmp_path):
    (tmp_path / "fitted_right.toml").write_text("mine\n")
    logs = [tmp_path / machine / "log.csv" for machine in ("left", "right")]
    with pytest.raises(ValueError, match=r"fitted_right\.toml: there is such a file already"):
        check_machine_files("oscillator", tmp_path / "fitted.toml", logs)
    check_machine_files("oscillator", tmp_path / "fitted.toml", logs[:1])


def test_what_cannot_be_of_each_machine_is_refused(tmp_path):
    record = covariant.simulate("oscillator", duration=5.0, rate=50.0, q0=1.0).record
    with pytest.raises(ValueError, match="each: a log in memory does not say of which machine it is"):
        fit("oscillator", [record, record], "stiffness", each="stiffness")
    with pytest.raises(ValueError, match=r"each: unknown number 'mass'\. Known: stiffness"):
        fit("oscillator", {"a": record}, "stiffness", each="mass", overrides={"parameters.stiffness": 2.0})
    with pytest.raises(ValueError, match="`each` is for logs that are fitted together"):
        over_logs("fit", "oscillator", [record], parameters="stiffness", each="stiffness")
    with pytest.raises(ValueError, match=r"overrides make inputs\.lag others than those of record"):
        fit("oscillator", [record, record], "stiffness", overrides=[{"inputs.lag": lag} for lag in (0.1, 0.2)])
    with pytest.raises(ValueError, match=r"overrides make \[parameters\] others than those of record"):
        fit("oscillator", [record, record], "stiffness", overrides=[{"parameters.stiffness": k} for k in (1.0, 2.0)])


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
