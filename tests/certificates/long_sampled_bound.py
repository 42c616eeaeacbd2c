"""The bound of a step is never exceeded where its premises hold, and says so where they do not: what takes long."""

import dataclasses
import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from forging import MISSING, forged, put
from test_sampled_bound import (
    AGES,
    BOUNDS,
    FORCE,
    INTERVAL,
    LOST_ONCE,
    NOISE,
    PROVED,
    RADIUS,
    REACH,
    START,
    SUBSTEPS,
    after,
    bounded,
    plain_pendulum,
    proved,
    starting,
)

import covariant
import scalargraph
from covariant import models
from covariant.certificates import Bounded, ContractionCertificate, Premise, any_configuration, certify, check
from covariant.certificates.checking import _check
from covariant.certificates.sampled import SampledBound
from covariant.observers import Gated, Intrinsic
from covariant.signals import StepCode

SHIPPED = Path(__file__).parents[2] / "examples/certificates"


def moved(x, u, dt):
    """The true state after dt."""
    fine = dataclasses.replace(plain_pendulum(), substeps=12)
    new = fine.predict(fine.init(x[:1])._replace(q=x[:1], v=x[1:]), u, dt)
    return jnp.concatenate([new.q, new.v])


@pytest.mark.exhaustive
@pytest.mark.parametrize("off", [1e30, -np.inf, 7e9, -1e30, np.inf], ids=str)
def test_what_the_observer_does_not_use_is_a_lost_sample(off):
    observer = bounded(LOST_ONCE)
    lost = (np.nan, 0.011)
    for rows in ([], [(0.0, 0.011)], [(0.0, 0.011), lost]):
        odd, plain = after(observer, *rows, (off, 0.011)), after(observer, *rows, lost)
        for mine, expected in zip(jax.tree.leaves(odd), jax.tree.leaves(plain), strict=True):
            assert np.array_equal(mine, expected)
    # A third one in a row is more than the certificate covers.
    assert after(observer, *2 * [(off, 0.011)])[1].premise == Premise.HOLDS
    assert after(observer, *3 * [(off, 0.011)])[1].premise == Premise.AGE
    assert np.isinf(after(bounded(), *2 * [(off, 0.011)])[1].velocity_bound).all()


@pytest.mark.exhaustive
def test_what_a_gate_refuses_is_a_lost_sample_and_a_restart_is_not_covered():
    plain = plain_pendulum()
    observer = bounded(LOST_ONCE, Gated(plain, plain.model, jnp.asarray(NOISE), jnp.asarray(1.0)))

    @jax.jit
    def step(state, y):
        return observer.step(state, jnp.zeros(1), jnp.array([y]), 0.011)

    state = observer.init(jnp.array([0.1]))._replace(radius=jnp.asarray(0.004), premise=jnp.zeros(()))
    for _ in range(3):
        state, info = step(state, 0.1)
    refused, told = step(state, 0.6)
    missing, expected = step(state, np.nan)
    assert told.result == StepCode.OUTLIER
    assert told.premise == 0
    assert float(told.radius) == float(expected.radius)
    assert float(refused.radius) == float(missing.radius) == float(state.radius)
    results = []
    for _ in range(40):
        refused, info = step(refused, 0.6)
        results.append((int(info.result), int(info.premise)))
    assert (int(StepCode.RESTARTED), int(Premise.AGE)) in results
    assert all(premise > 0 for _, premise in results[1:])


def test_a_stamp_that_nearly_repeats_after_a_lost_sample_corrects_nothing():
    observer = bounded(LOST_ONCE)
    state, info = after(observer, (np.nan, 0.011), (0.0, 1e-310))
    plain = after(observer, (np.nan, 0.011))
    assert float(state.inner.age) == 0.011
    assert float(info.radius) == float(plain[1].radius)


def test_a_radius_of_zero_does_not_stay_zero():
    """The observer rounds, and its predictions are off by what their bound says."""
    none = PROVED._replace(noise=(0.0,), force=0.0, steps=0.0, error=0.0)
    state, info = after(bounded(none), *5 * [(0.0, 0.011)], start=0.0)
    assert float(state.radius) == 0.0
    assert float(info.position_bound[0]) > 1e-10
    assert float(info.velocity_bound[0]) > 1e-10
    assert float(after(bounded(none._replace(steps=1e-6)), *5 * [(0.0, 0.011)], start=0.0)[0].radius) > 1e-8


def test_a_bound_covers_the_rounding_of_large_angles():
    """After many turns doubles resolve less of an angle than the least bound at small ones."""
    none = PROVED._replace(noise=(0.0,), force=0.0, steps=0.0, error=0.0)
    observer, turns = bounded(none), 2 * np.pi * 1e8
    fine = dataclasses.replace(plain_pendulum(), substeps=12)

    def advance(carry, _):
        truth, state = carry
        truth = fine.predict(truth, jnp.zeros(1), jnp.asarray(0.011))
        state, info = observer.step(state, jnp.zeros(1), truth.q + turns, 0.011)
        errors = truth.q - (state.inner.q - turns), truth.v - state.inner.v
        return (truth, state), (*errors, info.position_bound, info.velocity_bound, info.premise)

    state = starting(observer, jnp.array([turns + 0.3]), jnp.zeros(1), 0.0)
    truth = plain_pendulum().init(state.inner.q - turns)
    q, v, of_q, of_v, premise = map(np.asarray, jax.lax.scan(advance, (truth, state), None, 200)[1])
    assert (premise == 0).all()
    assert np.abs(q).max() > 1e-7
    assert (np.abs(q) < of_q).all()
    assert (np.abs(v) < of_v).all()


def test_numbers_that_are_no_doubles_are_refused():
    observer = bounded()
    with pytest.raises(ValueError, match="doubles, and here is a float32"):
        observer.init(jnp.zeros(1, jnp.float32))
    state = jax.tree.map(lambda each: each.astype(jnp.float32), observer.init(jnp.zeros(1)))
    with jax.numpy_dtype_promotion("standard"), pytest.raises(ValueError, match="doubles"):
        observer.step(state, jnp.zeros(1, jnp.float32), jnp.zeros(1, jnp.float32), 0.011)
    with jax.enable_x64(False), pytest.raises(ValueError, match="jax_enable_x64"):
        bounded().init(jnp.zeros(1))
    observer = bounded()
    state = starting(observer, jnp.array([0.1]), jnp.array([1.0]), 0.004)
    with jax.numpy_dtype_promotion("standard"), pytest.raises(ValueError, match="here is a float32"):
        observer.step(state, jnp.zeros(1), jnp.array([0.1], jnp.float32), 0.011)


def test_stamps_that_are_rounded_are_covered():
    """Differences of k h are not h, and those of stamps since 1970 are off by 1e-5 of it."""
    observer = bounded(PROVED._replace(ages=np.array([[0.01 * (1 - 1e-3), 0.01 * (1 + 1e-3)]])))
    for first in (0.0, 1.7e9):
        t = first + np.arange(100) * 0.01
        samples = [(0.0, float(dt)) for dt in np.diff(t)]
        assert after(observer, *samples)[1].premise == Premise.HOLDS


@pytest.mark.exhaustive
def test_a_tube_that_is_left_and_a_part_of_a_measurement_are_premises():
    wild = bounded(PROVED._replace(force=1.0))
    assert after(wild, (0.0, 0.011), start=RADIUS)[1].premise == Premise.TUBE
    flat = models.Lagrangian(lambda q: jnp.eye(2), lambda q: 0.0 * q[0], coordinates=("x", "y"))
    two = Intrinsic(flat, 10.0, 50.0, substeps=SUBSTEPS)
    region = np.array([[-3.0] * 2, [3.0] * 2]), np.ones(2), np.zeros((2, 2)), np.full(2, NOISE)
    bound = SampledBound(two, PROVED, RADIUS, np.ones(4), np.ones(4), *region, SUBSTEPS, 0.011, False, (False,) * 2)
    rest = jnp.zeros(2), jnp.zeros(2)

    def premise(observer, y):
        state = observer.init(rest[0])
        return int(observer.step(state, rest[1], jnp.asarray(y), 0.011)[1].premise)

    plain = Bounded(two, bound, 0.001)
    assert premise(plain, [0.0, 0.0]) == premise(plain, [np.nan, 1e30]) == Premise.HOLDS
    for part in ([0.0, np.nan], [1e30, 0.0], [np.inf, 0.0]):
        assert premise(plain, part) == Premise.MEASUREMENT
    gated = Bounded(Gated(two, flat, jnp.asarray(NOISE), jnp.asarray(0.1)), bound, 0.001)
    assert premise(gated, [0.0, 0.0]) == premise(gated, [0.6, 0.6]) == Premise.HOLDS
    assert premise(gated, [0.0, 0.6]) == Premise.MEASUREMENT


def test_lost_samples_choose_the_errors_that_belong_to_their_age():
    ages = np.array([[0.01, 0.012], [0.02, 0.024]])
    twice = PROVED._replace(force=0.0, steps=0.0, noise=(1e-10, 9e-10), ages=ages)
    observer = bounded(twice)
    lost = after(observer, (np.nan, 0.011), start=0.0)[1]
    assert float(lost.radius) == 0.0
    assert int(lost.premise) == 0
    late = after(observer, (np.nan, 0.011), (0.0, 0.011), start=0.0)[1]
    assert float(late.radius) == pytest.approx(3e-5 + 0.022 * twice.change * twice.error, rel=1e-6)
    again = after(observer, (np.nan, 0.011), (0.0, 0.011), (0.0, 0.011), start=0.0)[1]
    assert float(again.radius) < 3.6e-5  # 4.2e-5 with the other G


def test_a_bounded_step_is_lowered_to_c_with_the_same_numbers():
    observer = bounded(LOST_ONCE)
    state = starting(observer, jnp.array([0.1]), jnp.array([1.0]), 0.01)
    graph = scalargraph.lower(observer.step, state, jnp.zeros(1), jnp.array([0.111]), jnp.asarray(0.011))
    for y, dt in ((0.111, 0.011), (0.111, 0.022), (2.0, 0.011), (np.nan, 0.011), (1e30, 0.011), (0.111, -1.0)):
        arguments = state, jnp.zeros(1), jnp.array([y]), jnp.asarray(dt)
        by_jax = observer.step(*arguments)
        for mine, other in zip(
            jax.tree.leaves(scalargraph.numbers(graph, *arguments)), jax.tree.leaves(by_jax), strict=True
        ):
            assert np.allclose(mine, other, rtol=1e-12, atol=1e-15, equal_nan=True)
    assert "void beside(const double *x, double *y)" in scalargraph.c_function(graph, "beside").text


class Faults(NamedTuple):
    """What is wrong with the rows of a log, as shares of all rows."""

    empty: float = 0.05
    missing: float = 0.03
    late: float = 0.01
    huge: float = 0.02
    odd: float = 0.01
    repeated: float = 0.02
    backwards: float = 0.003
    no_input: float = 0.003


class Plant(NamedTuple):
    """A bounded observer, what an attack may do, and the distance of two velocities at one configuration."""

    observer: Bounded
    noise: Any
    force: Any
    length: Any

    @property
    def model(self):
        return self.observer.model

    def truth(self, key):
        """A true motion in the middle of the region."""
        manifold, a, b = self.model.manifold, *jax.random.split(key)
        zero = self.observer.init(jnp.asarray(any_configuration(self.model))).inner
        size = 0.4 * jnp.asarray(self.observer.bound.positions[1]) if manifold.commuting else 3.0
        q = manifold.retract(zero.q, size * jax.random.uniform(a, zero.v.shape, minval=-1.0))
        v = 0.3 * jnp.asarray(self.observer.bound.velocity) * jax.random.uniform(b, zero.v.shape, minval=-1.0)
        return zero._replace(q=q, v=v, age=jnp.zeros(()))

    def start(self, truth, key):
        """A state of the observer that differs from the truth by a velocity alone, up to half of the radius."""
        direction = jax.random.normal(key, truth.v.shape)
        off = direction * 0.5 * self.observer.bound.radius / self.length(truth.q, direction)
        state = self.observer.init(truth.q)
        known = jnp.asarray(0.5001 * self.observer.bound.radius), jnp.zeros(())
        return state._replace(inner=state.inner._replace(v=truth.v + off), radius=known[0], premise=known[1])

    def errors(self, truth, state, info):
        """Errors over their bounds (2n,)."""
        q, v = state.inner.q, state.inner.v
        limits = jnp.concatenate([info.position_bound, info.velocity_bound])
        return jnp.abs(jnp.concatenate([self.model.manifold.towards(truth.q, q), v - truth.v])) / limits


def attacked(plant, key, steps, faults=Faults()):
    """Errors over bounds, premises and result codes of a run with faults in its log.

    Errors of measurement are as large as they may be, and change their signs at random times, as does the impulse
    response of the observer at a fixed one. After a premise has failed, one in five rows starts anew, from errors that
    are known.
    """
    observer, manifold, kinds = plant.observer, plant.model.manifold, jnp.cumsum(jnp.asarray(faults))
    fine = dataclasses.replace(observer.observer, substeps=12)
    low, high = observer.bound.inputs

    def advance(carry, key):
        truth, state, push, signs = carry
        keys = jax.random.split(key, 10)
        draw = [jax.random.uniform(k, minval=-1.0) for k in keys]
        kind: Any = jnp.searchsorted(kinds, jax.random.uniform(keys[7]))
        empty, missing, late, huge, odd, repeated, backwards, no_input = (kind == k for k in range(len(faults)))
        dt = INTERVAL[0] + (draw[0] + 1) / 2 * (INTERVAL[1] - INTERVAL[0])
        dt = dt * jnp.where(missing, 2.0, 1.0) * jnp.where(late, 1.3 + draw[1] / 2, 1.0)
        dt = jnp.where(repeated, 0.0, dt)
        u = low + (high - low) * jax.random.uniform(keys[2], low.shape)
        push = jnp.where(draw[3] < -0.94, -push, push)
        # The unknown force acts where inputs do.
        truth: Any = fine.predict(truth, u + push * plant.force, dt)
        signs = jnp.where(jax.random.uniform(keys[4], truth.v.shape) < 0.06, -signs, signs)
        y = manifold.retract(truth.q, plant.noise * signs)
        # Less than the bound itself breaks the assumption on noise unseen.
        wrong: Any = jnp.where(odd, manifold.retract(truth.q, signs * (0.3 + jnp.abs(draw[5]))), y)
        seen: Any = jnp.where(huge, 1e30 * jnp.sign(draw[5]), wrong)
        y = jnp.where(empty, jnp.nan, seen)
        state, info = observer.step(state, jnp.where(no_input, jnp.nan, u), y, jnp.where(backwards, -dt, dt))
        told = plant.errors(truth, state, info), info.premise, info.result
        anew = plant.truth(keys[8])
        restart = (state.premise > 0) & (jax.random.uniform(keys[6]) < 0.2)
        new = anew, plant.start(anew, keys[9])
        truth, state = jax.tree.map(lambda a, b: jnp.where(restart, a, b), new, (truth, state))
        return (truth, state, push, signs), told

    first, second, rest = jax.random.split(key, 3)
    truth = plant.truth(first)
    start = truth, plant.start(truth, second), jnp.ones(()), jnp.ones(truth.v.shape)
    return jax.lax.scan(advance, start, jax.random.split(rest, steps))[1]


def attack(plant, runs, steps, seed=0, faults=Faults()):
    plain_pendulum()  # before anything is traced
    keys = jax.random.split(jax.random.key(seed), runs)
    found = jax.jit(jax.vmap(lambda key: attacked(plant, key, steps, faults)))(keys)
    return [np.asarray(each) for each in found]


def pendulum_plant(missing_rows=True, recursion=LOST_ONCE):
    longest = 2 * AGES[0, 1] / SUBSTEPS
    observer = bounded(recursion, missing_rows=missing_rows, longest_step=longest)
    return Plant(observer, NOISE, FORCE, lambda q, v: np.sqrt(START[1]) * jnp.abs(v[0]))


def never_false(plant, runs, steps, seed=0):
    errors, premise, result = attack(plant, runs, steps, seed)
    holds = premise == 0
    assert 0.3 < holds.mean() < 0.99
    assert errors[holds].max() < 1.0
    assert (errors[~holds] == 0).all()
    assert {StepCode.OK, StepCode.COASTED, StepCode.REPEATED, StepCode.STEP_REFUSED} <= set(np.unique(result).tolist())
    failed = {Premise.HOLDS, Premise.AGE, Premise.STEP, Premise.CONTRADICTED}
    assert failed <= set(np.unique(premise).tolist())


@pytest.mark.exhaustive
@pytest.mark.parametrize("missing_rows", [False, True])
def test_no_fault_of_a_log_makes_a_bound_false(missing_rows):
    """50 000 rows, a seventh of them with a fault of one of eight kinds."""
    never_false(pendulum_plant(missing_rows), 100, 500)


@pytest.mark.exhaustive
def test_no_fault_of_a_million_rows_makes_a_bound_false():
    never_false(pendulum_plant(), 2000, 500, seed=7)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["ball_and_beam_100hz", "heavy_top_100hz"])
def test_no_fault_makes_a_bound_of_a_shipped_certificate_false(name):
    """100 000 rows each."""
    # The checker takes longer: `test_small_ones_are_verified_whole`.
    certificate = ContractionCertificate.load(SHIPPED / f"{name}.json")._replace(verified=True)
    model = certificate.observer.model

    def length(q, v):
        return jnp.sqrt(certificate.q[1, 1] / 2 * v @ model.space.lower(q, v))

    plant = Plant(certificate.bounded(), certificate.given.noise, 0.0, length)
    never_false(plant, 200, 500)


@pytest.mark.exhaustive
@pytest.mark.parametrize("change", ["corrects by what is lost", "no contradiction"])
def test_the_attack_finds_a_bound_that_decides_for_itself(change, monkeypatch):
    honest = SampledBound.step

    def wrong(self, state, before, after, info, u, y, dt, missing):
        if change == "corrects by what is lost":
            after = after._replace(age=jnp.where(dt > 0, 0.0, after.age))
            info, missing = info._replace(result=jnp.zeros_like(info.result)), jnp.zeros_like(missing)
        else:
            info = info._replace(innovation=jnp.zeros_like(info.innovation))
        return honest(self, state, before, after, info, u, y, dt, missing)

    monkeypatch.setattr(SampledBound, "step", wrong)
    errors, premise, _ = attack(pendulum_plant(), 100, 300)
    assert errors[premise == 0].max() > 1.0


@pytest.mark.exhaustive
@pytest.mark.parametrize("wrong", [{"decay": 8.0}, {"force": 0.0}, {"force": 0.0, "noise": (0.0, 0.0)}], ids=str)
def test_an_attack_without_faults_finds_wrong_numbers(wrong):
    plant = pendulum_plant(recursion=LOST_ONCE._replace(**wrong))
    errors, premise, _ = attack(plant, 50, 500, faults=Faults(*[0.0] * len(Faults())))
    assert errors[premise == 0].max() > 1.0


def test_one_long_step_over_missing_rows_is_less_exact_than_its_bound():
    rough = dataclasses.replace(plain_pendulum(), substeps=1)
    loose = PROVED._replace(ages=np.array([[0.00999, 0.3]]), noise=(0.0,), force=0.0, steps=0.0, error=0.0)
    start, truth = (jnp.array([0.5]), jnp.array([2.0])), moved(jnp.array([0.5, 2.0]), jnp.zeros(1), jnp.asarray(0.25))
    for longest, known in ((0.3, True), (0.012, False)):
        observer = bounded(loose, rough, certified=rough, substeps=1, longest_step=longest, missing_rows=True)
        state, info = observer.step(starting(observer, *start, 1e-9), jnp.zeros(1), jnp.full(1, jnp.nan), 0.25)
        beyond = np.abs(np.asarray(observer.estimate(state) - truth))[1] > np.asarray(info.velocity_bound[0])
        assert beyond == known


@pytest.mark.exhaustive
def test_what_is_proved_is_what_the_short_tests_use(proved, tmp_path, monkeypatch):
    assert proved.statement.proved, proved.statement
    kinds = [claim.kind for claim in proved.claims]
    assert kinds == ["contraction", "reach", "reach", "disturbance", "correction", "missing", "prediction", "start"]
    bound = proved.bounded().bound
    for mine, used in zip(bound.recursion, PROVED, strict=True):
        assert np.allclose(mine, used, rtol=0.05)
        assert np.all(np.asarray(mine) <= np.asarray(used) * (1 + 1e-3))
    assert np.allclose(bound.reach, REACH, rtol=1e-3)
    assert np.allclose(bound.start, START, rtol=1e-3)
    assert proved.steady < proved.radius
    start = proved.start
    assert bound.within(start.together[:1], start.together[1:]) <= bound.radius
    assert bound.within(start.alone[:1], start.alone[1:]) == np.inf
    path = proved.save(tmp_path / "noisy.json")
    with pytest.raises(ValueError, match="not verified"):
        ContractionCertificate.load(path).bounded()
    assert ContractionCertificate.load(path, verify=True).bounded().bound.recursion.noise == bound.recursion.noise
    monkeypatch.setattr(_check, "DEPTH", 2)
    for place, value, message in (
        ("claims[4].squares", lambda squares: [each / 2 for each in squares], r"claims\[4\] is not shown"),
        ("claims[3].square", lambda square: square / 2, r"claims\[3\] is not shown"),
        ("claims[7].square", lambda square: square / 2, r"claims\[7\] is not shown"),
        ("claims[4].squares", MISSING, "squares"),
        ("claims[3]", MISSING, "must be one of .disturbance"),
        ("given.noise", [0.0], "squares"),
        ("given.noise", [3e-4], "box|room"),
        ("given.disturbance", [0.02], "the bound of the force with friction|lead out of"),
        ("radius", 0.5 * proved.steady, "lead out of"),
    ):
        with pytest.raises(ValueError, match=message):
            check(forged(path, tmp_path, put(place, value)))


def test_a_certificate_in_continuous_time_says_what_start_it_covers_and_has_no_bound():
    quiet = certify(plain_pendulum(), **BOUNDS, rate=1.0, checker="off", boxes=500)
    with pytest.raises(ValueError, match="continuous time"):
        quiet.bounded()
    assert quiet.start is not None
    assert (quiet.start.together < quiet.start.alone).all()
    assert (quiet.start.alone < quiet.start.farthest).all()


MASS_ON_A_SPRING = {"position": (-2.0, 2.0), "velocity": 3.0, "error": 0.3, "interval": (0.01, 0.01), "lost": 1}


@pytest.mark.exhaustive
def test_rows_that_may_be_missing_are_proved_and_checked_by_their_longer_steps(tmp_path):
    recipe = models.recipe("oscillator")
    model = models.from_recipe(recipe)
    assert isinstance(model, models.MechanicalSystem)
    observer = Intrinsic(model, 10.0, 40.0, substeps=1)
    empty = certify(observer, **MASS_ON_A_SPRING, recipe=recipe, checker="off")
    missing = certify(observer, **MASS_ON_A_SPRING, lost_rows="missing", recipe=recipe, checker="off")
    assert empty.statement.proved
    assert missing.statement.proved
    assert "each of them as a row without a measurement" in empty.statement.claim
    assert "as rows that may be missing: one prediction may cover 0.02002 s" in missing.statement.claim
    path = missing.save(tmp_path / "missing.json")
    checked = ContractionCertificate.load(path, verify=True)
    assert checked.statement.proved
    assert "missing_rows" not in json.loads(empty.save(tmp_path / "empty.json").read_text())["sampling"]
    truth = jnp.array([0.5 * np.cos(0.02), -0.5 * np.sin(0.02)])
    for certificate, premise in ((empty, Premise.AGE), (checked, Premise.HOLDS)):
        running = certificate.bounded(position=0.0, velocity=0.0)
        state, info = running.step(running.init(jnp.array([0.5])), jnp.zeros(1), truth[:1], 0.02)
        assert int(info.premise) == premise
        limits = jnp.concatenate([info.position_bound, info.velocity_bound])
        assert (jnp.abs(running.estimate(state) - truth) <= limits).all()

    # Steps of one interval, as if all rows were there.
    with pytest.raises(ValueError, match="missing_rows"):
        check(forged(path, tmp_path, put("sampling.missing_rows", False)))


@pytest.mark.exhaustive
def test_the_verb_fixes_the_number_of_steps_and_proves_their_errors():
    """An observer that chose it would have predictions that are assumed to be exact, and no bound."""
    bounds = {"velocity": 3.0, "error": 0.3, "region": {"q": (-2.0, 2.0)}, "interval": (0.01, 0.03), "checker": "off"}
    certificate = covariant.certify("oscillator", alpha=10.0, beta=40.0, **bounds).certificate
    assert certificate.sampling is not None
    assert certificate.sampling.substeps == 3
    state = certificate.bounded(velocity=0.0).init(jnp.array([0.5]))
    _, info = certificate.bounded(velocity=0.0).step(state, jnp.zeros(1), jnp.array([0.4999]), 0.01)
    assert int(info.premise) == Premise.CONTRADICTED  # the mass has moved by 2.5e-5
    free = certify(
        Intrinsic(models.oscillator(), 10.0, 40.0), **MASS_ON_A_SPRING | {"lost": 0, "checker": "off"}
    ).bounded(velocity=0.0)
    _, info = free.step(free.init(jnp.array([0.5])), jnp.zeros(1), jnp.array([0.499975]), 0.01)
    assert int(info.premise) == Premise.PREDICTION
