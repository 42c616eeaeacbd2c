"""A verdict is computed from its hypotheses, and its text has all that the claim is about: what takes long."""

import json

import numpy as np
import pytest
from forging import forged, put
from test_statement import statement

import covariant
from covariant import certificates, models

EXPORT = {"rate": 200.0, "alpha": 4.0, "beta": 8.0, "observer": "intrinsic"}


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A certificate with every kind of bound, as a file, and the settings it was made from."""
    settings = {"velocity": [0.3, 0.25], "error": [0.01, 0.02], "input": 0.05, "alpha": 4.0, "beta": 8.0}
    settings |= {"noise": [1e-5, 2e-5], "disturbance": [1e-4, 2e-4]}
    settings["region"] = {"r": (-0.1, 0.1), "theta": (-0.2, 0.2)}
    result = covariant.certify("ball_and_beam", **settings)
    assert result.holds, str(result)
    path = tmp_path_factory.mktemp("saved") / "beam.json"
    result.save(path)
    return path, result, settings


@pytest.mark.exhaustive
def test_the_text_of_a_check_has_all_numbers_of_the_claim(saved):
    path, result, settings = saved
    text = str(covariant.verbs.check_certificate(path))
    numbers = [*settings["velocity"], *settings["error"], *settings["noise"], *settings["disturbance"], 4, 8, 0.05]
    numbers += [end for pair in settings["region"].values() for end in pair]
    for number in numbers:
        assert any(text.find(mark + f"{number:g}") >= 0 for mark in " [-"), number
    for name, value in models.ball_and_beam().parameters.items():
        assert f"{name} = {float(value.value)}" in text, name
    for hypothesis in result.certificate.statement.hypotheses:
        assert hypothesis.text in text


@pytest.mark.exhaustive
def test_the_claim_can_be_repeated_from_its_text_alone(saved):
    """The radius that is printed is proved again from the numbers that are printed, and never more than was proved."""
    path, result, _ = saved
    checked = certificates.check(path)
    about = dict(line.split(": ", 1) for line in checked.statement.about if ": " in line)
    assert about["model"].startswith("ball_and_beam, ")
    assert "alpha = 4 1/s, beta = 8 1/s²" in about["observer"]
    radius = float(next(line for line in checked.statement.about if "radius" in line).split("ε = ")[1].split()[0])
    assert 0 < radius <= result.certificate.radius < radius * 1.001
    q = np.array(json.loads(about["metric"].removeprefix("Q = ")))
    np.testing.assert_array_equal(q, result.certificate.q)
    again = covariant.certify("ball_and_beam", **saved[2], rate=result.certificate.rate, q=[q[0, 0], q[0, 1], q[1, 1]])
    assert again.certificate.radius >= radius


@pytest.mark.exhaustive
def test_it_is_the_same_in_print_and_in_json_and_in_the_file_of_an_export(saved, tmp_path):
    path, result, _ = saved
    checked = covariant.verbs.check_certificate(path)
    said = checked.summary["statement"]
    assert said["claim"] in str(checked)
    assert (said["verdict"], said["evidence"]) == ("holds", "proved")
    assert [each["text"] for each in said["hypotheses"]] == [h.text for h in result.certificate.statement.hypotheses]
    covariant.export("ball_and_beam", tmp_path / "beam", certificate=path, **EXPORT)
    sheet = next((tmp_path / "beam").glob("*.md")).read_text(encoding="utf-8")
    assert said["claim"] in sheet
    assert "gains are constant from the start" in " ".join(sheet.split())
    for line in said["about"]:
        assert line in sheet


@pytest.mark.exhaustive
def test_a_file_that_claims_more_is_not_copied_into_a_data_sheet(saved, tmp_path):
    path, *_ = saved
    file = forged(path, tmp_path, put("rate", lambda rate: 3 * rate))
    with pytest.raises(ValueError, match=r"forged\.json: "):
        covariant.export("ball_and_beam", tmp_path / "beam", certificate=file, **EXPORT)
    assert not (tmp_path / "beam").exists()
