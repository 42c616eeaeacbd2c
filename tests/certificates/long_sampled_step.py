"""The sampled step contracts where its certificate says so, and nothing else is proved or accepted: what takes long."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from balls import check_sample
from forging import forged, put, together
from test_sampled_step import BOUNDS, RECIPE, Q, pendulum, swing

import covariant
from covariant import models
from covariant.certificates import ContractionCertificate, certify, check, falsify, sampled_system
from covariant.certificates.base import Sampling, value_graph
from covariant.certificates.base._document import parse
from covariant.certificates.checking import _check
from covariant.geometry import lie
from covariant.observers import Geodesic, Intrinsic
from scalargraph.proofs.checker import TaylorEnclosure


@pytest.fixture(scope="module")
def proved():
    """The certificate of a pendulum with samples 5 to 50 ms apart."""
    return certify(pendulum(), **BOUNDS, interval=(0.005, 0.05), recipe=RECIPE, checker="off")


@pytest.fixture(scope="module")
def saved(proved, tmp_path_factory):
    return proved.save(tmp_path_factory.mktemp("sampled") / "certificate.json")


SHEARED = Sampling(
    np.array([0.002, 0.004]), 1, np.array([[[-1.0, -0.2], [-0.2, 0.02]], [[-3.0, 0.5], [0.5, 0.01]]]), True
)


@pytest.mark.exhaustive
def test_a_pendulum_is_proved_for_any_interval_from_5_to_50_ms(proved, saved):
    assert proved.statement.proved, proved.statement
    assert proved.boxes < 1000
    assert proved.radius > 1e-3
    text = str(proved.statement)
    for part in ("samples 0.005 to 0.05 s apart", "4 Runge–Kutta steps", "R(τ)", "lengthens no curve"):
        assert part in text
    assert "not covered" not in text
    assert falsify(proved.error_system, proved.domain, proved.rate, attempts=4000, starts=16).verdict == "holds"
    checked = check(saved)
    assert checked.statement.proved
    assert checked.statement.about == proved.statement.about
    loaded = ContractionCertificate.load(saved)
    assert loaded.statement.short == "holds (claimed)"
    assert loaded.half_widths.tolist() == proved.half_widths.tolist()
    assert loaded.kinds[-3:] == ("joint force", "friction slope", "age")
    assert check_sample(saved, 5)[0] == 5


@pytest.mark.exhaustive
def test_where_simulation_grows_nothing_is_proved():
    """At intervals beyond 0.25 s the pendulum's sampled errors grow."""
    result = certify(pendulum(), **BOUNDS, interval=(0.3, 0.3), rate=0.01, checker="off", boxes=20_000)
    assert result.statement.verdict != "holds"
    assert result.radius == 0.0


@pytest.mark.exhaustive
def test_a_factor_that_takes_the_whole_rate_is_named_and_no_steps_are_tried():
    result = certify(pendulum(), **BOUNDS, interval=(0.1, 0.1), rate=0.3, checker="off", boxes=5000)
    assert result.statement.verdict == "undecided"
    (reason,) = (h.place for h in result.statement.hypotheses if h.verdict != "holds")
    assert str(reason).startswith("the factor takes up to 0.1")
    assert "make the interval shorter" in str(reason)
    assert "prediction" not in [claim.kind for claim in result.claims]


@pytest.mark.exhaustive
def test_the_factor_that_runs_takes_no_more_than_is_subtracted(proved):
    """At random points the step that runs differs from the one that is proved by less than its bound."""
    claim, h = next(c for c in proved.claims if c.kind == "missing"), proved.sampling.oldest
    rng = np.random.default_rng(5)
    observer, loss = proved.observer, proved.rate / 2 - proved.decay
    assert 0 < loss < proved.rate / 2

    @jax.jit
    def both(q, v, y, u):
        state = observer.init(q)._replace(q=q, v=v, age=jnp.asarray(h))
        new, info = observer.correct(state, u, y)
        smooth = observer.smooth_correction(jnp.zeros(()), q, v, u, y, jnp.asarray(h))
        return new.v - smooth.v, info.result, observer.missing_acceleration(jnp.zeros(()), q, v, u, y)

    worst = 0.0
    for _ in range(300):
        q, v, e, u = (jnp.asarray(rng.uniform(-b, b, 1)) for b in (3.0, 4.0, 0.1, 0.5))
        difference, result, (xi, missing) = both(q, v, q - e, u)
        assert int(result) == 0
        assert float(jnp.abs(missing)[0]) <= np.sqrt(claim.square) * float(jnp.abs(xi)[0])
        # |e| ≤ limit · r in the metric, whose square root on this pendulum is l √m = 0.5.
        r = 0.5 * float(jnp.abs(e)[0]) / claim.limit
        length = np.sqrt(proved.q[1, 1] / 2) * 0.5 * float(jnp.abs(difference)[0])
        worst = max(worst, length / (loss * h * r))
    assert 0.1 < worst < 1


def forge(path, folder, change):
    """A forged certificate, with the graph that goes with its observer and sampling where these can be read."""
    made = forged(path, folder, change)
    try:
        read = parse(made)
        assert read.sampling is not None
        observer = pendulum(read.observer["alpha"], read.observer["beta"])
        graph = value_graph(sampled_system(observer, read.q, read.sampling))
    except (AssertionError, ValueError):
        return made
    return forged(made, folder, put("graph", graph))


FORGERIES = {
    "longer interval": (put("sampling.interval[1]", 0.06), "it must hold the ages"),
    "longer interval and box": (
        together(put("sampling.interval[1]", 0.25), put("box.high[6]", 0.25)),
        "nothing is left of",
    ),
    "shorter interval": (put("sampling.interval[0]", 0.0), "two positive times"),
    "one more lost": (put("sampling.lost", 1), "must be one of .correction"),
    "no box of ages": (put("box.high[6]", 0.04), "it must hold the ages"),
    "rate": (put("rate", 9.0), r"claims\[0\] is not shown"),
    "slope of the metric": (put("sampling.slopes[0]", [[0.0, 0.0], [0.0, 0.0]]), r"claims\[\d\] is not shown"),
    "no slopes": (put("sampling.slopes", []), r"claims\[\d\] is not shown"),
    "not symmetric": (put("sampling.slopes[0][0][1]", 1.0), "symmetric matrices"),
    "no shear": (put("sampling.shear", False), r"claims\[\d\] is not shown"),
    "metric after the measurement": (put("q[1][1]", lambda b: 3 * b), r"claims\[\d\] is not shown"),
    "gain": (put("observer.beta", 500.0), r"claims\[\d\] is not shown"),
    "input": (put("given.inputs.high[0]", 0.6), "the bound of the input's force is not shown"),
    "force box": (put("box.high[4]", 0.4), "the bound of the force with friction 1 is not shown"),
    "slopes of friction": (
        together(put("box.low[5]", 0.1), put("box.high[5]", 0.2)),
        "the bound of the friction's slope 1 is not shown",
    ),
    "noise": (put("given.noise[0]", 0.01), "squares"),
    "disturbance": (put("given.disturbance[0]", 0.01), "must be one of .disturbance"),
    "start": (put("claims[6].square", lambda s: s / 4), r"claims\[6\] is not shown"),
    "radius": (put("radius", lambda r: 1.01 * r), "may reach|which its box"),
    "without sampling": (put("sampling"), "box"),
    "substeps": (put("sampling.substeps", -1), "a whole number"),
    "stiffness": (put("claims[4].square", lambda s: s / 4), r"claims\[4\] is not shown"),
    "length of the error": (put("claims[4].limit", lambda s: s / 4), r"claims\[4\] is not shown"),
    "too stiff for the factor": (put("claims[4].square", lambda s: 100 * s), "nothing is left of"),
    "no stiffness": (put("claims[4]"), "must be one of .missing"),
    "errors of the steps": (put("claims[5].square", lambda s: s / 1e5), r"claims\[5\] is not shown"),
    "too small a tube for the steps": (put("radius", 1e-6), "errors of 4 steps lead"),
    "too few steps": (
        together(put("radius", 1e-5), put("sampling.substeps", 2)),
        "errors of 2 steps lead",
    ),
    "a bound of lower order": (put("claims[5].order", 0), "errors of 4 steps lead"),
    "a bound of higher order than the steps": (put("claims[5].order", 5), "a whole number from 0 to 4"),
    "another key": (put("sampling.delay", 0.0), "is not known"),
}


@pytest.mark.exhaustive(
    "shorter interval",
    "one more lost",
    *("errors of the steps", "force box", "gain", "input", "length of the error", "longer interval"),
    *("longer interval and box", "metric after the measurement", "no box of ages", "no slopes", "rate"),
    *("slope of the metric", "slopes of friction", "start", "stiffness"),
)
@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_file_is_refused_with_the_reason(saved, tmp_path, monkeypatch, name):
    change, reason = FORGERIES[name]
    # The claims before it are right, and take more halvings.
    monkeypatch.setattr(_check, "DEPTH", 6 if "claims" in reason else 1)
    with pytest.raises(ValueError, match=reason):
        check(forge(saved, tmp_path, change))


@pytest.mark.exhaustive
def test_errors_of_steps_without_a_claim_are_assumed_to_be_zero(saved, tmp_path):
    text = str(ContractionCertificate.load(forge(saved, tmp_path, put("claims[5]"))).statement)
    assert "assumed: predictions solve the model exactly" in text


def test_predictions_are_off_by_no_more_than_is_stated(proved):
    """Against many more steps, in the metric at the age of the longest interval."""
    claim, sampling = next(claim for claim in proved.claims if claim.kind == "prediction"), proved.sampling
    h = sampling.oldest
    bound = h * (h / 4) ** 4 * np.sqrt(claim.square) / 5
    assert bound < proved.steady < 0.02 * proved.radius

    @jax.jit
    def error(x, u):
        ends = []
        for count in (4, 256):
            observer = pendulum(substeps=count)
            state = observer.predict(observer.init(x[:1])._replace(q=x[:1], v=x[1:]), u, jnp.asarray(h))
            ends.append(jnp.concatenate([state.q, state.v]))
        metric = proved.error_system.at(jnp.zeros(7).at[-1].set(h)).metric(jnp.zeros(()), ends[1])
        return jnp.sqrt((ends[0] - ends[1]) @ metric @ (ends[0] - ends[1]))

    rng = np.random.default_rng(6)
    worst = max(float(error(jnp.asarray(rng.uniform(-1, 1, 2) * [3.0, 4.0]), jnp.full(1, 0.5))) for _ in range(200))
    assert 1e-3 * bound < worst < bound


def described(**functions):
    """A model of the pendulum's inertia with other functions."""
    return Intrinsic(models.MechanicalSystem(swing().space, coordinates=("q",), **functions), 1.0, 1.0)


def coupled():
    space = models.pendulum_chain().space
    return models.MechanicalSystem(space, dissipation=lambda q, v: -v[::-1], coordinates=("a", "b"))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: described(force=lambda t, q, u: u * t), "force of this model depends on time"),
        (lambda: described(force=lambda t, q, u: u * jnp.cos(q)), "force of this model depends on q"),
        (lambda: described(dissipation=lambda q, v: -v * jnp.cos(q) ** 2), "depends on the position"),
        (lambda: described(dissipation=lambda t, q, v, u: -v * t), "depends on time"),
        (lambda: Intrinsic(coupled(), 1.0, 1.0), "couples coordinates"),
        (lambda: Intrinsic(models.GroupSystem(lie.SE3, jnp.eye(6)), 1.0, 1.0), "needs coordinates or rotations"),
        (lambda: Geodesic(swing(), 1.0, 1.0), "Intrinsic itself"),
    ],
)
def test_models_that_are_not_covered_are_refused(make, message):
    with pytest.raises((ValueError, TypeError), match=message):
        sampled_system(make(), Q, SHEARED)


@pytest.mark.exhaustive
@pytest.mark.parametrize(("lost", "rate", "least"), [(0, 4.0, 300_000), (1, 4.1, 800_000)])
def test_a_double_pendulum_with_dry_friction_is_proved_and_checked_at_500_hz(lost, rate, least, tmp_path, monkeypatch):
    """With many leaves, of which the checker spares most: it proves larger boxes."""
    recipe, boxes = models.recipe("examples/dfki_double_pendulum.toml"), []
    double = models.from_recipe(recipe)
    assert isinstance(double, models.MechanicalSystem)
    result = certify(
        Intrinsic(double, 60.0, 1800.0, substeps=4),
        **{"position": (-np.pi, np.pi), "velocity": 2.0, "error": 0.02, "input": 0.5, "interval": (0.0019, 0.0021)},
        **{"lost": lost, "rate": rate, "boxes": 2_000_000, "checker": "off", "recipe": recipe},
    )
    assert result.statement.verdict == "holds", result.statement
    enclose = TaylorEnclosure.__call__

    def counted(self, low, high):
        if low.shape == (len(low), len(result.domain.names)):  # of the claims, not of forces and friction
            boxes.append(len(low))
        return enclose(self, low, high)

    monkeypatch.setattr(TaylorEnclosure, "__call__", counted)
    checked = check(result.save(tmp_path / "double_pendulum.json"))
    assert checked.statement.proved
    assert checked.leaves > least
    assert 0 < sum(boxes) < checked.leaves / 4


@pytest.mark.exhaustive("options1-the certificate is about the numbers of the model as they are")
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rate": 1000.0}, r"samples 0\.004995 to 0\.05005 s apart, and at 1000 Hz they are 0\.001 s apart"),
        ({"rate": 100.0, "parameters": ["mass"]}, "the certificate is about the numbers of the model as they are"),
        ({"rate": 100.0, "alpha": 11.0}, r"alpha = 10, beta = 50; the observer has 11, 50"),
    ],
)
def test_an_export_at_another_rate_or_with_other_numbers_refuses_it(options, words, saved, tmp_path):
    model = tmp_path / "pendulum.toml"
    model.write_text('system = "pendulum_chain"\n[parameters]\nmass = [1.0]\nlength = [0.5]\n')
    file = forged(saved, tmp_path, put("recipe", models.recipe(str(model))))
    gains = {"alpha": 10.0, "beta": 50.0} | options
    with pytest.raises(ValueError, match=words):
        covariant.export(model, tmp_path / "c", certificate=file, **gains)
