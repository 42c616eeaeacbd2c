"""What takes long of `test_check.py`."""

import json
import math
import shutil

import jax.numpy as jnp
import numpy as np
import pytest
from balls import check_sample
from forging import put, together
from test_check import BOUNDS, OSCILLATOR, finely, forge, prove, saved

from covariant import models
from covariant.certificates import certify, check, parse
from covariant.certificates.checking import _check, _matrices
from covariant.certificates.checking._check import follows
from covariant.certificates.checking._checked import judged
from covariant.certificates.proving import _certify
from covariant.geometry import lie
from covariant.observers import Intrinsic


@pytest.fixture(scope="module")
def beam(tmp_path_factory):
    """A certificate of the ball and beam at a speed that needs the curvature."""
    bounds = {"velocity": 0.9, "error": 0.001, "position": (-0.01, 0.01), "input": 0.01, "rate": 0.3}
    found = prove({"system": "ball_and_beam", "parameters": {}}, math.sqrt(2), 0.5, **bounds)
    return found.save(tmp_path_factory.mktemp("beam") / "certificate.json")


@pytest.mark.exhaustive
def test_a_certificate_is_found_right_from_the_file_alone(saved, tmp_path):
    path = shutil.copy(saved, tmp_path / "sent.json")
    seen = []
    found = check(path, progress=lambda done, total: seen.append((done, total)))
    document = json.loads(saved.read_text(encoding="utf-8"))
    assert (found.rate, found.radius) == (document["rate"], document["radius"])
    assert found.leaves == sum(level.count(".") for claim in document["claims"] for level in claim["levels"])
    assert found.leaves > 3
    assert seen[-1][0] == seen[-1][1]


@pytest.mark.exhaustive
def test_processes_find_the_same(saved, monkeypatch):
    alone = check(saved)
    monkeypatch.setattr(_check, "SHARE", 100)
    assert check(saved, processes=2).leaves == alone.leaves


@pytest.mark.exhaustive
def test_a_small_certificate_starts_no_processes(saved, monkeypatch):
    """By the number of its leaves, so the same on every machine."""

    def started(*arguments, **options):
        raise RuntimeError("processes were started")

    monkeypatch.setattr(_check, "ProcessPoolExecutor", started)
    leaves = check(saved, processes=2).leaves
    assert 0 < leaves <= _check.SHARE
    monkeypatch.setattr(_check, "SHARE", leaves - 1)
    with pytest.raises(RuntimeError, match="started"):
        check(saved, processes=2)


def wheel():
    """A heavy wheel: rotations of the plane."""
    return models.GroupSystem(lie.SO2, np.eye(1), lambda g: g[0, 1])


@pytest.mark.exhaustive
def test_a_group_is_checked(tmp_path):
    recipe = {"attribute": f"{__name__}:wheel"}
    found = certify(Intrinsic(wheel(), 10.0, 50.0), velocity=0.5, error=0.1, input=0.1, recipe=recipe)
    path = found.save(tmp_path / "wheel.json")
    assert check(path, model=wheel).radius == found.radius > 0
    with pytest.raises(ValueError, match="the bound of the force is not shown"):
        check(forge(path, tmp_path, put("given.positions.high[0]", 2.0)), model=wheel())
    # The error may be half a turn on either side of its box alone.
    for side, value in (("low", -3.2), ("high", 3.2)):
        with pytest.raises(ValueError, match=r"must be below π, .* it is up to 3\.2 there"):
            check(forge(path, tmp_path, put(f"box.{side}[{len(found.domain.low) - 2}]", value)), model=wheel())


def leaf(k, letter):
    """Another letter in place of a leaf."""
    return put("claims[0].levels[-1]", lambda level: level[:k] + letter + level[k + 1 :])


LARGE = {
    "an open leaf": (leaf(5000, "?"), "radius must be 0 where a claim has open leaves"),
    "a side of the other sign": (put("box.high[2]", lambda v: -v), r"box"),
    "the rate of a claim that is wrong": (put("rate", 40.0), r"claims\[0\] is not shown to hold where"),
    "the other sign of the gain": (put("observer.alpha", 0.01), r"claims\[0\] is not shown to hold where"),
}
"""What is wrong in a file with thousands of leaves; trees that lack a box are in `tests/scalargraph`."""


@pytest.mark.parametrize("name", LARGE)
def test_a_large_file_that_is_tampered_with_is_refused_with_the_reason(saved, tmp_path, monkeypatch, name):
    change, reason = LARGE[name]
    monkeypatch.setattr(_check, "DEPTH", 2)
    with pytest.raises(ValueError, match=reason):
        check(forge(saved, tmp_path, together(finely(), change)))


@pytest.mark.parametrize("letters", ["abcd", "dbca", "aab"])
def test_jobs_cover_the_box_of_their_claim(saved, tmp_path, letters):
    document = parse(forge(saved, tmp_path, finely(letters)))
    jobs = [job for job in _check._jobs(document) if job.what == 0]
    assert 1 < len(jobs) <= _check.PARTS
    assert sum(job.leaves for job in jobs) == 2**14
    low, high = document.bounds(document.claims[0])
    volume = sum(((job.high - job.low) / (high - low)).prod(1).sum() for job in jobs)
    assert volume == pytest.approx(1.0, rel=1e-12)


@pytest.mark.exhaustive
def test_the_curvature_is_needed(beam, tmp_path):
    assert check(beam).leaves >= 5
    off = forge(beam, tmp_path, put("observer.curvature", False))
    with pytest.raises(ValueError, match=r"claims\[0\] is not shown to hold where"):
        check(off)


def test_balls_find_the_same(saved, tmp_path):
    leaves, total = check_sample(saved, 12, seed=4)
    assert leaves == min(12, total)
    made = forge(saved, tmp_path, put("rate", 6.0))
    with pytest.raises(ValueError, match=r"of claims\[0\] is not shown in balls"):
        check_sample(made, total)


def test_forces_may_leave_their_box_by_as_much_as_may_be_missing_there(saved):
    """On either side: which of the bounds is the larger one depends on the force."""
    statement = follows(parse(saved))
    document = statement.document
    turned = np.append(np.ones(len(document.low) - 1), -1.0)
    other = document._replace(low=np.minimum(document.low * turned, document.high * turned))
    other = other._replace(high=np.maximum(document.low * turned, document.high * turned))
    assert abs(document.low[-1]) != abs(document.high[-1])
    for each in (document, other):
        slack = _check._matrix(statement._replace(document=each), 0).slack
        assert (slack[:-1] == 0).all()
        assert slack[-1] >= _matrices.SLACK * max(abs(each.low[-1]), abs(each.high[-1]))


@pytest.fixture(scope="module")
def noisy(tmp_path_factory):
    """A certificate of the same system under noise and an unknown force, where its own force has a slope."""
    found = prove(OSCILLATOR, 4.0, 8.0, **BOUNDS, noise=1e-3, disturbance=2e-3)
    assert 0 < found.steady < found.radius
    return found.save(tmp_path_factory.mktemp("noisy") / "certificate.json")


@pytest.mark.exhaustive
def test_what_noise_adds_is_no_more_than_its_bounds_and_the_slope_say(noisy):
    given = parse(noisy).given
    true = [1e-3, 2e-3 + given.slopes[0, 0] * 1e-3]
    assert given.slopes[0, 0] > 0.5
    np.testing.assert_allclose(_certify.disturbance_sizes(given), true, rtol=1e-11)
    # The checker shows the slopes with a slack, and counts it.
    true[1] += given.slopes[0, 0] * 1e-3 * _matrices.SLACK
    np.testing.assert_allclose(_matrices.sizes(parse(noisy)), true, rtol=1e-11)


@pytest.mark.exhaustive
def test_a_radius_that_noise_alone_reaches_is_refused(noisy, tmp_path):
    """As a number it is the very distance at which noise keeps them, which may be off by its rounding."""
    document = parse(noisy)
    assert check(noisy).radius == document.radius
    square = next(claim.square for claim in document.claims if claim.kind == "disturbance")
    steady = 2 * math.sqrt(2 * square) / document.rate
    assert check(forge(noisy, tmp_path, put("radius", 1.001 * steady))).radius < document.radius
    with pytest.raises(ValueError, match=r"radius: noise alone leads .* away"):
        check(forge(noisy, tmp_path, put("radius", steady)))


def polar():
    """A free mass of 1 kg in the plane."""
    return models.Lagrangian(
        lambda q: jnp.diag(jnp.stack([jnp.ones(()), q[0] ** 2])),
        lambda q: jnp.zeros(()),
        coordinates=("r", "angle"),
        units=("m", "rad"),
    )


INNER, OUTER, WIDE, OFF = 0.9, 1.1, 0.9, 0.05
"""The true motions of the sector [m, m, rad], and the error of a position [m, rad]."""


def sector(checker="auto"):
    """A certificate on the sector."""
    recipe = {"attribute": f"{__name__}:polar"}
    bounds = np.array([INNER, -WIDE]), np.array([OUTER, WIDE])
    given = {"velocity": 0.1, "error": OFF, "position": bounds, "input": 0.01}
    return certify(Intrinsic(polar(), 4.0, 8.0), **given, recipe=recipe, checker=checker)


@pytest.fixture(scope="module")
def sectors():
    return sector()


@pytest.fixture(scope="module")
def saved_sectors(sectors, tmp_path_factory):
    return sectors.save(tmp_path_factory.mktemp("sectors") / "certificate.json")


def shortest_leaving(q):
    """The least length, in the metric of states, of a geodesic of the plane that leaves the region from a true motion.

    A curve of states is at least √(½(a − c²/b)) times as long as that of its positions, and may be as short.
    """
    rng = np.random.default_rng(2)
    r = np.concatenate([np.full(50_000, INNER), rng.uniform(INNER, OUTER, 50_000)])
    turned = rng.uniform(-WIDE, WIDE, 100_000)
    far = rng.uniform(INNER - OFF, OUTER + OFF, 100_000)  # an estimate within the region
    other = np.clip(turned + rng.uniform(-1, 1, 100_000) * rng.choice([0.05, 0.5, 2.0], 100_000), -WIDE, WIDE)
    a, b = r * np.exp(1j * turned), far * np.exp(1j * other)
    nearest = np.min([abs(a + s * (b - a)) for s in np.linspace(0, 1, 41)], axis=0)
    leaves = nearest < INNER - OFF
    assert leaves.sum() > 1000  # the region is not convex
    return math.sqrt((q[0, 0] - q[0, 1] ** 2 / q[1, 1]) / 2) * abs(b - a)[leaves].min()


@pytest.mark.exhaustive
def test_no_geodesic_as_long_as_the_radius_leaves_a_region_that_is_not_convex(sectors, saved_sectors):
    assert sectors.statement.verdict == "holds"
    assert sectors.radius < shortest_leaving(sectors.q)
    for claim in (claim for claim in sectors.claims if claim.kind == "reach"):
        assert sectors.radius * math.sqrt(claim.square) <= claim.limit
    assert check(saved_sectors, model=polar).radius == sectors.radius


@pytest.mark.exhaustive
def test_a_prover_that_forgets_the_border_would_be_seen(sectors, tmp_path, monkeypatch):
    honest = _certify.limits_of
    monkeypatch.setattr(_certify, "limits_of", lambda *given, **kw: 10 * honest(*given, **kw))
    caught = sector()
    assert (caught.statement.verdict, caught.radius) == ("undecided", 0.0)
    assert "which its box" in caught.statement.claim
    careless = sector(checker="off")
    assert careless.radius == pytest.approx(10 * sectors.radius)
    assert careless.radius > shortest_leaving(careless.q)
    with pytest.raises(ValueError, match="which its box"):
        check(careless.save(tmp_path / "careless.json"), model=polar)


@pytest.mark.exhaustive
def test_the_statement_says_how_far_the_checker_came(sectors, monkeypatch):
    assert "accepts all" in str(sectors.statement.hypotheses)
    assert "the checker" not in str(sector(checker="off").statement.hypotheses)
    monkeypatch.setattr(_certify, "judged", lambda resolved, seconds: judged(resolved, -1.0))  # no time at all
    slow = sector().statement
    (premise,) = (hypothesis for hypothesis in slow.hypotheses if "the checker" in hypothesis.text)
    assert slow.proved
    assert (premise.evidence, "it was stopped after" in premise.text) == ("assumed", True)
    with pytest.raises(ValueError, match="checker must be one of auto, all, off; got 'on'"):
        sector(checker="on")


@pytest.mark.exhaustive
def test_a_leaf_that_takes_long_does_not_keep_anybody_waiting():
    """Steep friction over a wide box is one leaf for the prover, and thousands of boxes for the checker.

    It depends on the position, so that it is no variable of its own beside the velocity.
    """

    def friction(q, v):
        return -v - 0.5 * (1 + 1e-3 * q) * jnp.tanh(v / 0.02)

    steep = models.Lagrangian(lambda q: jnp.eye(1), lambda q: 0 * q[0], None, friction, coordinates=("x",))
    bounds = {"velocity": 1.0, "error": 0.1, "position": (-1.0, 1.0), "input": 1.0, "rate": 2.0}
    found = certify(Intrinsic(steep, 10.0, 50.0), **bounds, q=[[0.164, -0.0129], [-0.0129, 0.00431]], boxes=3000)
    limit = max(_certify.PATIENCE, 3 * found.seconds)
    assert found.statement.proved
    assert "it was stopped after" in str(found.statement.hypotheses)
    assert found.checker_seconds < 3 * limit  # it hung for minutes


def test_what_the_checker_refuses_has_no_radius_in_its_text(monkeypatch):
    monkeypatch.setattr(
        _certify, "limits_of", lambda *given, honest=_certify.limits_of, **kw: 10 * honest(*given, **kw)
    )
    refused = sector().statement
    assert refused.verdict == "undecided"
    assert "ε" not in str(refused)


@pytest.mark.exhaustive
def test_reaches_that_no_sampled_point_had_are_found_by_their_counterexamples(sectors, monkeypatch):
    honest = _certify.sampled_widths
    monkeypatch.setattr(_certify, "sampled_widths", lambda about, domain: honest(about, domain) / 4)
    found = sector()
    assert found.statement.verdict == "holds"
    assert found.radius == pytest.approx(sectors.radius, rel=0.05)


@pytest.mark.exhaustive("nothing-1.000001", "square")
@pytest.mark.parametrize("more", [1 + 1e-6, 1.5, 100.0])
@pytest.mark.parametrize("mended", ["nothing", "limit", "square"])
def test_a_radius_beyond_what_is_proved_to_be_reached_is_refused(sectors, saved_sectors, tmp_path, more, mended):
    def longer(document):
        document["radius"] *= more
        for claim in (claim for claim in document["claims"] if claim["kind"] == "reach"):
            claim["limit"] *= more if mended == "limit" else 1
            claim["square"] /= more**2 if mended == "square" else 1

    made = forge(saved_sectors, tmp_path, longer)
    if mended == "square" and more < 1.01:  # there is as much room between what is claimed of a reach and what is true
        assert check(made, model=polar).radius > sectors.radius
        return
    with pytest.raises(ValueError, match=r"may reach|which its box|of room|is not shown to hold"):
        check(made, model=polar)
