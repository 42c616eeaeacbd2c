"""`covariant certify`: what it proves, prints and writes, and what it refuses: what takes long."""

import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import command, leave, refused
from test_certify_command import GAINS, ONE, certificate, folder, inside, proved

from covariant import certificates, models, verbs
from covariant.certificates.base import StartClaim
from covariant.certificates.checking import _check
from covariant.observers import Intrinsic
from covariant.verbs._certify import CertifyResult
from scalargraph import proofs
from scalargraph.proofs import digest


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


@pytest.mark.exhaustive
def test_the_file_is_the_certificate(proved):
    document = json.loads(Path("proved.json").read_text(encoding="utf-8"))
    assert (document["rate"], document["radius"]) == (proved["rate"], proved["radius"])
    assert not {"verdict", "statement", "counterexample"} & document.keys()
    made = models.from_recipe(document["recipe"])
    assert dict(made.parameters) == dict(models.load("pendulum.toml").model.parameters)


def test_for_a_person_angles_are_in_degrees_too(certificate):
    found, proved = certificate
    assert str(CertifyResult("", found, "")).startswith("PROVED: any estimate that starts within ")
    found = found._replace(claims=tuple(claim for claim in found.claims if not isinstance(claim, StartClaim)))
    text = str(CertifyResult("pendulum.toml", found, "Given gains."))
    # The first line says what it means in degrees, from the tube's half widths alone, which are no set of starts.
    verdict, _, text = text.partition("\n\n")
    assert verdict.startswith("PROVED: any estimate in the tube stays in it, so within ")
    assert "°/s of the truth, and its distance in the metric halves every " in verdict
    assert text.startswith(f"holds (proved): {proved['statement']}\n")
    assert "\nhypotheses:\n- " in text
    assert "\n- proved: " in text
    assert "\n\nGiven gains.\n" in text
    assert f"ε = {proved['radius']:.4g}" in text
    assert "-1.1 ≤ estimate of q1 ≤ 1.1 rad (-63.03 to 63.03°)" in text
    assert f"({math.degrees(proved['half_widths'][0]):.4g}°)" in text
    assert re.fullmatch(rf"{found.boxes} boxes, \d+\.\d s; checker \d+\.\d s", text.splitlines()[-1])


@pytest.mark.exhaustive
def test_a_saved_certificate_is_verified_and_an_altered_one_refused(proved, folder):
    saved = folder / "checked.json"
    shutil.copy(folder / "proved.json", saved)
    found = command("certify", "--check", str(saved), *ONE)
    assert (found["verified"], found["model_given"], found["model"]) == (True, False, None)
    assert found["leaves"] > 0
    assert found["assumed"] == list(certificates.ASSUMED)
    saved.write_text(saved.read_text().replace('"radius": 0.', '"radius": 1.'))
    ended = leave("certify", "--check", saved, *ONE)
    assert ended.code == 1
    assert "was changed" in ended.out
    for arguments, message in (
        (("--check", "nowhere.json"), "nowhere.json does not exist"),
        ((), "give a model to certify, or --check FILE"),
        (("pendulum.toml", "--model", "mine:model"), "--model goes with --check"),
    ):
        refused("certify", *arguments, named=[message])


MINE = """
from covariant import models

def pendulum(mass, length):
    return models.pendulum_chain(mass, length)
"""


@pytest.mark.exhaustive
@pytest.mark.parametrize("processes", ["1", "2"])
def test_a_model_of_ones_own_is_given_by_who_checks(processes, proved, folder, monkeypatch):
    monkeypatch.setattr(_check, "SHARE", 1)
    (folder / "mine.py").write_text(MINE)
    document = json.loads((folder / "proved.json").read_text())
    document["recipe"] = {"attribute": "mine:pendulum", "parameters": {"mass": [1.0], "length": [0.5]}}
    saved = folder / "mine.json"
    saved.write_text(json.dumps(document | {"digest": digest(document)}))
    code, refusal, _ = leave("certify", "--check", saved)
    assert (code, refusal.count("\n")) == (1, 1)
    assert "'mine:pendulum', code that a recipe does not run" in refusal
    code, out, _ = leave("certify", "--check", saved, "--model", "mine:pendulum", "--processes", processes)
    assert code == 0
    lines = out.splitlines()
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


def test_a_force_that_depends_on_time_is_proved_between_two_times(monkeypatch, folder):
    (folder / "tidal.py").write_text(TIDE)
    monkeypatch.syspath_prepend(str(folder))
    arguments = ("certify", "tidal:tide", *GAINS, "--region", "x=-1:1", "--velocity", "1", "--error", "0.1", *ONE)
    refused(*arguments, named=["depends on time; give times"])
    refused(*arguments, "--times", "2,1", named=["times must be two finite numbers, the lower one first"])
    ended = leave(*arguments, "--times", "0,1.5")
    assert (ended.code, "proved" in ended.out) == (0, True)
