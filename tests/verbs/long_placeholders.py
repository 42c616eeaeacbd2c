"""Numbers of a draft that nobody has replaced are named; those that somebody has are not: what takes long."""

import pytest
from test_placeholders import draft

import covariant
from covariant import verbs
from covariant.verbs.base.model_text import advice
from covariant.verbs.base.placeholders import placeholders


@pytest.mark.exhaustive
def test_what_a_fit_determines_is_no_placeholder_any_more(tmp_path):
    truth = {key: [value] for key, value in (("mass", 1.0), ("length", 0.3), ("com", 0.2), ("inertia", 0.01))}
    overrides = {f"parameters.{key}": value for key, value in truth.items()}
    swing = covariant.simulate("pendulum_chain", duration=10.0, rate=50.0, q0=0.7, noise=1e-4, overrides=overrides)
    log = swing.to_pandas()
    log = log[["t", "q1"]].rename(columns={"q1": "angle_rad"})
    path = verbs.init(log).save(tmp_path / "draft.toml")
    frictionless = {"parameters.viscous": [0.0], "parameters.coulomb": [0.0]}
    result = covariant.fit(path, log, "com", overrides=frictionless, anyway=True)
    assert list(result.summary["placeholders"]) == ["mass[0]", "inertia[0]"]
    assert "# Still placeholders of the draft: mass[0] = 1" in result.save(tmp_path / "fitted.toml").read_text()


@pytest.mark.parametrize(
    ("head", "advised"),
    [
        ("", "fit it, tune it, check it"),
        ("# Fitted by covariant fit to log.csv; ± is one standard error:\n", "tune it, check it"),
        ("# Tuned by covariant tune to log.csv.\n# Fitted by covariant fit to log.csv; …\n", "check it"),
    ],
)
def test_nobody_is_advised_to_do_what_the_model_file_was_just_written_by(tmp_path, head, advised):
    path = tmp_path / "arm.toml"
    path.write_text(f'{head}system = "pendulum_chain"\n', encoding="utf-8")
    assert advice(path, fit="fit it", tune="tune it", check="check it") == advised
    assert advice("pendulum_chain", fit="fit it") == "fit it"
