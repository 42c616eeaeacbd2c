"""`covariant.fit`: a fit to a simulated log gives the truth back, whichever way its inputs go between stamps."""

from typing import Any

import pytest

from covariant.verbs import fit, simulate
from covariant.verbs._fit import FitResult
from covariant.verbs._simulate import SimulateResult
from covariant.verbs.base.inputs import Job
from covariant.verbs.base.model_output import read_sources, write_models

TRUTH = {"parameters.mass": [1.0], "parameters.length": [0.5], "parameters.viscous": [0.001]}
FIRST = {**TRUTH, "parameters.viscous": [0.01], "parameters.length": [0.45]}
DRIVEN: dict[str, Any] = {"duration": 20.0, "rate": 100.0, "q0": 0.4, "amplitude": 0.5, "noise": 2e-4, "seed": 3}


def driven(between: str) -> SimulateResult:
    return simulate("pendulum_chain", **DRIVEN, overrides=TRUTH | {"inputs.between": between})


@pytest.fixture(scope="module", params=["held", "linear"])
def fitted(request) -> tuple[str, FitResult]:
    """A fit to the log of a driven pendulum by a model file that does not say how its inputs go between stamps."""
    log = driven(between=request.param)
    return request.param, fit("pendulum_chain", log.to_pandas(), ["viscous", "length"], overrides=FIRST)


def test_a_fit_that_predicts_worse_says_both_errors_and_writes_nothing(tmp_path):
    errors = {"before": {"position": [0.1]}, "after": {"position": [0.2]}}
    facts = {"held_out": "the last third of a.csv", "horizon": 0.5, "held_out_errors": errors}
    rows = {"coordinates": ["angle"], "units": ["rad"], "parameters": [], "undetermined": [], "better": False}
    result = FitResult([], {}, facts | rows)
    (sentence,) = result.warnings
    assert "the last third of a.csv, which it has not seen, worse than before" in sentence
    assert "angle 0.2 rad after 0.1 before" in sentence
    assert "covariant check" in sentence
    with pytest.raises(ValueError, match=r"fitted\.toml: The fitted model predicts .* angle 0.2 rad after 0.1 before"):
        result.save(tmp_path / "fitted.toml")
    assert (result.exit_code, list(tmp_path.iterdir())) == (1, [])


def test_an_edit_of_the_model_file_meanwhile_is_neither_mixed_in_nor_replaced(tmp_path):
    path = tmp_path / "spring.toml"
    text = 'system = "oscillator"  # mine\n\n[parameters]\nstiffness = 1.0\n'
    path.write_text(text)
    row = {"name": "stiffness", "before": 1.0, "after": 1.3, "standard_error": 0.01, "determined": True}
    details = {"parameters": [row], "undetermined": [], "better": True, "fitted_to": "log.csv"}
    content = {"system": "oscillator", "parameters": {"stiffness": 1.3}}
    result = FitResult([Job(path, None)], content, details, read_sources(path))
    edited = text.replace("# mine", "# edited\n[measurement]\nstd = 5.0\n").replace("[parameters]", "[parameters] ")
    path.write_text(edited)
    with pytest.raises(ValueError, match=r"spring.toml: it was changed after it was read"):
        result.save(path, overwrite=True)
    assert path.read_text() == edited
    assert result.save(tmp_path / "beside.toml").read_text().endswith(text.replace("1.0", "1.3"))
    path.write_text(text)
    assert "stiffness = 1.3" in result.save(path, overwrite=True).read_text()


def test_line_ends_of_windows_are_read_as_at_first(tmp_path):
    path = tmp_path / "spring.toml"
    path.write_bytes(b'system = "oscillator"  # mine\r\n\r\n[parameters]\r\nstiffness = 1.0\r\n')
    content = {"system": "oscillator", "parameters": {"stiffness": 1.3}, "measurement": {"std": 1e-3}}
    write_models(path, {tmp_path / "out.toml": ("# head\n", content)}, False, read_sources(path))
    assert (tmp_path / "out.toml").read_bytes() == (
        b'# head\nsystem = "oscillator"  # mine\n\n[parameters]\nstiffness = 1.3\n\n[measurement]\nstd = 0.001\n'
    )
