"""`covariant certify`: what it proves, prints and writes, and what it refuses."""

import json
import math
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import command

from covariant import certificates, models, proofs, workflow
from covariant.certificates.checking import _check
from covariant.cli import main
from covariant.observers import Intrinsic
from covariant.proofs import digest

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

QUIET = certificates.Given(*np.zeros((2, 2, 1)), np.zeros(2), *np.zeros((2, 1)), np.zeros((1, 1)))
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
def proved(folder):
    """What the command prints of a pendulum, whose certificate is in proved.json."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return command("certify", "pendulum.toml", *GAINS, *REGION, *ONE, "--out", "proved.json")


def leave(capsys, monkeypatch, *arguments: str) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a command."""
    monkeypatch.setattr(sys, "argv", ["covariant", "certify", *arguments])
    with pytest.raises(SystemExit) as left:
        main()
    return (int(left.value.code or 0), *capsys.readouterr())


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
        claims = (certificates.CLAIMS["contraction"](proof),)
        return certificates.ContractionCertificate(
            statement, 1.0, 0.0, observer, q, about, domain, np.ones(1), QUIET, claims, None
        )

    return stand_in, asked


@pytest.mark.exhaustive
def test_a_proof_says_how_fast_from_how_far_and_where(proved):
    assert (proved["verdict"], proved["evidence"], proved["observer"]) == ("holds", "proved", "Intrinsic")
    assert (proved["alpha"], proved["beta"], proved["velocity"]) == (10.0, 50.0, [2.0])
    assert proved["decay"] == proved["rate"] / 2 > 0
    assert proved["radius"] > 0
    assert proved["domain"]["q1"] == [-1.1, 1.1]
    assert proved["domain"]["e_q1"] == [-0.1, 0.1]
    assert 0 < proved["half_widths"][0] <= 0.1
    assert (proved["open"], proved["open_share"], proved["counterexample"]) == (0, {}, None)
    assert (proved["model"], proved["out"]) == ("pendulum.toml", "proved.json")


@pytest.mark.long
def test_the_file_is_the_certificate(proved):
    document = json.loads(Path("proved.json").read_text(encoding="utf-8"))
    assert (document["rate"], document["radius"]) == (proved["rate"], proved["radius"])
    assert not {"verdict", "statement", "counterexample"} & document.keys()
    made = models.from_recipe(document["recipe"])
    assert dict(made.parameters) == dict(models.load("pendulum.toml").model.parameters)


@pytest.mark.long
def test_for_a_person_angles_are_in_degrees_too(proved, monkeypatch):
    q = np.array(proved["q"])
    observer = Intrinsic(models.load("pendulum.toml").model, 10.0, 50.0)
    about = certificates.error_system(observer, q)
    low, high = np.array(list(proved["domain"].values())).T
    domain = proofs.Box(about.names, about.units, low, high)
    whole = proofs.Proof("holds", domain, [np.array([-1])], None, np.zeros((0, 2, 4)), 1, 0.1)
    squares = (np.array(proved["half_widths"]) / proved["radius"]) ** 2
    found = certificates.ContractionCertificate(
        certificates.Statement(
            proved["statement"], (), (certificates.Hypothesis("they shrink", "proved"),), proved["rate"]
        ),
        proved["rate"],
        proved["radius"],
        observer,
        q,
        about,
        domain,
        np.array([2.0]),
        QUIET,
        (
            certificates.CLAIMS["contraction"](whole),
            *(certificates.CLAIMS["reach"](whole, row, square, 0.1) for row, square in enumerate(squares)),
        ),
        None,
    )
    text = str(workflow.CertifyResult("pendulum.toml", found, "Given gains."))
    # The first line says what it means in degrees, from the tube's half widths alone, which are no set of starts.
    verdict, _, text = text.partition("\n\n")
    assert verdict.startswith("PROVED: any estimate in the tube stays in it, so within ")
    assert "°/s of the truth, and its distance in the metric halves every " in verdict
    assert text.startswith(
        f"holds (proved): {proved['statement']}\nhypotheses:\n- proved: they shrink\n\nGiven gains.\n"
    )
    assert f"ε = {proved['radius']:.4g}" in text
    assert "-1.1 ≤ estimate of q1 ≤ 1.1 rad (-63.03 to 63.03°)" in text
    assert f"({math.degrees(proved['half_widths'][0]):.4g}°)" in text
    assert re.fullmatch(rf"{found.boxes} boxes, \d+\.\d s; checker 0\.0 s", text.splitlines()[-1])


def test_undecided_names_what_remains_and_leaves_with_1(capsys, monkeypatch):
    stand_in, asked = unproved("undecided")
    monkeypatch.setattr(certificates, "certify", stand_in)
    more = ("--q", "3,-1,2", "--rate", "0.5", "--seconds", "7", "--processes", "2")
    code, out, _ = leave(capsys, monkeypatch, "pendulum.toml", *GAINS, *REGION, *more)
    assert code == 1
    assert out.startswith("undecided: squared lengths shrink\n")
    assert "contraction: 1 boxes remain, 25.00% of the domain" in out
    np.testing.assert_array_equal(asked["q"], [[3.0, -1.0], [-1.0, 2.0]])
    assert (asked["rate"], asked["seconds"], asked["processes"]) == (0.5, 7.0, 2)
    np.testing.assert_array_equal(asked["input"], [0.5])
    assert asked["recipe"] == models.recipe("pendulum.toml")


def test_wrong_names_the_point_and_leaves_with_1(capsys, monkeypatch):
    monkeypatch.setattr(certificates, "certify", unproved("fails")[0])
    code, out, _ = leave(capsys, monkeypatch, "pendulum.toml", *GAINS, *REGION)
    assert code == 1
    assert "it is wrong at\n  q1 = 0.5 rad (28.65°)\n  v_q1 = 0.5 rad/s (28.65°/s)\n" in out
    code, out, _ = leave(capsys, monkeypatch, "pendulum.toml", *GAINS, *REGION, "--json")
    assert (code, json.loads(out)["counterexample"]["v_q1"]) == (1, 0.5)


def test_a_statement_that_is_wrong_is_not_written(capsys, monkeypatch):
    monkeypatch.setattr(certificates, "certify", unproved("fails")[0])
    code, out, _ = leave(capsys, monkeypatch, "pendulum.toml", *GAINS, *REGION, "--out", "wrong.json")
    assert (code, Path("wrong.json").exists()) == (1, False)
    assert out.endswith("no certificate is written of a statement that is wrong\n")


def test_gains_are_designed_from_the_data_sheet(capsys, monkeypatch):
    stand_in, asked = unproved("undecided")
    monkeypatch.setattr(certificates, "certify", stand_in)
    _, out, _ = leave(capsys, monkeypatch, "sheet.toml", *REGION, "--sampling", "500", "--observer", "geodesic")
    assert type(asked["observer"]).__name__ == "Geodesic"
    assert f"Designed alpha = {asked['observer'].alpha:.4g} 1/s" in out


REFUSED = {
    "no velocity": (("pendulum.toml", *GAINS, "--box", "q1=-1:1", "--error", "0.1"), ["velocity", "no certificate"]),
    "no error": (("pendulum.toml", *GAINS, "--box", "q1=-1:1", "--velocity", "2"), ["error"]),
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


@pytest.mark.parametrize("case", REFUSED)
def test_bad_input_gives_one_line_and_writes_nothing(case, capsys, monkeypatch):
    arguments, words = REFUSED[case]
    before = sorted(Path().iterdir())
    code, out, error = leave(capsys, monkeypatch, *arguments)
    assert (code, out) == (2, "")
    assert error.startswith("covariant: ")
    assert error.count("\n") == 1
    for word in words:
        assert word in error
    assert sorted(Path().iterdir()) == before


def leaves_with(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["covariant", *arguments])
    with pytest.raises(SystemExit) as left:
        main()
    return left.value.code or 0


@pytest.mark.exhaustive
def test_a_saved_certificate_is_verified_and_an_altered_one_refused(proved, folder, capsys, monkeypatch):
    saved = folder / "checked.json"
    shutil.copy(folder / "proved.json", saved)
    found = command("certify", "--check", str(saved), *ONE)
    assert (found["verified"], found["model_given"], found["model"]) == (True, False, None)
    assert found["leaves"] > 0
    assert found["assumed"] == list(certificates.ASSUMED)
    saved.write_text(saved.read_text().replace('"radius": 0.', '"radius": 1.'))
    assert leaves_with(monkeypatch, "certify", "--check", str(saved), *ONE) == 1
    assert "was changed" in capsys.readouterr().out
    assert leaves_with(monkeypatch, "certify", "--check", "nowhere.json") == 2
    assert "nowhere.json does not exist" in capsys.readouterr().err
    assert leaves_with(monkeypatch, "certify") == 2
    assert "give a model to certify, or --check FILE" in capsys.readouterr().err
    assert leaves_with(monkeypatch, "certify", "pendulum.toml", "--model", "mine:model") == 2
    assert "--model goes with --check" in capsys.readouterr().err


MINE = """
from covariant import models

def pendulum(mass, length):
    return models.pendulum_chain(mass, length)
"""


@pytest.mark.exhaustive("2")
@pytest.mark.long
@pytest.mark.parametrize("processes", ["1", "2"])
def test_a_model_of_ones_own_is_given_by_who_checks(processes, proved, folder, capsys, monkeypatch):
    monkeypatch.setattr(_check, "SHARE", 1)
    (folder / "mine.py").write_text(MINE)
    document = json.loads((folder / "proved.json").read_text())
    document["recipe"] = {"attribute": "mine:pendulum", "parameters": {"mass": [1.0], "length": [0.5]}}
    saved = folder / "mine.json"
    saved.write_text(json.dumps(document | {"digest": digest(document)}))
    assert leaves_with(monkeypatch, "certify", "--check", str(saved)) == 1
    refusal = capsys.readouterr().out
    assert refusal.count("\n") == 1
    assert "'mine:pendulum', code that a recipe does not run" in refusal
    arguments = ("certify", "--check", str(saved), "--model", "mine:pendulum", "--processes", processes)
    assert leaves_with(monkeypatch, *arguments) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("Verified: ")
    assert lines[1].startswith("The model is mine:pendulum, given by the person who checks")
    assert lines[2].startswith("holds (proved): estimates within ")
    assert lines[-len(certificates.ASSUMED) :] == [f"- assumed: {line}" for line in certificates.ASSUMED]


TIDE = """
import jax.numpy as jnp
from covariant import models

tide = models.Lagrangian(
    lambda q: jnp.eye(1), lambda q: 0.0, force=lambda t, q, u: u + jnp.sin(t), coordinates=("x",)
)
"""


@pytest.mark.long
def test_a_force_that_depends_on_time_is_proved_between_two_times(capsys, monkeypatch, folder):
    (folder / "tidal.py").write_text(TIDE)
    monkeypatch.syspath_prepend(str(folder))
    arguments = ("tidal:tide", *GAINS, "--region", "x=-1:1", "--velocity", "1", "--error", "0.1", *ONE)
    code, _, message = leave(capsys, monkeypatch, *arguments)
    assert code == 2
    assert "depends on time; give times" in message
    code, out, _ = leave(capsys, monkeypatch, *arguments, "--times", "0,1.5")
    assert (code, "proved" in out) == (0, True)
    code, _, message = leave(capsys, monkeypatch, *arguments, "--times", "2,1")
    assert code == 2
    assert "the earlier one first" in message
