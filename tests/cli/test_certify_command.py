"""`covariant certify`: what it proves, prints and writes, and what it refuses."""

import json
from pathlib import Path

import numpy as np
import pytest
from commands import command, leave, refused

import covariant
from covariant import certificates, models
from covariant.certificates.base import CLAIMS, Given
from scalargraph import proofs

PENDULUM = """
system = "pendulum_chain"
[parameters]
mass = [1.0]
length = [0.5]
"""
SHEET = "[measurement]\nstd = 1e-3\n[uncertainty]\nacceleration = 1.0\n"
GAINS = ("--alpha", "10", "--beta", "50")
REGION = ("--box", "q1=-1:1", "--velocity", "2", "--error", "0.1", "--input", "0.5")
ONE = ("--processes", "1")

QUIET = Given(*np.zeros((2, 2, 1)), np.zeros(2), *np.zeros((2, 1)), np.zeros((1, 1)))
"""No noise."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("certify")
    (folder / "pendulum.toml").write_text(PENDULUM)
    (folder / "sheet.toml").write_text(PENDULUM + SHEET)
    return folder


@pytest.fixture(autouse=True)
def inside(folder, monkeypatch):
    monkeypatch.chdir(folder)


@pytest.fixture(scope="module")
def certificate(folder):
    """The certificate of a pendulum, in proved.json too, and what the command prints of it."""
    found, certify = [], certificates.certify
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(
            certificates, "certify", lambda *given, **named: found.append(certify(*given, **named)) or found[0]
        )
        printed = command("certify", "pendulum.toml", *GAINS, *REGION, *ONE, "--out", "proved.json")
    return found[0], printed


@pytest.fixture(scope="module")
def proved(certificate):
    return certificate[1]


def unproved(verdict: str):
    """A stand-in for `certify` that says so at once, with a quarter of the domain open, and is told what was asked."""
    asked = {}

    def stand_in(observer, **settings):
        asked.update(settings, observer=observer)
        q = certificates.optimal_lyapunov(observer.alpha, observer.beta, 1.0)
        about = certificates.error_system(observer, q)
        domain = proofs.Box(about.names, about.units, -np.ones(4), np.ones(4))
        levels = [np.array([0]), np.array([1, -1]), np.array([-2, -1])]
        wrong = np.full((2, 4), 0.5) if verdict == "fails" else None
        proof = proofs.Proof(verdict, domain, levels, wrong, np.zeros((1, 2, 4)), 5, 0.1)
        premises = (certificates.Hypothesis("they shrink everywhere", "proved", verdict),)
        statement = certificates.Statement("squared lengths shrink", (), premises, 1.0, str(domain))
        claims = (CLAIMS["contraction"](proof),)
        return certificates.ContractionCertificate(
            statement, 1.0, 0.0, observer, q, about, domain, np.ones(1), QUIET, claims, None
        )

    return stand_in, asked


def test_undecided_names_what_remains_and_leaves_with_1(monkeypatch):
    stand_in, asked = unproved("undecided")
    monkeypatch.setattr(certificates, "certify", stand_in)
    more = ("--q", "3,-1,2", "--rate", "0.5", "--seconds", "7", "--processes", "2")
    code, out, _ = leave("certify", "pendulum.toml", *GAINS, *REGION, *more)
    assert code == 1
    assert out.startswith("undecided: squared lengths shrink\n")
    assert "contraction: 1 boxes remain, 25.00% of the domain" in out
    np.testing.assert_array_equal(asked["q"], [[3.0, -1.0], [-1.0, 2.0]])
    assert (asked["rate"], asked["seconds"], asked["processes"]) == (0.5, 7.0, 2)
    np.testing.assert_array_equal(asked["input"], [0.5])
    assert asked["recipe"] == models.recipe("pendulum.toml")


def test_wrong_names_the_point_and_leaves_with_1(monkeypatch):
    monkeypatch.setattr(certificates, "certify", unproved("fails")[0])
    code, out, _ = leave("certify", "pendulum.toml", *GAINS, *REGION)
    assert code == 1
    assert "it is wrong at\n  q1 = 0.5 rad (28.65°)\n  v_q1 = 0.5 rad/s (28.65°/s)\n" in out
    code, out, _ = leave("certify", "pendulum.toml", *GAINS, *REGION, "--json")
    assert (code, json.loads(out)["counterexample"]["v_q1"]) == (1, 0.5)


def test_a_statement_that_is_wrong_is_not_written(monkeypatch):
    monkeypatch.setattr(certificates, "certify", unproved("fails")[0])
    code, out, _ = leave("certify", "pendulum.toml", *GAINS, *REGION, "--out", "wrong.json")
    assert (code, Path("wrong.json").exists()) == (1, False)
    assert out.endswith("no certificate is written of a statement that is wrong\n")


def test_gains_are_designed_from_the_data_sheet(monkeypatch):
    stand_in, asked = unproved("undecided")
    monkeypatch.setattr(certificates, "certify", stand_in)
    _, out, _ = leave("certify", "sheet.toml", *REGION, "--sampling", "500", "--observer", "geodesic")
    assert type(asked["observer"]).__name__ == "Geodesic"
    assert f"Designed alpha = {asked['observer'].alpha:.4g} 1/s" in out


REFUSED = {
    "no velocity": (("pendulum.toml", *GAINS, "--box", "q1=-1:1", "--error", "0.1"), ["velocity", "no certificate"]),
    "no error": (
        ("pendulum.toml", *GAINS, "--box", "q1=-1:1", "--velocity", "2", "--observer", "intrinsic"),
        ["error"],
    ),
    "negative error": (("pendulum.toml", *GAINS, *REGION, "--error", "-0.1"), ["error", "positive", "-0.1"]),
    "too many": (("pendulum.toml", *GAINS, *REGION, "--velocity", "1,2"), ["velocity", "dq1/dt", "1, 2"]),
    "unknown coordinate": (("pendulum.toml", *GAINS, *REGION, "--box", "x=0:1"), ["region", "'x'", "q1"]),
    "missing box": (("pendulum.toml", *GAINS, "--velocity", "2", "--error", "1"), ["region lacks q1", "q1=LOW:HIGH"]),
    "box the wrong way round": (("pendulum.toml", *GAINS, *REGION, "--box", "q1=1:-1"), ["region", "below"]),
    "negative input": (("pendulum.toml", *GAINS, *REGION, "--input", "-1"), ["input", "negative"]),
    "indefinite Q": (("pendulum.toml", *GAINS, *REGION, "--q", "1,2,1"), ["q", "positive definite"]),
    "rate zero": (("pendulum.toml", *GAINS, *REGION, "--rate", "0"), ["rate", "positive"]),
    "one gain": (("pendulum.toml", "--alpha", "1", *REGION), ["--alpha and --beta"]),
    "no data sheet": (("pendulum.toml", *REGION), ["gains need measurement.std", "--alpha and --beta"]),
    "no sampling rate": (("sheet.toml", *REGION), ["sampling"]),
    "unknown observer": (("pendulum.toml", *GAINS, *REGION, "--observer", "ekf"), ["'ekf'", "geodesic"]),
    "state space": (("lorenz", *GAINS, *REGION), ["lorenz", "state-space"]),
    "out of another kind": (("pendulum.toml", *GAINS, *REGION, "--out", "proof.csv"), ["proof.csv", ".json"]),
    "out in no folder": (("pendulum.toml", *GAINS, *REGION, "--out", "no/proof.json"), ["no/proof.json", "no folder"]),
    "figure of no kind": (("pendulum.toml", *GAINS, *REGION, "--figure", "proof"), ["proof", ".png"]),
}


@pytest.mark.core(6)
@pytest.mark.parametrize("case", REFUSED)
def test_bad_input_gives_one_line_and_writes_nothing(case):
    arguments, named = REFUSED[case]
    refused("certify", *arguments, named=named)


def test_what_runs_otherwise_is_told(tmp_path):
    path = tmp_path / "beam.toml"
    path.write_text(f'system = "ball_and_beam"\n{SHEET}external_force_std = 0.1\nexternal_force_time = 1.0\n')
    bounds = {"velocity": 0.2, "error": 0.02, "region": {"r": (-0.2, 0.2), "theta": (-0.2, 0.2)}}
    told = str(covariant.certify(path, alpha=10.0, beta=50.0, boxes=100, checker="off", **bounds))
    assert "run intrinsic-force unless they are asked for `observer='intrinsic'`" in told


def test_without_a_bound_of_errors_the_statement_is_about_all_of_them(tmp_path):
    """And its file is checked by the same option as others."""
    path = tmp_path / "arm.json"
    ended = leave("certify", "pendulum_chain", "--velocity", "1", "--sampling", "500", "--out", str(path))
    assert ended.code == 0
    assert ended.out.startswith("holds (proved): from every first error of positions and velocities")
    assert "samples 0.002 s apart" in ended.out
    assert leave("certify", "--check", str(path)).code == 0
    for name, value in {"times": (0.0, 1.0), "q": (1.0, 0.0, 1.0), "find": "rate", "checker": "all"}.items():
        with pytest.raises(ValueError, match=f"has no {name}; leave it out"):
            covariant.certify("pendulum_chain", velocity=1.0, **{name: value})
    with pytest.raises(ValueError, match="jerk is for certificates of measured-coefficients"):
        covariant.certify("pendulum_chain", velocity=1.0, error=0.1, jerk=1.0)


def test_the_price_in_noise_is_told_beside_that_of_other_observers():
    """At ω above and below that of the gain rule; alone, a noise of 1e-4 is √(hω³/2c) times that of the velocity."""
    asked = ("certify", "pendulum_chain", "--velocity", "1", "--sampling", "500", "--noise", "1e-4", "--json")
    slow, fast = (command(*asked, "--set", f"uncertainty.acceleration={a}") for a in (1e-6, 1.0))
    errors = slow["velocity_std"]
    expected = 1e-4 * np.sqrt(0.002 * np.array(slow["omega"]) ** 3 / (2 * 1.92**0.5))
    np.testing.assert_allclose(errors["measured-coefficients"], expected, rtol=0.02)
    assert max(errors["intrinsic"]) < 0.01 * min(errors["measured-coefficients"])
    # The rule has ω = √(a/σ) for accelerations a that are independent in every sample.
    assert "ω = 0.1 1/s" in slow["note"]
    assert f"accelerations of {1e-4 * max(slow['omega']) ** 2:.3g}, not of 1e-06" in slow["note"]
    assert "the same ω, more than a proof needs: it is free" in fast["note"]
    np.testing.assert_allclose(fast["omega"], 100.0)
    np.testing.assert_allclose(
        *(fast["velocity_std"][name] for name in ("intrinsic", "measured-coefficients")), rtol=0.02
    )
    given = command(*asked, "--set", "uncertainty.acceleration=1", "--alpha", "40", "--beta", "900")
    assert "alpha = 141.4 and beta = 1e+04: prove these" in given["note"]
    assert command(*asked)["velocity_std"] == {}
