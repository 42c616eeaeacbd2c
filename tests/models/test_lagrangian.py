"""What holds for every mechanical system: power balance, checks when it is built, angles, precision."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st

from covariant import geometry, models
from covariant.geometry.lie import SO3, LeftInvariant
from covariant.models import Lagrangian, acceleration, energy, friction, source
from covariant.models._mechanical import check_model

TIME = jnp.zeros(())


def every_model():
    chain = {"mass": (1.0, 0.5, 0.7), "length": (1.0, 0.8, 0.6), "com": (0.5, 0.4, 0.6), "inertia": (0.1, 0.05, 0.02)}
    chain |= {"rotor_inertia": (0.01, 0.02, 0.03), "gear": (3.0, -2.0, 5.0)}
    rough = {"viscous": (0.1, 0.2, 0.3), "coulomb": (0.2, 0.1, 0.05), "offset": (0.3, -0.2, 0.1), "actuated": (2, 0)}
    return {
        "ball and beam": models.ball_and_beam(9.81, 0.5, 0.2),
        "oscillator q": models.oscillator("q", 2.0),
        "oscillator r": models.oscillator("r", 2.0),
        "pendulum": models.pendulum_chain((1.0,), (0.5,)),
        "double pendulum": models.pendulum_chain(),
        "chain, relative": models.pendulum_chain(**chain),
        "chain, absolute": models.pendulum_chain(**chain, angles="absolute"),
        "rough chain, relative": models.pendulum_chain(**chain, **rough),
        "rough chain, absolute": models.pendulum_chain(**chain, **rough, angles="absolute"),
    }


MODELS = every_model()
SAMPLES = 10


@pytest.fixture(scope="module", params=MODELS)
def model(request):
    return MODELS[request.param]


@pytest.fixture(scope="module")
def motions(model):
    """States and inputs side by side: q > 0 for the chart r, velocities that include rest."""
    n = len(model.coordinates)
    rng = np.random.default_rng(n)
    q, v = rng.uniform(0.2, 1.5, (SAMPLES, n)), rng.normal(size=(SAMPLES, n))
    v[0] = 0.0
    return q, v, rng.normal(size=(SAMPLES, n if model.inputs is None else model.inputs))


@pytest.mark.core(3)
def test_dissipation_never_adds_energy(model, motions):
    q, v, _ = motions
    assert (jax.vmap(lambda q, v: v @ model.dissipation(q, v))(q, v) <= 0).all()


def test_single_precision_stays_single(model):
    n, m = len(model.coordinates), len(model.coordinates) if model.inputs is None else model.inputs
    t, q, u = (jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((), (n,), (m,)))
    results = jax.eval_shape(
        lambda t, q, v, u: (
            acceleration(model, t, q, v, u),
            source(model, t, q, u),
            friction(model, TIME, q, v, u),
            energy(model, q, v),
            model.manifold.towards(q, v),
        ),
        *(t, q, q, u),
    )
    assert {leaf.dtype for leaf in results} == {jnp.dtype(jnp.float32)}


@pytest.mark.core(1)
@pytest.mark.exhaustive("chain, absolute", "chain, relative", "double pendulum", "rough chain, relative")
def test_single_precision_agrees_with_double(model, motions):
    """To 1e-4 of the largest: a thousand roundings."""
    forward = jax.jit(jax.vmap(lambda q, v, u: acceleration(model, jnp.zeros((), q.dtype), q, v, u)))
    double = forward(*motions)
    single = forward(*(np.asarray(a, np.float32) for a in motions))
    np.testing.assert_allclose(single, double, rtol=0, atol=1e-4 * max(1.0, np.abs(double).max()))


@pytest.mark.core(2)
def test_model_passes_through_jit(model, motions):
    """As an argument: arrays are traced, the rest is compared, so a second call compiles nothing."""
    traces = []

    @eqx.filter_jit
    def forward(model, q, v, u):
        traces.append(None)
        return acceleration(model, TIME, q, v, u)

    q, v, u = (jnp.asarray(a[1]) for a in motions)
    first = forward(model, q, v, u)
    np.testing.assert_array_equal(first, forward(model, q, v, u))
    assert len(traces) == 1


# Checks when a model is built


def flat(q):
    return jnp.eye(2)


def free(q):
    return 0.0 * q[0]


NAMES = {"coordinates": ("a", "b")}


UNREADABLE = "cannot be evaluated with 2 coordinates"
OTHER_CIRCLES = r"must be indices of the 2 coordinates"


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"potential": lambda q: q}, "potential must return shape"),
        ({"force": lambda t, q, u: u[:1]}, "force must return shape"),
        ({"force": lambda t, q, u: 0.0 * t}, "force must return shape"),
        ({"inputs": 1}, "force must return shape"),  # a model takes its input for the force
        ({"dissipation": lambda q, v: jnp.stack([v, v])}, "dissipation must return shape"),
        ({"metric": lambda q: jnp.eye(3)}, "metric "),
        ({"metric": lambda q: q}, "metric "),
        ({"metric": lambda q: q[0]}, "metric "),
        ({"metric": lambda q: jnp.eye(2) @ jnp.ones(3)}, f"metric {UNREADABLE}"),
        ({"potential": lambda: 0.0}, f"potential {UNREADABLE}"),
        ({"force": lambda q, u: u}, f"force {UNREADABLE}"),
        ({"force": lambda t, q, u: q + jnp.ones(3)}, f"force {UNREADABLE}"),
        ({"dissipation": lambda q, v: v.nonsense}, f"dissipation {UNREADABLE}"),
        ({"circles": (2,)}, rf"circles \(2,\) {OTHER_CIRCLES}"),
        ({"circles": (-1,)}, rf"circles \(-1,\) {OTHER_CIRCLES}"),
        ({"circles": (0, 5)}, rf"circles \(0, 5\) {OTHER_CIRCLES}"),
    ],
)
def test_what_does_not_fit_is_named(given, words):
    with pytest.raises(ValueError, match=f"^{words}"):
        Lagrangian(**{"metric": flat, "potential": free} | given, **NAMES)


@pytest.mark.parametrize("inputs", [0, 1, 3])
def test_inputs_that_are_no_force_are_refused_where_a_force_is_first_asked_for(inputs):
    """One input would act on both coordinates."""
    model = Lagrangian(flat, free, inputs=inputs)
    with pytest.raises(
        ValueError, match=rf"force must return shape \(2,\); with {inputs} inputs it returned \({inputs},\)"
    ):
        acceleration(model, TIME, jnp.zeros(2), jnp.zeros(2), jnp.zeros(inputs))


def test_model_without_names_is_checked_on_request():
    model = Lagrangian(flat, lambda q: q)
    with pytest.raises(ValueError, match=r"potential must return shape \(\) for 2 coordinates; it returned \(2,\)"):
        check_model(model, 2)


def test_input_is_the_force_by_default():
    model = Lagrangian(flat, free, **NAMES)
    q, u = jnp.array([0.1, 0.2]), jnp.array([3.0, 4.0])
    np.testing.assert_array_equal(acceleration(model, TIME, q, 0 * q, u), u)


# Angles

EDGES = st.sampled_from([k * np.pi + s for k in range(-3, 4) for s in (-1e-12, 0.0, 1e-12)])
ANGLES = EDGES | st.floats(-100, 100, allow_subnormal=False)


@given(ANGLES, ANGLES)
def test_wrapped_angle_is_short_and_the_same(angle, straight):
    e = jnp.array([angle, straight])
    wrapped = geometry.wrap((0,), e)
    assert abs(wrapped[0]) <= np.pi * (1 + 1e-14)
    assert np.sin((wrapped[0] - angle) / 2) == pytest.approx(0.0, abs=1e-13)
    assert wrapped[1] == straight


@given(st.floats(-np.pi * (1 - 1e-12), np.pi * (1 - 1e-12)))
def test_short_angle_is_left_as_it_is(angle):
    assert geometry.wrap((0,), jnp.array([angle]))[0] == angle


def test_wrap_has_derivative_one():
    np.testing.assert_array_equal(jax.jacfwd(lambda e: geometry.wrap((0, 1), e))(jnp.array([4.0, -9.0])), jnp.eye(2))


def test_the_way_to_a_measurement_is_the_short_one_and_none_to_a_missing_one():
    model = models.pendulum_chain((1.0, 1.0, 1.0), (1.0, 1.0, 1.0))
    q, y = jnp.array([3.0, 0.5, 1.0]), jnp.array([-3.0, jnp.nan, 0.25])
    np.testing.assert_allclose(model.manifold.towards(q, y), [2 * np.pi - 6.0, 0.0, -0.75], atol=1e-15)


def test_missing_measurement_has_a_finite_derivative():
    model = models.ball_and_beam()
    slope = jax.jacrev(lambda q: model.manifold.towards(q, jnp.array([jnp.nan, 0.0])))(jnp.ones(2))
    np.testing.assert_array_equal(slope, [[0.0, 0.0], [0.0, -1.0]])


def test_a_metric_on_a_group_is_no_lagrangian_in_coordinates():
    with pytest.raises(ValueError, match="not in coordinates; build a MechanicalSystem"):
        Lagrangian(LeftInvariant(SO3, np.eye(3)), lambda q: 0.0 * q[0])


def test_a_survey_goes_on_where_a_metric_is_not_finite():
    """As in polar coordinates at the origin, here on half of the line."""
    model = Lagrangian(lambda q: jnp.eye(3) / jnp.where(q[0] < 0, 0.0, 1.0), lambda q: 0.0, coordinates=("x", "y", "z"))
    assert np.isnan(models.survey(model, np.tile([-1.0, 1.0], (3, 1)), samples=20).conditioning).all()
    low, high = models.survey(model, np.array([[0.1, 1.0], [-1.0, 1.0], [-1.0, 1.0]]), samples=20).conditioning
    assert low == pytest.approx(high) == pytest.approx(1.0)
