"""Friction that depends on time and inputs: a brake, a rudder; and coordinates on which nothing depends."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from driven import boat, pendulum, sled
from forging import forged, put, together

from covariant import models
from covariant.certificates import certify, check, error_system, lyapunov
from covariant.certificates.base._properties import free_entries
from covariant.certificates.checking import _check
from covariant.observers import Intrinsic

BOUNDS = {"velocity": 2.0, "error": 0.1, "position": {"brake": (0.0, 1.0), "thrust": (-0.5, 1.0)}, "rate": 1.0}
RECIPE = {"attribute": f"{__name__}:sled", "parameters": {}}


def certified(model=None, **changes):
    bounds: Any = BOUNDS | {"checker": "off"} | changes
    return certify(Intrinsic(sled() if model is None else model, 4.0, 8.0), **bounds)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    return certified(recipe=RECIPE).save(tmp_path_factory.mktemp("sled") / "certificate.json")


def test_the_statement_names_signals_and_what_is_free():
    certificate = certified(checker="all")
    assert certificate.domain.names == ("x", "v_x", "e_x", "f_x", "brake")
    assert certificate.domain.units[-1] == "N s/m"
    assert certificate.kinds[-2:] == ("force", "signal")
    text = str(certificate.statement)
    assert certificate.statement.short == "holds (proved)"
    assert "the domain contains: brake 0 to 1 N s/m" in text
    assert "true positions: any, since nothing depends on them" in text
    assert "nothing depends on x, so that the statement is the same" in text
    assert "inputs: thrust -0.5 to 1 N, brake 0 to 1 N s/m" in text


def test_it_is_checked_from_its_file(saved):
    assert check(saved, model=sled()).rate == 1.0


FORGERIES = {
    "rate": (put("rate", 5.0), r"claims\[0\] is not shown to hold"),
    "brake let go in the box": (put("box.low[4]", 0.5), "box: it must hold all given values of brake"),
    "brake beyond the box": (put("given.inputs.high[1]", 1.5), "box: it must hold all given values of brake"),
    "another signal": (put("driven", [1]), r"driven: the friction of the model depends on the signals \[2\]"),
    "no signal": (
        together(put("driven"), put("box.low[4]"), put("box.high[4]")),
        "box: the model has 5 variables",
    ),
    "an earlier velocity": (put("velocity[0]", 2.5), "v_x may be"),
    "signals out of order": (put("driven", [2, 2]), "different places in rising order"),
    "signals and samples": (put("sampling", {}), "driven"),
    "negative brake": (
        together(put("given.inputs.low[1]", -8.0), put("box.low[4]", -8.0)),
        r"claims\[0\] is not shown to hold",
    ),
}


@pytest.mark.core(5)
@pytest.mark.parametrize("name", FORGERIES)
def test_forgeries_are_refused_with_the_reason(saved, tmp_path, monkeypatch, name):
    monkeypatch.setattr(_check, "DEPTH", 2)
    change, reason = FORGERIES[name]
    with pytest.raises(ValueError, match=reason):
        check(forged(saved, tmp_path, change), model=sled())


def test_a_brake_that_drives_is_refuted():
    found = certified(position={"brake": (-9.0, 1.0)})
    assert found.statement.verdict == "fails"
    assert found.counterexample is not None
    assert found.counterexample.mean(axis=0)[-1] < 0


@pytest.mark.parametrize(("model", "signals"), [(pendulum(), [0.4, 0.7]), (boat(), [0.3])], ids=["pendulum", "boat"])
def test_the_flow_is_that_of_the_observer_with_these_signals(model, signals):
    """Velocities change as in the observer that runs, which is given time and inputs and no box."""
    observer, n = Intrinsic(model, 4.0, 8.0), 1 if model.coordinates else 3
    system = error_system(observer, lyapunov(4.0, 8.0))
    random = np.random.default_rng(0)
    q = random.uniform(-1, 1, n if model.coordinates else 0)
    v, e = random.uniform(-1, 1, (2, n))
    t, u = (signals[0], [0.0, signals[1]]) if model.coordinates else (0.0, [0.0, *signals])
    estimate = jnp.asarray(q) if model.coordinates else model.manifold.origin()
    f = models.applied_force(model, jnp.asarray(t), estimate, jnp.asarray(u))
    measured = model.manifold.retract(estimate, -jnp.asarray(e))
    if model.coordinates:  # the force is evaluated at the measurement
        f = models.applied_force(model, jnp.asarray(t), measured, jnp.asarray(u))
    point = system.at(jnp.concatenate([jnp.asarray(q), v, e, f, jnp.asarray(signals)]))
    state = observer.init(estimate)._replace(v=jnp.asarray(v), t=jnp.asarray(t))
    expected = observer.flow(jnp.asarray(t), state, jnp.asarray(u), measured).v
    np.testing.assert_allclose(point.flow(jnp.zeros(()), point.x)[n:], expected, rtol=1e-12)


def test_all_that_is_missing_is_said_at_once():
    message = (
        "certify: position needs bounds of angle; input needs bounds of u2, on which the friction depends; "
        "region lacks angle=LOW:HIGH,u2=LOW:HIGH; friction of this model depends on time; give times"
    )
    with pytest.raises(ValueError, match=message):
        certified(pendulum(), position=None)
    with pytest.raises(ValueError, match=r"unknown coordinate or input of the region 'rudder'.* Known: angle, u1, u2"):
        certified(pendulum(), position={"rudder": (-1.0, 1.0)})
    for pair in ((1.0, 0.0), (0.0, np.inf), (np.nan, 1.0)):
        with pytest.raises(ValueError, match="brake needs two finite bounds"):
            certified(position={"brake": pair})


def test_time_may_be_a_signal():
    found = certified(pendulum(), position={"angle": (-1.0, 1.0), "u2": (0.0, 0.5)}, times=(0.0, 20.0), error=0.05)
    assert found.statement.verdict == "holds"
    assert found.domain.names[-2:] == ("time", "u2")
    assert found.domain.high[-2:].tolist() == [20.0, 0.5]


def test_with_samples_it_is_refused():
    with pytest.raises(ValueError, match=r"dissipation of this model depends on brake; .* in continuous time alone"):
        certified(interval=(0.01, 0.01))


READING = {
    "metric": {"metric": lambda q: jnp.diag(1 + 0.1 * jnp.cos(q))},
    "potential": {"potential": lambda q: q[0] ** 2 + q[1] ** 2},
    "force": {"force": lambda t, q, u: u * (1 + q**2)},
    "friction": {"dissipation": lambda q, v: -v / (1 + q**2)},
}


@pytest.mark.parametrize("what", READING)
def test_a_coordinate_that_a_function_reads_is_not_free(what):
    given = {"metric": lambda q: jnp.diag(2 + jnp.array([1.0, 0.0]) * jnp.cos(q[0])), "coordinates": ("a", "b")}
    free = models.Lagrangian(**given, dissipation=lambda q, v: -v)
    assert free_entries(free).tolist() == [False, True]
    assert not free_entries(models.Lagrangian(**given | READING[what])).any()


def test_a_coordinate_without_bounds_is_the_same_everywhere():
    """The flow and its slopes at any value are those at 0, where the proof is."""
    found = certified()
    assert found.domain.low[0] == -found.domain.high[0] == -0.1
    z = jnp.array([0.05, 1.0, 0.08, 0.3, 0.4])
    here, there = (found.error_system.at(z.at[0].add(shift)) for shift in (0.0, 1e3))
    for derive in (lambda flow: flow, jax.jacfwd):
        ends = [derive(lambda x, point=point: point.flow(jnp.zeros(()), x))(point.x) for point in (here, there)]
        np.testing.assert_allclose(ends[1], ends[0], rtol=1e-9)
