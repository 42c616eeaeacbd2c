"""The bound of a step is never exceeded where its premises hold, and says so where they do not."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.certificates import Bounded, Premise, certify
from covariant.certificates.base._radius_recursion import Recursion
from covariant.certificates.sampled import SampledBound
from covariant.observers import Delayed, Gated, Info, Intrinsic
from covariant.signals import StepCode

RECIPE = {"system": "pendulum_chain", "parameters": {"mass": [1.0], "length": [0.5]}}
BOUNDS = {"position": (-3.0, 3.0), "velocity": 4.0, "error": 0.1, "input": 0.5}
NOISE, FORCE, INTERVAL = 2e-4, 0.01, (0.01, 0.012)
REGION = (np.array([[-3.0], [3.0]]), np.array([4.0]), np.array([[-0.5], [0.5]]), np.array([NOISE]))
# What is proved of the pendulum, see `test_what_is_proved_is_what_the_short_tests_use`.
AGES = np.array([[0.00999, 0.012012]])
PROVED = Recursion(2.0, 1.3457e-3, (1.7544e-10,), 2.7423e-2, 2.9087e-10, 2.3756e-5, AGES)
REACH, START, RADIUS = np.sqrt([70.88, 2442.2]), 3.6174 / np.array([70.88, 2442.2]), 0.01185
LOST_ONCE = PROVED._replace(noise=(*PROVED.noise, 4 * PROVED.noise[0]), ages=np.array([AGES[0], 2 * AGES[0]]))
SUBSTEPS = 4


def pendulum():
    system = models.from_recipe(RECIPE)
    assert isinstance(system, models.MechanicalSystem)
    return Intrinsic(system, 10.0, 50.0, substeps=SUBSTEPS)


@functools.cache
def plain_pendulum():
    """The same pendulum, whose metric is written as a constant: it compiles in no time."""
    swing = models.Lagrangian(
        lambda q: jnp.array([[0.25]]), lambda q: -0.25 * 19.62 * jnp.cos(q[0]), coordinates=("q",), circles=(0,)
    )
    return Intrinsic(swing, 10.0, 50.0, substeps=SUBSTEPS)


def bound_of(recursion=PROVED, missing_rows=False, certified=None, **changes):
    longest = float(recursion.ages[-1 if missing_rows else 0, 1])
    numbers = {"substeps": SUBSTEPS, "longest_step": longest / SUBSTEPS * (1 + 1e-15)} | changes
    rest = {"missing_rows": missing_rows, "circles": (True,)} | numbers
    return SampledBound(certified or plain_pendulum(), recursion, RADIUS, REACH, START, *REGION, **rest)


def bounded(recursion=PROVED, observer=None, first=0.01, **changes):
    return Bounded(observer or plain_pendulum(), bound_of(recursion, **changes), first)


def starting(observer, q, v, radius):
    """A state of a bounded observer at a motion, with a distance from the truth that is known."""
    state = observer.init(q)
    inner = state.inner._replace(q=q, v=v)
    return state._replace(inner=inner, radius=jnp.asarray(radius, float), premise=jnp.zeros(()))


def test_the_steady_radius_is_where_the_recursion_ends():
    rng, steady = np.random.default_rng(0), PROVED.steady
    assert PROVED.keeps(steady)
    assert not PROVED.keeps(0.999 * steady)
    assert not PROVED._replace(decay=-2.0).keeps(0.01)
    assert PROVED._replace(force=1.0).steady > RADIUS
    radius = 20 * steady
    for _ in range(2000):
        h = rng.choice([*AGES[0], rng.uniform(*INTERVAL)])
        a = PROVED.predicted(radius, h)
        radius = np.sqrt(a**2 + PROVED.noise[0]) + h * PROVED.change * (a + PROVED.error)
    assert 0.8 * steady < radius < steady


HERE = {"q": 0.1, "v": 1.0, "u": 0.2, "y": 0.111, "dt": 0.011, "start": 0.01}


@pytest.mark.core(1)
@pytest.mark.long("{}")
@pytest.mark.parametrize(
    ("change", "premise"),
    [
        ({}, Premise.HOLDS),
        ({"y": np.nan}, Premise.HOLDS),  # within the ages, nothing is corrected
        ({"y": 1e30}, Premise.HOLDS),  # the observer takes it as missing
        ({"y": -np.inf}, Premise.HOLDS),
        ({"y": 2.8}, Premise.CONTRADICTED),
        ({"y": 0.111 - 0.2}, Premise.CONTRADICTED),
        ({"y": 0.111 + 2 * np.pi}, Premise.HOLDS),
        ({"dt": 0.0}, Premise.HOLDS),  # a stamp that repeats
        ({"dt": 1e-310}, Premise.HOLDS),
        ({"dt": -0.01}, Premise.STEP),
        ({"dt": np.inf}, Premise.STEP),
        ({"dt": np.nan}, Premise.STEP),
        ({"dt": 0.02}, Premise.AGE),
        ({"dt": 0.002, "y": 0.102}, Premise.AGE),
        ({"dt": 0.02, "y": np.nan}, Premise.AGE),
        ({"v": 3.99, "y": 0.144}, Premise.VELOCITY),
        ({"v": np.nan}, Premise.STEP),
        ({"q": 2.999, "y": np.nan}, Premise.POSITION),
        ({"q": 2 * np.pi + 0.1}, Premise.HOLDS),
        ({"u": 0.51}, Premise.INPUT),
        ({"u": np.nan}, Premise.STEP),
        ({"start": np.inf}, Premise.START),
        ({"start": 0.013}, Premise.TUBE),
        ({"start": np.nan}, Premise.START),
    ],
    ids=str,
)
def test_a_bound_says_when_it_knows_nothing(change, premise):
    values = HERE | change
    observer = bounded()
    state = starting(observer, jnp.array([values["q"]]), jnp.array([values["v"]]), values["start"])
    state, info = observer.step(state, jnp.array([values["u"]]), jnp.array([values["y"]]), values["dt"])
    assert Premise(int(info.premise)) == premise
    assert bool(np.isfinite(info.velocity_bound).all()) == (premise == 0)
    # What is not known stays unknown.
    y = state.inner.q + 0.011 * state.inner.v
    _, again = observer.step(state, jnp.array([0.2]), y, 0.011)
    assert int(again.premise) == int(premise) or premise == Premise.HOLDS


@pytest.mark.core(1)
@pytest.mark.parametrize("result", list(StepCode))
def test_a_result_code_decides_what_is_covered(result):
    """Codes that the observer here never returns, on a step that looks like a correction and on one that does not."""
    observer, bound = plain_pendulum(), bound_of(LOST_ONCE)
    state = starting(bounded(LOST_ONCE), jnp.array([0.1]), jnp.array([1.0]), 0.004)
    before = state.inner
    for lost, allowed in ((False, {StepCode.OK}), (True, {StepCode.OK, StepCode.COASTED, StepCode.OUTLIER})):
        y = jnp.array([np.nan if lost else 0.111])
        after, info = observer.step(before, jnp.zeros(1), y, 0.011)
        told = Info(info.innovation, info.distance, jnp.asarray(int(result)))
        _, premise, _ = bound.step(state, before, after, told, jnp.zeros(1), y, jnp.asarray(0.011), jnp.isnan(y))
        assert (premise == 0) == (result in allowed)


def after(observer, *samples, start=0.004) -> tuple[Any, Any]:
    """What steps return, of pairs y − q̂ or NaN, and dt."""
    state, info = starting(observer, jnp.array([0.1]), jnp.array([1.0]), start), None

    def sample(state, off, dt):
        y = observer.observer.predict(state.inner, jnp.array([0.2]), dt).q + off
        return observer.step(state, jnp.array([0.2]), y, dt)

    sample = sample if len(samples) < 3 else jax.jit(sample)
    for off, dt in samples:
        state, info = sample(state, jnp.asarray(off, float), jnp.asarray(dt, float))
    return state, info


SAMPLE, LOST, GAP, MISSING_ROWS = (0.0, 0.011), (np.nan, 0.011), (0.0, 0.022), {"missing_rows": True}
# The step that ran decides, whatever the ages are.
SHORT = MISSING_ROWS | {"longest_step": 0.011 / SUBSTEPS}
PREMISES: list[tuple[Recursion, dict, list, Premise]] = [
    (LOST_ONCE, {}, [LOST, SAMPLE], Premise.HOLDS),
    (LOST_ONCE, {}, [GAP], Premise.AGE),
    (LOST_ONCE, MISSING_ROWS, [GAP], Premise.HOLDS),
    (LOST_ONCE, MISSING_ROWS, [LOST, SAMPLE], Premise.HOLDS),
    (LOST_ONCE, MISSING_ROWS, [(0.0, 0.033)], Premise.AGE),
    (LOST_ONCE, SHORT, [GAP], Premise.PREDICTION),
    (LOST_ONCE, SHORT, [(0.0, 0.0109)], Premise.HOLDS),
    (PROVED, {}, [SAMPLE], Premise.HOLDS),
    (PROVED, {"longest_step": 0.0}, [SAMPLE], Premise.PREDICTION),
    (PROVED, {"substeps": None}, [SAMPLE], Premise.PREDICTION),
    (PROVED, {"substeps": 3}, [SAMPLE], Premise.PREDICTION),
]


@pytest.mark.core(3)
@pytest.mark.parametrize(("recursion", "changes", "samples", "premise"), PREMISES, ids=range(len(PREMISES)))
def test_a_row_that_is_missing_is_not_one_that_is_empty_and_steps_are_those_of_the_proof(
    recursion, changes, samples, premise
):
    """One step over a gap has longer Runge–Kutta steps than those of a proof for empty rows."""
    assert after(bounded(recursion, **changes), *samples)[1].premise == premise


def test_a_bound_stays_with_the_observer_that_it_is_about():
    plain, honest = plain_pendulum(), bounded()
    assert dataclasses.replace(honest, first_radius=0.005).bound.certified is plain
    gated = Gated(plain, plain.model, jnp.asarray(NOISE), jnp.asarray(1.0))
    assert dataclasses.replace(honest, observer=gated).bound is honest.bound
    for changes in ({"alpha": 1.0}, {"substeps": 1}, {"substeps": None}, {"coefficients": "estimated"}):
        with pytest.raises(ValueError, match="not the one of the certificate"):
            dataclasses.replace(honest, observer=dataclasses.replace(plain, **changes))

    class Nudged(Gated):
        """A gate that does more than to refuse measurements."""

    nudged = Nudged(plain, plain.model, jnp.asarray(NOISE), jnp.asarray(1.0))
    for other in (nudged, dataclasses.replace(gated, fast_start=True), pendulum()):
        with pytest.raises(ValueError, match="not the one of the certificate"):
            Bounded(other, honest.bound, 0.005)

    @jax.jit
    def with_gain(alpha):
        return dataclasses.replace(honest, observer=dataclasses.replace(plain, alpha=alpha)).first_radius

    with pytest.raises(ValueError, match="not the one of the certificate"):
        with_gain(1.0)
    changed = eqx.filter_jit(lambda each: dataclasses.replace(each, first_radius=0.1))(honest)
    assert changed.first_radius == 0.1


def test_wrong_first_errors_are_one_clear_line():
    for radius in (-1.0, np.nan):
        with pytest.raises(ValueError, match="first radius must be"):
            bounded(first=radius)
    for wrong in (-1.0, np.nan, "far", [0.1, 0.1], [[0.1]]):
        for errors in ((wrong, 0.1), (0.1, wrong)):
            with pytest.raises(ValueError, match="bounds of initial errors must be"):
                bound_of().within(*errors)


def test_lost_samples_need_an_interval():
    for lost in ({"lost": 1}, {"lost_rows": "missing"}):
        with pytest.raises(ValueError, match="lost samples need interval"):
            certify(plain_pendulum(), **BOUNDS, **lost)
    with pytest.raises(ValueError, match="lost must be a whole number"):
        certify(plain_pendulum(), **BOUNDS, interval=INTERVAL, lost=1.5)  # pyright: ignore[reportArgumentType]


def test_no_wrapper_takes_the_steps_of_a_bound_apart():
    """A reading that is too late took no step, and would have reported a bound of 0."""
    with pytest.raises(ValueError, match="Delayed: what Bounded reports"):
        Delayed(bounded(), 0.02, 100.0)
    with pytest.raises(ValueError, match="Gated: what Bounded reports"):
        Gated(bounded(), plain_pendulum().model, jnp.asarray(NOISE), jnp.asarray(1.0))


def test_half_a_step_by_hand_leaves_no_bound():
    observer = bounded()
    state = starting(observer, jnp.array([0.1]), jnp.array([1.0]), 0.004)
    for half in (
        observer.predict(state, jnp.zeros(1), jnp.asarray(0.011)),
        observer.correct(state, jnp.zeros(1), jnp.array([0.3]))[0],
        observer.advance(state, jnp.zeros(1), jnp.array([0.3]), jnp.asarray(0.011))[0],
    ):
        assert np.isinf(half.radius)
        assert observer.step(half, jnp.zeros(1), half.inner.q, 0.011)[1].premise == Premise.STEP


def test_numbers_of_a_bounded_observer_are_constants_in_code():
    """A bound is about the numbers that were proved, and no other mass."""
    from covariant.codegen import with_open_numbers

    assert with_open_numbers(plain_pendulum()).numbers
    assert not with_open_numbers(bounded()).numbers


# What is proved, by prover and checker.


@pytest.fixture(scope="module")
def proved():
    return certify(
        pendulum(), **BOUNDS, interval=INTERVAL, noise=NOISE, disturbance=FORCE, recipe=RECIPE, checker="off"
    )
