"""What takes long of `test_everywhere.py`: the arms of `docs/proved-for-your-arm.md`."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_everywhere import ARM, RECIPE, ROWS

import covariant
from covariant import engine, models, observers
from covariant.calibration import gains
from covariant.certificates import certify_globally, check_globally
from covariant.observers import Intrinsic, IntrinsicKalman, MeasuredCoefficients
from covariant.signals import Record, StepCode
from covariant.simulation import hold, simulate

STEP = (0.001, 0.001)


@pytest.fixture(scope="module")
def proved():
    return certify_globally(ARM, velocity=1.0, interval=STEP, lost=1, recipe=RECIPE)


@pytest.fixture(scope="module")
def swing():
    """A free swing of two links, at less than 1 rad/s: stamps, positions, velocities, and the change of accelerations
    within a sample, per second."""
    t = jnp.asarray(np.arange(ROWS) * STEP[0])
    still = jnp.zeros((ROWS, 2))
    x = np.asarray(simulate(ARM, jnp.array([0.15, 0.1, 0.3, -0.2]), t, hold(t, still)).x)
    q, v = np.split(x, 2, axis=1)
    assert np.abs(v).max() < 0.99
    accelerations = np.asarray(jax.vmap(lambda q, v: models.acceleration(ARM, 0.0, q, v, jnp.zeros(2)))(q, v))
    return q, v, 1.05 * np.abs(np.diff(accelerations, axis=0)).max(0) / STEP[0]


def follow(observer, q, v, first, lost):
    """Errors (K, n) of position and velocity after each measurement, with their times, and result codes."""
    state = observer.init(jnp.asarray(q[0]))
    state = state._replace(q=state.q + first[0], v=jnp.asarray(v[0]) + first[1])
    state = state._replace(held=observer.clip(state.v))

    def step(state, row):
        state, info = observer.step(state, jnp.zeros(2), row, STEP[0])
        return state, (state.q, state.v, info.result)

    y = np.where(lost[:, None], np.nan, q)[1:]
    _, (q_, v_, codes) = jax.jit(lambda s: jax.lax.scan(step, s, jnp.asarray(y)))(state)
    seen = ~lost[1:]
    times = STEP[0] * np.arange(1, len(q))
    return times[seen], (np.asarray(q_) - q[1:])[seen], (np.asarray(v_) - v[1:])[seen], np.asarray(codes)[seen]


def norms(document, e, zeta):
    x = np.stack([document.omega * e, zeta], axis=-1)
    return np.sqrt((np.einsum("...ia,iab,...ib->...i", x, document.metrics, x) / document.weights**2).sum(-1))


@pytest.mark.core(3)
@pytest.mark.parametrize("some_lost", [False, True])
def test_no_start_converges_slower_than_is_claimed(proved, swing, some_lost):
    """Up to π rad and 20 rad/s off, with samples lost one at a time."""
    (q, v, jerk), document = swing, proved.document
    assert proved.statement.proved
    rng = np.random.default_rng(0)
    lost = np.zeros(ROWS, bool)
    lost[3::3] = some_lost
    rest = document._replace(jerk=jerk).radius()
    for _ in range(6):
        first = rng.uniform(-1, 1, (2, 2)) * [[np.pi], [20.0]]
        t, e, zeta, _ = follow(proved.observer, q, v, first, lost)
        bound = np.exp(-document.rate * t) * norms(document, *first) + rest
        found = norms(document, e, zeta)
        assert (found <= bound).all()
        assert found[-1] < 0.01 * found[0]
        assert (np.abs(zeta) <= document.reach[1] * bound[:, None]).all()


def test_a_machine_that_is_too_fast_is_reported(proved, swing):
    """The clip says after each sample that a velocity exceeds the bound, which is the premise."""
    q, v, _ = swing
    slow = dataclasses.replace(proved.observer, speed=jnp.array([0.3, 0.3]))
    codes = {
        speed: follow(each, q, v, np.zeros((2, 2)), np.zeros(ROWS, bool))[3]
        for speed, each in ((1.0, proved.observer), (0.3, slow))
    }
    assert not (codes[1.0] == StepCode.ASTRAY).any()
    fast = (np.abs(v[1:]) > 0.33).any(1)
    assert (codes[0.3][fast] == StepCode.ASTRAY).mean() > 0.95


def links(n):
    return models.recipe("pendulum_chain", {"parameters.mass": [1.0] * n, "parameters.length": [1.0] * n})


@pytest.mark.parametrize(
    ("recipe", "least", "most", "boxes"),
    [(links(2), 10.9, 11.6, 27), (links(3), 33.2, 39.3, 867), (models.recipe("scara"), 11.9, 27.4, 403)],
)
def test_arms_in_all_configurations(recipe, least, most, boxes, tmp_path):
    made = certify_globally(models.from_recipe(recipe), velocity=1.0, interval=STEP, recipe=recipe)
    assert made.statement.proved
    assert least < made.document.omega.min()
    assert made.document.omega.max() < most
    assert made.proof.boxes <= boxes
    checked = check_globally(made.document.save(tmp_path / "arm.json"))
    assert checked is not None
    assert checked.statement.proved


@pytest.mark.core(60)
def test_four_links_in_all_configurations():
    made = certify_globally(models.from_recipe(links(4)), velocity=1.0, interval=STEP)
    assert made.statement.proved
    assert made.document.omega.max() < 88
    assert made.proof.boxes < 106_000


@pytest.mark.core(60)
def test_a_panda_near_its_ready_pose(tmp_path):
    """Within 0.1 rad, joints 1 and 7 anywhere."""
    recipe = models.recipe("panda")
    arm = models.from_recipe(recipe)
    pose = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
    low, high = pose - 0.1, pose + 0.1
    low[[0, 6]] = high[[0, 6]] = np.nan  # the limits of the file
    observer = MeasuredCoefficients(arm, 80.0 * 1.92**0.5, 6400.0, 1.0)
    made = certify_globally(observer, position=(low, high), interval=STEP, recipe=recipe)
    assert made.statement.proved
    assert made.proof.boxes < 32
    checked = check_globally(made.document.save(tmp_path / "panda.json"))
    assert checked is not None
    assert checked.statement.proved


@pytest.mark.core(80)
def test_a_whole_panda(tmp_path):
    recipe = models.recipe("panda")
    made = certify_globally(models.from_recipe(recipe), velocity=1.0, interval=STEP, noise=2e-5, recipe=recipe)
    assert made.statement.proved
    assert made.document.omega.max() < 370
    assert made.velocity_noise(2e-5).max() < 2.7e-3
    checked = check_globally(made.document.save(tmp_path / "panda.json"))
    assert checked is not None
    assert checked.statement.proved


def test_velocity_errors_of_three_observers_are_those_of_a_simulated_log():
    """In the plane without gravity, where the links float and only unknown accelerations push them."""
    step, rows, std, lacking = 0.005, 20_000, np.array([1e-4, 3e-4]), 0.04
    settings = {"parameters.gravity": 0.0, "uncertainty.acceleration": lacking}
    found = covariant.certify("pendulum_chain", velocity=1.0, sampling=1 / step, noise=std, overrides=settings)
    arm = models.load("pendulum_chain", settings).model
    random = np.random.default_rng(0)

    def slope(q, v):
        return v, models.acceleration(arm, 0.0, q, v, jnp.zeros(2))

    def moved(x, kick):
        """A sample of the motion by the midpoint rule, at whose end the unknown acceleration changes the velocity."""
        middle = jax.tree.map(lambda a, b: a + step / 2 * b, x, slope(*x))
        q, v = jax.tree.map(lambda a, b: a + step * b, x, slope(*middle))
        return (q, v + kick), (q, v + kick)

    start = jnp.array([0.3, -0.5]), jnp.array([0.2, -0.3])
    kicks = jnp.asarray(lacking * step * random.standard_normal((rows, 2)))
    q, v = map(np.asarray, jax.jit(lambda x: jax.lax.scan(moved, x, kicks)[1])(start))
    assert np.abs(v).max() < 1.0
    log = Record(step * np.arange(rows), np.zeros((rows, 2)), q + std * random.standard_normal(q.shape))
    rule, process = gains(float(np.sqrt(np.mean(std**2))), 1 / step, lacking), lacking**2 * step
    kalman = IntrinsicKalman(arm, process * np.eye(2), np.diag(std**2), np.eye(2), gate=None, substeps=1)
    intrinsic = Intrinsic(arm, rule.alpha, rule.beta, substeps=1)
    for observer, (name, expected) in zip(
        (found.certificate.observer, intrinsic, kalman), found.velocity_std.items(), strict=True
    ):
        errors = (np.asarray(engine.run_log(observer, log)[0].estimate)[:, 2:] - v)[600:]
        np.testing.assert_allclose(expected, np.sqrt(np.mean(errors**2, axis=0)), rtol=0.1, err_msg=name)
