"""What takes long of `test_robot_fit.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_robot_fit import HALF
from two_links import Truth, accelerate, swing

from covariant import models
from covariant.calibration import fit_robot
from covariant.calibration.identification import robot_misfit
from covariant.signals import Record

FRICTION = ("viscous", "coulomb", "asymmetry")


def expected(truth: Truth, *groups: str) -> np.ndarray:
    """The true values of the groups' numbers, in the order of the names."""
    values: list[float] = []
    for group in groups:
        if group == "friction":
            values += [getattr(truth, kind)[j] for j in range(2) for kind in FRICTION]
        elif group == "payload":
            values += [truth.load, 0.0, 0.0, -truth.reach]
        else:
            values += list(getattr(truth, group))
    return np.array(values)


def fitted(truth: Truth, names: list[str], seconds: float = 12.0, **noise):
    t, u, y = swing(1, truth, seconds, **noise)
    return fit_robot(models.robot_family("double_pendulum", names), [Record(t, u[0], y[0])], HALF)


@pytest.mark.exhaustive
def test_the_arm_of_these_tests_is_the_robot():
    """The closed form against the sweeps along the tree, with everything that is fitted."""
    truth = Truth(stribeck=(0.1, 0.05), load=0.2, constants=(1.1, 0.9))
    joints = ("shoulder", "elbow")
    law = {joint: {kind: getattr(truth, kind)[j] for kind in (*FRICTION, "stribeck")} for j, joint in enumerate(joints)}
    arm = models.robots.load(
        "double_pendulum",
        friction=law,
        armature=dict(zip(joints, truth.armature, strict=True)),
        payload={"lower": (truth.load, 0.0, 0.0, -truth.reach)},
        torque_constants=dict(zip(joints, truth.constants, strict=True)),
    )
    rng = np.random.default_rng(0)
    q, v, u = rng.normal(size=(3, 20, 2))
    v[:10] *= 0.05
    ours = jax.vmap(lambda q, v, u: models.acceleration(arm, jnp.zeros(()), q, v, u))(q, v, u)
    np.testing.assert_allclose(ours, accelerate(truth, q, v, np.array(truth.constants) * u), rtol=1e-9, atol=1e-9)


@pytest.fixture(scope="module")
def plain():
    """Friction and rotors from one log."""
    return fitted(Truth(), ["friction", "armature"])


@pytest.mark.exhaustive
def test_friction_and_rotors_are_the_true_ones_within_their_standard_errors(plain):
    truth = expected(Truth(), "friction", "armature")
    assert plain.determined.all()
    assert np.abs((plain.values - truth) / plain.standard_errors).max() < 3.5
    assert (plain.standard_errors < 0.03 * np.abs(truth) + 2e-3).all(), "the intervals are not wide for nothing"
    assert plain.combinations.determined == ()
    assert plain.combinations.rank == 8


@pytest.mark.exhaustive
def test_a_load_is_found_with_its_place():
    truth = Truth(load=0.15)
    found = fitted(truth, ["payload", "friction.coulomb", "friction.viscous", "friction.asymmetry", "armature"])
    by_name = dict(zip(found.names, zip(found.values, found.standard_errors, strict=True), strict=True))
    for name, value in (("mass", truth.load), ("x", 0.0), ("z", -truth.reach)):
        estimate, error = by_name[f"payload.lower.{name}"]
        assert abs(estimate - value) < 4 * error, name
        assert error < 0.01
    assert np.isnan(by_name["payload.lower.y"][1]), "nothing turns about another axis"


@pytest.mark.exhaustive
def test_constants_offsets_and_stribeck_friction_are_the_true_ones():
    truth = Truth(stribeck=(0.15, 0.06), constants=(1.2, 0.8), offsets=(0.05, -0.08))
    found = fitted(
        truth, ["friction", "friction.stribeck", "armature", "torque_constants", "offsets"], 40.0, torque_noise=0.01
    )
    parts = [expected(truth, group) for group in ("friction", "stribeck", "armature", "constants", "offsets")]
    truth_values = np.concatenate(parts)
    assert found.determined.all()
    assert np.abs((found.values - truth_values) / found.standard_errors).max() < 4.0
    assert found.standard_errors[-2:].max() < 0.01


@pytest.mark.exhaustive
def test_inertias_are_bodies_that_exist_and_predict_as_the_true_ones():
    """Only combinations of the twenty numbers show: these are right, and each body can exist."""
    family = models.robot_family("double_pendulum", ["inertia", "friction", "armature"])
    heavy = Truth(load=0.1)
    t, u, y = swing(1, heavy, 30.0, torque_noise=0.01)
    found = fit_robot(family, [Record(t, u[0], y[0])], HALF)
    assert not found.determined[family.names.index("inertia.upper.mass")]
    assert len(found.combinations.determined) >= 2
    assert found.combinations.rank < len(family.names)
    for start in (0, 10):
        moments = np.linalg.eigvalsh(models.robots.inertia_of("", found.values[start : start + 10]).second)
        assert moments.min() > 0
    fitted_arm = family.make(found.coordinates)
    rng = np.random.default_rng(1)
    q, v, u = rng.normal(size=(3, 50, 2))
    ours = jax.vmap(lambda q, v, u: models.acceleration(fitted_arm, jnp.zeros(()), q, v, u))(q, v, u)
    true = accelerate(heavy, q, v, u)
    assert np.sqrt(np.mean((ours - true) ** 2)) < 0.02 * np.sqrt(np.mean(true**2))


@pytest.mark.exhaustive
def test_intervals_of_95_percent_cover_the_truth():
    t, u, y = swing(40, Truth(), 20.0, torque_noise=0.03)
    family = models.robot_family("double_pendulum", ["friction", "armature"])
    fits = [fit_robot(family, [Record(t, u[k], y[k])], HALF) for k in range(40)]
    values, errors = (np.array([getattr(fit, name) for fit in fits]) for name in ("values", "standard_errors"))
    truth = expected(Truth(), "friction", "armature")
    covered = np.abs(values - truth) < 1.96 * errors
    assert 0.9 <= covered.mean() <= 0.99, covered.mean(axis=0)
    # The window is chosen by the standard errors, which makes some of them too small, by up to a fifth.
    assert covered.mean(axis=0).min() >= 0.75, covered.mean(axis=0)
    np.testing.assert_allclose(np.median(errors, axis=0), np.std(values, axis=0), rtol=0.35)


@pytest.mark.exhaustive
def test_a_joint_that_rests_shows_nothing_of_its_friction():
    """The elbow stands still, whatever torque acts there."""
    t, u, y = swing(1, Truth(armature=(0.0, 1e9)), 12.0)
    found = fit_robot(models.robot_family("double_pendulum", ["friction"]), [Record(t, u[0], y[0])], HALF)
    assert found.determined.tolist() == [True] * 3 + [False] * 3
    assert np.abs(found.values[3:] - found.first[3:]).max() < 0.5


@pytest.mark.exhaustive
def test_what_only_a_combination_shows_is_not_determined_by_itself():
    """Torque constants, friction, rotors and inertias have a common factor."""
    t, u, y = swing(1, Truth(), 8.0)
    names = ["friction", "armature", "torque_constants", "inertia"]
    found = fit_robot(models.robot_family("double_pendulum", names), [Record(t, u[0], y[0])], HALF)
    leading = {text.split(" ")[0] for text in found.combinations.determined}
    assert any(name.startswith("friction") for name in leading)
    assert not any(found.determined[found.names.index(name)] for name in leading & set(found.names))


@pytest.mark.exhaustive
@pytest.mark.parametrize("names", [["friction"], ["armature", "payload"], ["friction", "torque_constants"]])
@pytest.mark.parametrize("truth", [Truth(), Truth(coulomb=(0.6, 0.15), viscous=(1.0, 0.3), armature=(0.3, 0.1))])
def test_a_log_in_degrees_is_named_whatever_the_friction_and_the_rotors_are(names, truth):
    family = models.robot_family("double_pendulum", names)
    t, u, y = swing(1, truth, 6.0)
    assert robot_misfit(family, family.file, Record(t, u[0], y[0])) is None
    finding = robot_misfit(family, family.file, Record(t, u[0], np.degrees(y[0])))
    assert finding is not None
    assert finding.line == '[units] q = "deg"'


@pytest.mark.exhaustive
def test_a_joint_without_a_motor_hides_no_wrong_unit_and_is_none():
    """All its torques sum to zero: relative to their sum nothing of it would be explained."""
    truth = Truth((0.002, 0.05), (0.001, 0.05), (0.0, 0.0), armature=(0.0, 0.004), constants=(0.0, 1.0))
    t, u, y = swing(1, truth, 4.0, torque_noise=0.002)
    family = models.robot_family("double_pendulum", ["friction"])
    record = Record(t, u[0] * [0.0, 1.0], y[0])
    assert robot_misfit(family, family.file, record) is None
    finding = robot_misfit(family, family.file, record._replace(y=np.degrees(record.y)))
    assert finding is not None
    assert finding.line == '[units] q = "deg"'


@pytest.mark.parametrize(("what", "noise"), [("nothing moves", 0.0), ("too little motion", 1e-3)])
def test_a_log_at_rest_shows_nothing(what, noise):
    family = models.robot_family("double_pendulum", ["payload"])
    t = np.arange(2000) / 250.0
    y = np.array([0.3, -0.2]) + noise * np.random.default_rng(0).normal(size=(2000, 2))
    finding = robot_misfit(family, family.file, Record(t, np.ones((2000, 2)), y))
    assert finding is not None
    assert finding.what == what
    slow = y + 0.3 * np.sin(0.2 * t)[:, None]
    assert robot_misfit(family, family.file, Record(t, np.ones((2000, 2)), slow)) is None


@pytest.mark.exhaustive
def test_a_load_and_an_offset_have_a_mirrored_solution():
    """The load on the other side of its link, and the elbow turned by twice the angle of the first moment: the same."""
    mass, x, z, offset = 0.2, 0.05, -0.2, 0.1
    turn = 2 * np.arctan2(mass * x, 0.4 * 0.13 - mass * z)
    rng = np.random.default_rng(0)
    q, v, u = rng.normal(size=(3, 20, 2))

    def accelerations(x: float, offset: float) -> np.ndarray:
        load = {"payload": {"lower": (mass, x, 0.0, z)}, "offsets": {"elbow": offset}}
        arm = models.robots.load("double_pendulum", **load)
        return np.asarray(jax.vmap(lambda q, v, u: models.acceleration(arm, jnp.zeros(()), q, v, u))(q, v, u))

    true = accelerations(x, offset)
    np.testing.assert_allclose(accelerations(-x, offset - turn), true, rtol=1e-6)
    assert np.abs(accelerations(-x, offset + turn) - true).max() > 0.1


@pytest.mark.exhaustive
def test_robots_of_one_make_share_their_rotors_and_have_their_own_friction():
    truths = Truth(), Truth(viscous=(0.2, 0.1), coulomb=(0.24, 0.07), asymmetry=(0.0, 0.0))
    records = [Record(t, u[0], y[0]) for k, each in enumerate(truths) for t, u, y in [swing(1, each, 8.0, seed=k)]]
    one = models.robot_family("double_pendulum", ["friction", "armature"])
    own = [name for name in one.names if name.startswith("friction")]
    family = one.of_machines(["first", "second"], own)
    found = fit_robot(family, records, HALF, machines=[0, 1])
    assert found.names[:3] == ("armature.shoulder", "armature.elbow", f"{own[0]}@first")
    for part, truth in zip(family.parts, truths, strict=True):
        off = found.values[part] - expected(truth, "friction", "armature")
        assert (np.abs(off) < 4 * found.standard_errors[part]).all(), off / found.standard_errors[part]
    alone = [fit_robot(one, [record], HALF).standard_errors[-2:] for record in records]
    assert (found.standard_errors[:2] < np.min(alone, axis=0)).all(), (found.standard_errors, alone)
    turned = fit_robot(one.of_machines(["second", "first"], own), records[::-1], HALF, machines=[0, 1])
    by_name = dict(zip(turned.names, turned.values, strict=True))
    np.testing.assert_allclose([by_name[name] for name in found.names], found.values, rtol=1e-3, atol=1e-6)
