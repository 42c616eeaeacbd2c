"""The bound beside every sample is never exceeded where its premises hold, and says so where they do not."""

import dataclasses
import functools
import json
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import lowering, models
from covariant.certificates import ContractionCertificate, Premise, SampledBound, certify, check
from covariant.certificates.base._radius_recursion import Recursion
from covariant.certificates.checking import _check
from covariant.observers import Intrinsic
from covariant.proofs import digest
from covariant.signals import StepCode

RECIPE = {"system": "pendulum_chain", "parameters": {"mass": [1.0], "length": [0.5]}}
BOUNDS = {"position": (-3.0, 3.0), "velocity": 4.0, "error": 0.1, "input": 0.5}
NOISE, FORCE, INTERVAL = 2e-4, 0.01, (0.01, 0.012)
REGION = (np.array([[-3.0], [3.0]]), np.array([4.0]), np.array([[-0.5], [0.5]]))
# What is proved of the pendulum, see `test_what_is_proved_is_what_the_short_tests_use`.
PROVED = Recursion(2.0, 1.3457e-3, (1.7525e-10,), 2.7368e-2, 2.8971e-10, 2.3757e-5, np.array([INTERVAL]))
QUIET = PROVED._replace(force=0.0)
REACH, START, RADIUS = np.sqrt([70.873, 2441.9]), 3.6172 / np.array([70.873, 2441.9]), 0.01185


def pendulum():
    system = models.from_recipe(RECIPE)
    assert isinstance(system, models.MechanicalSystem)
    return Intrinsic(system, 10.0, 50.0, substeps=4)


def bound_of(recursion=PROVED):
    return SampledBound(recursion, RADIUS, REACH, START, *REGION, (True,))


@functools.cache
def plain_pendulum():
    """The same pendulum, whose metric is written as a constant: it compiles in no time."""
    swing = models.Lagrangian(
        lambda q: jnp.array([[0.25]]), lambda q: -0.25 * 19.62 * jnp.cos(q[0]), coordinates=("q",), circles=(0,)
    )
    return Intrinsic(swing, 10.0, 50.0, substeps=4)


class Log(NamedTuple):
    """What an observer saw and estimated in several runs (runs, steps, …), with the true states."""

    truth: jax.Array
    estimate: jax.Array
    u: jax.Array
    y: jax.Array
    dt: jax.Array
    off: jax.Array


@functools.partial(jax.jit, static_argnums=(1, 2))
def simulate(key, steps, kind, noise, force):
    """One run of the pendulum, its observer, and whoever picks the errors of measurement within ±noise.

    `kind`: "encoder" rounds to ticks of twice the noise; "switching" holds the largest error and changes its sign at
    random times, as the impulse response of the observer does at a fixed one; "greedy" picks the sign that makes the
    error longer. The unknown force is the largest, and changes its sign at random.
    """
    observer = plain_pendulum()
    fine = dataclasses.replace(observer, substeps=12)
    first, rest = jax.random.split(key)
    x = jax.random.uniform(first, (2,), minval=-1.0) * jnp.array([0.7, 1.0])
    off = jnp.array([1e-6, 1e-5])

    def moved(x, u, dt):
        new = fine.predict(fine.init(x[:1])._replace(q=x[:1], v=x[1:]), u, dt)
        return jnp.concatenate([new.q, new.v])

    def advance(carry, key):
        x, state, side, push = carry
        a, b, c, d = jax.random.split(key, 4)
        dt = jax.random.uniform(a, minval=INTERVAL[0] * (1 + 1e-9), maxval=INTERVAL[1] * (1 - 1e-9))
        u = jnp.clip(0.2 * jax.random.uniform(b, (1,), minval=-1.0) - 0.3 * x[1:], -0.5, 0.5)
        side = jnp.where(jax.random.uniform(c) < 0.06, -side, side)
        push = jnp.where(jax.random.uniform(d) < 0.03, -push, push)
        x = moved(x, u + push * force, dt)
        if kind == "encoder":
            y = jnp.round(x[:1] / (2 * noise)) * 2 * noise
        elif kind == "switching":
            y = x[:1] + side * noise
        else:
            sides = jnp.array([[-1.0], [1.0]]) * noise
            after = jax.vmap(lambda e: observer.step(state, u, x[:1] + e, dt)[0])(sides)
            off_by = jnp.concatenate([after.q, after.v], axis=1) - x[None]
            lengths = jnp.sum((off_by / REACH[None]) ** 2, axis=1)
            y = x[:1] + sides[jnp.argmax(lengths)]
        state, _ = observer.step(state, u, y, dt)
        return (x, state, side, push), Log(x, jnp.concatenate([state.q, state.v]), u, y, dt, off)

    state = observer.init(x[:1])._replace(q=x[:1] + off[:1], v=x[1:] + off[1:], age=jnp.zeros(()))
    return jax.lax.scan(advance, (x, state, jnp.ones(()), jnp.ones(())), jax.random.split(rest, steps))[1]


def simulated(kind, steps, runs, force=FORCE, noise=NOISE, seed=0):
    """A `Log` of several runs."""
    plain_pendulum()  # before anything is traced
    keys = jax.random.split(jax.random.key(seed), runs)
    return jax.vmap(lambda key: simulate(key, steps, kind, jnp.asarray(noise), jnp.asarray(force)))(keys)


@jax.jit
def parts(bound, log):
    """Errors over their bounds (runs, steps, 2), and the premises."""

    def one(log):
        def advance(state, row):
            state, info = bound.step(state, row.estimate, row.u, row.y, row.dt)
            errors = jnp.abs(row.estimate - row.truth) / jnp.concatenate([info.position, info.velocity])
            return state, (errors, info.premise)

        return jax.lax.scan(advance, bound.within(log.off[0, :1], log.off[0, 1:]), log)[1]

    return jax.vmap(one)(log)


def worst(bound, log):
    """Largest error over its bound, where all premises hold."""
    errors, premise = parts(bound, log)
    assert (np.asarray(premise) == 0).all()
    return float(np.asarray(errors).max())


@pytest.mark.exhaustive
def test_the_bound_holds_in_simulation_and_mutants_of_it_do_not():
    """3000 samples with the largest errors of measurement and force."""
    log = simulated("switching", 150, 20)
    assert 0.1 < worst(bound_of(), log) < 1.0
    for wrong in (PROVED._replace(force=0.0), PROVED._replace(decay=8.0), PROVED._replace(force=0.0, noise=(0.0,))):
        assert worst(bound_of(wrong), log) > 1.0
    quiet = simulated("switching", 150, 20, force=0.0)
    assert worst(bound_of(QUIET), quiet) < 1.0
    assert worst(bound_of(QUIET._replace(noise=(0.0,))), quiet) > 1.0
    # Bounds of the wrong sign of μ grow until they leave the tube, and are no bounds any more.
    premises = np.asarray(parts(bound_of(PROVED._replace(decay=-8.0)), log)[1])
    assert (premises[:, -1] == Premise.TUBE).all()


def test_the_steady_radius_is_where_the_recursion_ends():
    rng, steady = np.random.default_rng(0), PROVED.steady
    assert PROVED.keeps(steady)
    assert not PROVED.keeps(0.999 * steady)
    assert not PROVED._replace(decay=-2.0).keeps(0.01)
    assert PROVED._replace(force=1.0).steady > RADIUS
    radius = 20 * steady
    for _ in range(2000):
        h = rng.choice([*INTERVAL, rng.uniform(*INTERVAL)])
        a = PROVED.predicted(radius, h)
        radius = np.sqrt(a**2 + PROVED.noise[0]) + h * PROVED.change * (a + PROVED.error)
    assert 0.8 * steady < radius < steady


@pytest.mark.long("{}")
@pytest.mark.parametrize(
    ("change", "premise"),
    [
        ({}, Premise.HOLDS),
        ({"y": np.nan}, Premise.HOLDS),  # within the ages, nothing is corrected
        ({"y": 1e30}, Premise.HOLDS),  # the observer takes it as missing
        ({"y": np.inf}, Premise.HOLDS),
        ({"y": 0.1, "result": StepCode.OUTLIER}, Premise.HOLDS),  # refused by a gate
        ({"y": np.nan, "result": StepCode.COASTED}, Premise.HOLDS),
        ({"result": StepCode.OK}, Premise.HOLDS),
        ({"y": 1e30, "result": StepCode.OK}, Premise.MEASUREMENT),  # not what the observer does
        ({"result": StepCode.RESTARTED}, Premise.STEP),
        ({"result": StepCode.ASTRAY}, Premise.STEP),
        ({"result": StepCode.TOO_LATE}, Premise.STEP),
        ({"result": StepCode.REPEATED}, Premise.STEP),  # the truth moved on
        ({"dt": 0.0}, Premise.HOLDS),  # a stamp that repeats
        ({"dt": 0.0, "result": StepCode.REPEATED}, Premise.HOLDS),
        ({"dt": 1e-310}, Premise.HOLDS),
        ({"dt": -0.01, "result": StepCode.STEP_REFUSED}, Premise.AGE),
        ({"dt": np.inf}, Premise.AGE),
        ({"u": np.nan, "result": StepCode.INPUT_HELD}, Premise.INPUT),
        ({"dt": 0.02}, Premise.AGE),
        ({"dt": 0.002}, Premise.AGE),
        ({"dt": 0.02, "y": np.nan}, Premise.AGE),
        ({"dt": -0.01}, Premise.AGE),
        ({"dt": np.nan}, Premise.AGE),
        ({"v": 3.99}, Premise.VELOCITY),
        ({"v": np.nan}, Premise.VELOCITY),
        ({"q": 2.999}, Premise.POSITION),
        ({"q": 2 * np.pi + 0.1}, Premise.HOLDS),
        ({"u": 0.51}, Premise.INPUT),
        ({"u": np.nan}, Premise.INPUT),
        ({"start": np.inf}, Premise.START),
        ({"start": 0.013}, Premise.START),
        ({"start": np.nan}, Premise.START),
    ],
    ids=str,
)
def test_a_bound_says_when_it_knows_nothing(change, premise):
    values = {"q": 0.1, "v": 1.0, "u": 0.2, "y": 0.1, "dt": 0.011, "start": 0.01} | change
    bound = bound_of()
    x, u, y = jnp.array([values["q"], values["v"]]), jnp.array([values["u"]]), jnp.array([values["y"]])
    state, info = bound.step(bound.init(values["start"]), x, u, y, values["dt"], values.get("result"))
    assert Premise(int(info.premise)) == premise
    assert bool(np.isfinite(info.velocity).all()) == (premise == 0)
    # What is not known stays unknown.
    _, again = bound.step(state, jnp.array([0.1, 1.0]), jnp.array([0.2]), jnp.array([0.1]), 0.011)
    assert int(again.premise) == int(premise) or premise == Premise.HOLDS


LOST_ONCE = PROVED._replace(noise=(*PROVED.noise, 4 * PROVED.noise[0]), ages=np.array([INTERVAL, (0.02, 0.024)]))


def after(bound, *samples):
    """What `step` returns after samples of y, dt, and perhaps a result code."""
    state, info = bound.init(0.004), None
    for y, dt, *result in samples:
        at = jnp.array([0.1, 1.0]), jnp.array([0.2]), jnp.array([y], float)
        state, info = bound.step(state, *at, dt, *result)
    return state, info


@pytest.mark.parametrize(
    "sample",
    [(1e30, 0.011), (-np.inf, 0.011), (1e30, 0.011, StepCode.COASTED), (0.6, 0.011, StepCode.OUTLIER), (7e9, 0.011)],
    ids=str,
)
def test_what_the_observer_does_not_use_is_a_lost_sample(sample):
    bound = bound_of(LOST_ONCE)
    lost = (np.nan, 0.011)
    for rows in ([], [(0.1, 0.011)], [(0.1, 0.011), lost]):
        odd, plain = after(bound, *rows, sample), after(bound, *rows, lost)
        for mine, expected in zip(jax.tree.leaves(odd), jax.tree.leaves(plain), strict=True):
            assert np.array_equal(mine, expected)
    assert float(after(bound, sample)[0].age) == 0.011
    assert float(after(bound, (0.1, 0.011))[0].age) == 0.0
    # A third one in a row is more than the certificate covers.
    assert after(bound, sample, sample)[1].premise == Premise.HOLDS
    assert after(bound, sample, sample, sample)[1].premise == Premise.AGE
    assert np.isinf(after(bound_of(), sample, sample)[1].velocity).all()


def test_a_stamp_that_nearly_repeats_after_a_lost_sample_corrects_nothing():
    bound = bound_of(LOST_ONCE)
    state, info = after(bound, (np.nan, 0.011), (0.1, 1e-310))
    plain = after(bound, (np.nan, 0.011))
    assert float(state.age) == 0.011
    assert float(info.radius) == float(plain[1].radius)


def test_a_row_that_is_missing_is_not_one_that_is_empty():
    """One step over a gap has longer Runge–Kutta steps than the proof knows of."""
    bound = bound_of(LOST_ONCE)
    assert after(bound, (np.nan, 0.011), (0.1, 0.011))[1].premise == Premise.HOLDS
    assert after(bound, (0.1, 0.022))[1].premise == Premise.AGE


def test_no_error_is_beyond_its_bound_where_samples_are_not_used():
    observer, bound = dataclasses.replace(plain_pendulum(), substeps=1), bound_of(LOST_ONCE)
    u, dt, first = jnp.zeros(1), jnp.asarray(0.011), plain_pendulum().init(jnp.array([0.5]))
    off = jnp.array([1e-4, 0.05])

    @jax.jit
    def advance(truth, state, beside, refused):
        truth = observer.predict(truth, u, dt)
        y = jnp.where(refused, 1e30, truth.q)
        state, info = observer.step(state, u, y, dt)
        x = jnp.concatenate([state.q, state.v])
        beside, known = bound.step(beside, x, u, y, dt, info.result)
        limits = jnp.concatenate([known.position, known.velocity])
        return truth, state, beside, limits, jnp.abs(x - jnp.concatenate([truth.q, truth.v]))

    truth, state, beside = first, first._replace(q=first.q + off[:1], v=first.v + off[1:]), bound.within(*off)
    known = []
    for refused in [True, False, False] + 60 * [True]:
        truth, state, beside, limits, error = advance(truth, state, beside, refused)
        assert (error <= limits).all()
        known.append(bool(jnp.isfinite(limits).all()))
    assert known == 5 * [True] + 58 * [False]  # one sample may be lost, so that two intervals are covered


def test_a_tube_that_is_left_and_a_part_of_a_measurement_are_premises():
    wild = bound_of(PROVED._replace(force=1.0))
    calm = jnp.zeros(2), jnp.zeros(1), jnp.zeros(1), 0.011
    assert int(wild.step(wild.init(RADIUS), *calm)[1].premise) == Premise.TUBE
    two = SampledBound(
        PROVED,
        RADIUS,
        np.ones(4),
        np.ones(4),
        np.array([[-3.0] * 2, [3.0] * 2]),
        np.ones(2),
        np.zeros((2, 0)),
        (False,) * 2,
    )
    for other in (jnp.nan, 1e30):
        part = jnp.zeros(4), jnp.zeros(0), jnp.array([0.0, other]), 0.011
        assert int(two.step(two.init(0.001), *part)[1].premise) == Premise.MEASUREMENT
    # A gate says that it refused something, and not which of the positions.
    whole = jnp.zeros(4), jnp.zeros(0), jnp.zeros(2), 0.011
    assert int(two.step(two.init(0.001), *whole, StepCode.OUTLIER)[1].premise) == Premise.MEASUREMENT
    none = jnp.zeros(4), jnp.zeros(0), jnp.full(2, jnp.nan), 0.011
    assert int(two.step(two.init(0.001), *none, StepCode.COASTED)[1].premise) == Premise.HOLDS


def test_lost_samples_choose_the_errors_that_belong_to_their_age():
    twice = PROVED._replace(force=0.0, steps=0.0, noise=(1e-10, 9e-10), ages=np.array([[0.01, 0.012], [0.02, 0.024]]))
    bound = bound_of(twice)
    rest = jnp.zeros(2), jnp.zeros(1)
    state, lost = bound.step(bound.init(0.0), *rest, jnp.full(1, jnp.nan), 0.011)
    assert float(lost.radius) == 0.0
    assert int(lost.premise) == 0
    state, late = bound.step(state, *rest, jnp.zeros(1), 0.011)
    assert float(late.radius) == pytest.approx(3e-5 + 0.022 * twice.change * twice.error, rel=1e-6)
    assert float(bound.step(state, *rest, jnp.zeros(1), 0.011)[1].radius) < 3.6e-5  # 4.2e-5 with the other G


def test_a_bound_is_lowered_to_c_with_the_same_numbers():
    bound = bound_of()
    arguments = bound.init(0.01), jnp.array([0.1, 1.0]), jnp.array([0.2]), jnp.array([0.1])
    graph = lowering.lower(bound.step, *arguments, jnp.asarray(0.011))
    for dt in (0.011, 0.02):
        by_graph = lowering.numbers(graph, *arguments, jnp.asarray(dt))
        by_jax = bound.step(*arguments, dt)
        for mine, other in zip(jax.tree.leaves(by_graph), jax.tree.leaves(by_jax), strict=True):
            assert np.allclose(mine, other, rtol=1e-14)
    assert "void beside(const double *x, double *y)" in lowering.c_function(graph, "beside").text


def test_a_bound_in_c_takes_the_result_code():
    bound = bound_of(LOST_ONCE)
    arguments = bound.init(0.01), jnp.array([0.1, 1.0]), jnp.array([0.2]), jnp.array([0.1]), jnp.asarray(0.011)
    graph = lowering.lower(bound.step, *arguments, jnp.asarray(0.0))
    for result in (StepCode.OK, StepCode.OUTLIER, StepCode.RESTARTED):
        by_graph = lowering.numbers(graph, *arguments, jnp.asarray(float(result)))
        for mine, other in zip(jax.tree.leaves(by_graph), jax.tree.leaves(bound.step(*arguments, result)), strict=True):
            assert np.allclose(mine, other, rtol=1e-14)


# What is proved, by prover and checker.


@pytest.fixture(scope="module")
def proved():
    return certify(
        pendulum(), **BOUNDS, interval=INTERVAL, noise=NOISE, disturbance=FORCE, recipe=RECIPE, checker="off"
    )


def altered(path, folder, change):
    document = json.loads(path.read_text(encoding="utf-8"))
    change(document)
    document.pop("digest")
    (folder / "altered.json").write_text(json.dumps(document | {"digest": digest(document)}), encoding="utf-8")
    return folder / "altered.json"


def scaled(index, key, factor):
    def change(document):
        value = document["claims"][index][key]
        document["claims"][index][key] = [factor * v for v in value] if isinstance(value, list) else factor * value

    return change


def given(key, value):
    def change(document):
        document["given"][key] = [value]

    return change


@pytest.mark.exhaustive
def test_what_is_proved_is_what_the_short_tests_use(proved, tmp_path, monkeypatch):
    assert proved.statement.proved, proved.statement
    kinds = [claim.kind for claim in proved.claims]
    assert kinds == ["contraction", "reach", "reach", "disturbance", "correction", "missing", "prediction", "start"]
    bound = proved.bound()
    for mine, used in zip(bound.recursion, PROVED, strict=True):
        assert np.allclose(mine, used, rtol=0.05)
        assert np.all(np.asarray(mine) <= np.asarray(used) * (1 + 1e-3))
    assert np.allclose(bound.reach, REACH, rtol=1e-3)
    assert np.allclose(bound.start, START, rtol=1e-3)
    assert proved.steady < proved.radius
    start = proved.start
    assert int(bound.within(start.together[:1], start.together[1:]).premise) == 0
    assert int(bound.within(start.alone[:1], start.alone[1:]).premise) == Premise.START
    path = proved.save(tmp_path / "noisy.json")
    assert check(path).statement.proved
    assert ContractionCertificate.load(path).bound().recursion.noise == bound.recursion.noise
    monkeypatch.setattr(_check, "DEPTH", 2)
    for change, message in (
        (scaled(4, "squares", 0.5), r"claims\[4\] is not shown"),
        (scaled(3, "square", 0.5), r"claims\[3\] is not shown"),
        (scaled(7, "square", 0.5), r"claims\[7\] is not shown"),
        (lambda d: d["claims"][4].pop("squares"), "squares"),
        (lambda d: d["claims"].pop(3), "must be one of .disturbance"),
        (given("noise", 0.0), "squares"),
        (given("noise", 3e-4), "box|room"),
        (given("disturbance", 0.02), "the bound of the joint force|lead out of"),
        (lambda d: d.update(radius=0.5 * proved.steady), "lead out of"),
    ):
        with pytest.raises(ValueError, match=message):
            check(altered(path, tmp_path, change))


@pytest.mark.exhaustive
def test_a_million_samples_stay_within_their_bounds(proved):
    """400 000 samples of each adversary; the errors of an encoder are far from the worst."""
    bound, seen = proved.bound(), {}
    for kind in ("switching", "greedy", "encoder"):
        log = simulated(kind, 400, 1000, seed=1)
        errors, premise = (np.asarray(each) for each in parts(bound, log))
        assert (premise == 0).mean() > 0.9
        seen[kind] = float(errors[premise == 0].max())
        assert seen[kind] < 1.0
    assert seen["switching"] > 0.2


def test_a_certificate_in_continuous_time_says_what_start_it_covers_and_has_no_bound():
    quiet = certify(plain_pendulum(), **BOUNDS, rate=1.0, checker="off", boxes=500)
    with pytest.raises(ValueError, match="continuous time"):
        quiet.bound()
    assert quiet.start is not None
    assert (quiet.start.together < quiet.start.alone).all()
    assert (quiet.start.alone < quiet.start.farthest).all()
