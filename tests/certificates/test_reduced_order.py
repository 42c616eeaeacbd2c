"""Reduced-order observers: what is proved of them is what they do, from any distance, and what cannot be is said."""

import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import Record, models, observers
from covariant._integrate import rk4_step
from covariant.certificates import reduced_order
from covariant.cli import main
from covariant.observers import ReducedOrder
from covariant.signals import StepCode
from covariant.verbs import design_reduced_order

BOXES = {
    "lorenz": (1.0, {}),
    "duffing": (1.0, {"inputs": [(-1.0, 1.0)]}),
    "van_der_pol": (1.0, {}),
    "bioreactor": (1e-6, {"inputs": [(0.0, 1e-4)]}),
    "unknown_frequency": (0.1, {"box": [(0.1, 1.0), (1.0, 1.5), (0.5, 1.5)]}),
}
"""Models, the rates that are proved, and bounds where they are not those of the model."""
FAR = 1e3


@pytest.fixture(scope="module")
def designed():
    made = {}

    def design(name):
        if name not in made:
            rate, bounds = BOXES[name]
            made[name] = reduced_order(getattr(models, name)(), rate, **bounds)
        return made[name]

    return design


@pytest.mark.long("bioreactor", "duffing", "lorenz", "van_der_pol")
@pytest.mark.parametrize("name", BOXES)
def test_it_is_proved_for_shipped_models(name, designed):
    design = designed(name)
    assert design.statement.proved, str(design.statement)
    assert design.everywhere
    assert np.linalg.eigvalsh(design.metric).min() > 0


@pytest.mark.long("bioreactor", "duffing", "lorenz", "van_der_pol")
@pytest.mark.parametrize("name", BOXES)
def test_squared_distances_shrink_as_proved_from_far_outside_the_box(name, designed):
    """Along motions that stay in the box, in continuous time, against the formula of the observer itself."""
    design, (rate, bounds) = designed(name), BOXES[name]
    model, y, z = design.model, jnp.array(design.measured), jnp.array(design.unmeasured)
    box = np.asarray(bounds.get("box", model.box), float)
    inputs = np.asarray(bounds.get("inputs", np.zeros((model.inputs, 2))), float).reshape(-1, 2)
    random = np.random.default_rng(0)
    gain, metric = jnp.asarray(design.injection), jnp.asarray(design.metric)

    def shrinking(x, off, u):
        """Rate of change of the squared distance, over it."""

        def w_dot(part):
            f = model.f(jnp.zeros(()), x.at[z].set(part), u)
            return f[z] - gain @ f[y]

        apart = w_dot(x[z] + off) - w_dot(x[z])
        return 2 * off @ metric @ apart / (off @ metric @ off)

    x = random.uniform(box[:, 0], box[:, 1], (2000, len(box)))
    off = FAR * random.normal(size=(2000, len(z))) * (box[np.asarray(z), 1] - box[np.asarray(z), 0])
    u = random.uniform(inputs[:, 0], inputs[:, 1], (2000, len(inputs)))
    rates = np.asarray(jax.vmap(shrinking)(*map(jnp.asarray, (x, off, u))))
    assert rates.max() < -rate * (1 - 1e-9)


def test_the_observer_of_the_design_finds_the_states_from_far_away(designed):
    design, dt = designed("lorenz"), 0.002
    lorenz = design.model

    def step(x, _):
        return rk4_step(lambda t, x: lorenz.f(t, x, jnp.zeros(0)), 0.0, x, dt), x

    x = np.asarray(jax.lax.scan(step, jnp.array([1.0, 2.0, 20.0]), None, 6001)[1])
    observer = ReducedOrder(lorenz, design.direction, start=jnp.array([0.0, 5e3, -5e3]))
    record = Record(dt * np.arange(6001), np.zeros((6001, 0)), x[:, :1])
    error = np.asarray(observers.run(observer, record).estimate) - x
    size = np.sqrt(np.einsum("ti,ij,tj->t", error[:, 1:], design.metric, error[:, 1:]))
    # Of the distance half of the rate of its square; the sampling is fine enough to leave it at that.
    assert (size[1:] <= size[:-1] * np.exp(-0.5 * dt) + 1e-6).all()
    assert size[-1] < 1e-4
    assert np.abs(error[:, 0]).max() < 1e-12, "what is measured is taken as it is"


def test_missing_outputs_correct_nothing_and_angles_are_wrapped():
    pendulum = models.StateSpace(
        lambda t, x, u: jnp.stack([x[1], -jnp.sin(x[0])]), lambda t, x, u: x[:1], coordinates=("q", "v"), circles=(0,)
    )
    observer = ReducedOrder(pendulum, [[1.0], [3.0]], start=[3.1, 0.0])
    state = observer.predict(observer.init(jnp.array([3.1])), jnp.zeros(0), jnp.asarray(0.01))
    unseen, info = observer.correct(state, jnp.zeros(0), jnp.array([jnp.nan]))
    assert (unseen.x == state.x).all()
    assert info.result == int(StepCode.COASTED)
    seen, _ = observer.correct(state, jnp.zeros(0), jnp.array([-3.1]))
    turn = 2 * np.pi - 6.2
    np.testing.assert_allclose(seen.x - state.x, [turn, 3 * turn], atol=2e-3)
    assert float(seen.x[1] - state.x[1]) == pytest.approx(3 * float(seen.x[0] - state.x[0]))


def test_a_state_that_shows_nothing_is_named():
    design = reduced_order(models.unknown_frequency(), 0.1)
    assert design.statement.verdict == "fails"
    assert design.injection is None
    text = str(design.statement)
    assert "x1 = 0" in text
    assert "x3: 1" in text
    with pytest.raises(ValueError, match="there is no reduced-order observer"):
        _ = design.direction


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rate": 0.0}, "rate must be a positive, finite number"),
        ({"box": [(0.0, 1.0)]}, "box must have bounds for each of 2 states"),
        ({"box": [(1.0, 0.0), (0.0, 1.0)]}, "bounds must be finite, the lower one first"),
        ({"inputs": [(0.0, 1.0)] * 2}, "inputs must have bounds for each of 1; got 2"),
        ({"h": lambda t, x, u: x[:1] ** 3}, "each output must be a state of its own"),
        ({"h": lambda t, x, u: x[:1] + jnp.sign(x[:1])}, "each output must be a state of its own"),
        ({"h": lambda t, x, u: x[:1] + x[1:]}, "each output must be a state of its own"),
        ({"h": lambda t, x, u: x}, "all states are measured"),
        ({"f": lambda t, x, u: jnp.stack([x[1], jnp.sin(t) * x[1]])}, "depends on time"),
    ],
)
def test_what_has_no_such_design_is_refused(change, words):
    duffing, rate = models.duffing(), change.pop("rate", 1.0)
    functions = {key: change.pop(key) for key in ("f", "h") if key in change}
    if functions:
        duffing = models.StateSpace(
            **{"f": duffing.f, "h": duffing.h} | functions,
            coordinates=("q", "v"),
            inputs=1,
            box=((-2.0, 2.0), (-2.0, 2.0)),
        )
    with pytest.raises(ValueError, match=words):
        reduced_order(duffing, rate, **change)


def test_an_observer_that_does_not_fit_its_model_is_refused():
    for direction, start, message in (
        (jnp.ones((2, 1)), 3, "start has 3 entries"),
        (jnp.ones((1, 2)), 2, "direction must have a row for each of 2 states"),
        (jnp.full((2, 1), jnp.nan), 2, "finite"),
    ):
        with pytest.raises(ValueError, match=message):
            ReducedOrder(models.duffing(), direction, jnp.zeros(start))


def test_the_command_prints_what_is_proved(monkeypatch, capsys):
    words = ("design", "reduced-order", "duffing", "--rate", "1", "--inputs", "u1=-1:1", "--json")
    monkeypatch.setattr(sys, "argv", ["covariant", *words])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["statement"]["verdict"] == "holds"
    assert (printed["measured"], printed["unmeasured"]) == (["q"], ["q_dot"])
    with pytest.raises(ValueError, match=r"inputs: unknown input 'u2'\. Known: u1"):
        design_reduced_order("duffing", rate=1.0, inputs={"u2": (0.0, 1.0)})
    with pytest.raises(ValueError, match="on a group"):
        design_reduced_order("heavy_top", rate=1.0)


@pytest.mark.long("where")
@pytest.mark.parametrize(
    "jump", [jnp.sign, jnp.floor, lambda v: jnp.where(v > 0.3, 1.0, 0.0)], ids=["sign", "floor", "where"]
)
def test_a_model_that_jumps_is_not_proved(jump):
    """JAX has the derivative 0 there, and estimates on both sides of the jump move apart."""
    model = models.StateSpace(
        lambda t, x, u: jnp.stack([0.0 * x[0], -x[1] + 5.0 * jump(x[1])]),
        lambda t, x, u: x[:1],
        coordinates=("q", "v"),
        box=((-2.0, 2.0), (-2.0, 2.0)),
    )
    design = reduced_order(model, 1.0)
    assert design.statement.verdict == "undecided"
    assert not design.everywhere
