"""Every engine with every output on every kind of model: the same numbers, whichever computes and however they are
written.

One short log for each kind; the commands run in this process.
"""

import base64
import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from commands import command, unpacked

from covariant import logs

EXAMPLES = Path(__file__).parents[2] / "examples"
ENGINES = ("c", "jax")

CLOCKED = ("microseconds", "µs a sample")
"""What the clock says differs from run to run."""


class Kind(NamedTuple):
    """A kind of model: one of it, options that simulate a log of it and that estimate from it, and its true columns."""

    model: str
    motion: tuple[str, ...]
    settings: tuple[str, ...]
    truth: str


KINDS = {
    "chart": Kind(
        "ball_and_beam",
        ("--q0", "0.1,0.05", "--v0", "0,0.3", "--noise", "1e-4", "--dropout", "0.02"),
        ("--set", "measurement.std=1e-4", "--set", "uncertainty.acceleration=0.5"),
        "true_r_dot,true_theta_dot",
    ),
    "group": Kind(
        str(EXAMPLES / "heavy_top.toml"),
        ("--q0", "0.5,0.2,0", "--v0", "0.5,1,4", "--noise", "1e-3", "--dropout", "0.02"),
        (),
        "true_w1,true_w2,true_w3",
    ),
    "state-space": Kind(
        "duffing",
        ("--q0", "0.5,-0.2", "--amplitude", "0.3", "--noise", "1e-2", "--dropout", "0.02"),
        ("--set", "measurement.std=1e-2", "--set", "uncertainty.process=[1e-3,5e-2]"),
        "true_q,true_q_dot",
    ),
}

ESTIMATE, COMPARE = ("csv", "mcap", "json", "report", "score"), ("table", "comparison", "comparison report")


@pytest.fixture(scope="module", params=KINDS)
def estimates(request, tmp_path_factory) -> dict[str, dict[str, Any]]:
    """By engine: what each output of `estimate` holds, for one kind of model."""
    return by_engine(KINDS[request.param], tmp_path_factory.mktemp("estimate"), estimated)


# All estimators are compiled by JAX: the mechanical ones take a minute each.
SLOW = dict.fromkeys(("chart", "group"), pytest.mark.exhaustive)
COMPARED = [pytest.param(name, marks=SLOW.get(name, ())) for name in KINDS]


@pytest.fixture(scope="module", params=COMPARED)
def comparisons(request, tmp_path_factory) -> dict[str, dict[str, Any]]:
    """By engine: what each output of `compare` holds, for one kind of model."""
    return by_engine(KINDS[request.param], tmp_path_factory.mktemp("compare"), compared)


def by_engine(kind: Kind, folder: Path, commands: Callable[..., dict[str, Any]]) -> dict[str, dict[str, Any]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        command("simulate", kind.model, "-o", "log.csv", "--duration", "3", "--rate", "100", *kind.motion)
        return {e: commands(kind, kind.model, "log.csv", *kind.settings, "--engine", e) for e in ENGINES}


def estimated(kind: Kind, *arguments: str) -> dict[str, Any]:
    plain = command("estimate", *arguments, "-o", "v.csv", "--report", "v.html")
    command("estimate", *arguments, "-o", "v.mcap", "--overwrite")
    return {
        "csv": {name: column.tolist() for name, column in logs.survey("v.csv").columns.items()},
        "mcap": {name: column.tolist() for name, column in logs.survey("v.mcap").columns.items()},
        "json": plain,
        "report": page("v.html"),
        "score": command("estimate", *arguments, "--truth", kind.truth),
    }


def compared(kind: Kind, *arguments: str) -> dict[str, Any]:
    summary = command("compare", *arguments, "--truth", kind.truth, "-o", "table.csv", "--report", "table.html")
    return {"table": rows("table.csv"), "comparison": summary, "comparison report": page("table.html")}


def page(path: str) -> Any:
    """The figures of a report, arrays of numbers decoded."""
    return decoded(json.loads(unpacked(Path(path).read_text(encoding="utf-8"), "figures")))


def decoded(x: Any) -> Any:
    if isinstance(x, dict) and "bdata" in x:
        return np.frombuffer(base64.b64decode(x["bdata"]), x["dtype"]).astype(float).tolist()
    if isinstance(x, dict):
        return {name: decoded(value) for name, value in x.items()}
    return [decoded(value) for value in x] if isinstance(x, list) else x


def rows(path: str) -> dict[str, dict[str, str]]:
    with open(path, newline="", encoding="utf-8") as file:
        reader = csv.reader(file)
        head = next(reader)
        return {row[0]: dict(zip(head[1:], row[1:], strict=True)) for row in reader}


def assert_same(a: Any, b: Any, where: str = "") -> None:
    """The same structure and words, and numbers that differ by rounding only."""
    if isinstance(a, dict):
        assert isinstance(b, dict), where
        assert list(a) == list(b), where
        for name in a:
            if name not in ("engine", "engines", *CLOCKED):
                assert_same(a[name], b[name], f"{where}/{name}")
    elif isinstance(a, list):
        assert isinstance(b, list), where
        assert len(a) == len(b), where
        if a and all(isinstance(x, (int, float)) for x in (*a, *b)):
            scale = np.nanmax(np.abs(a), initial=1e-3)
            np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-8 * scale, err_msg=where)
            return
        for i, (left, right) in enumerate(zip(a, b, strict=True)):
            assert_same(left, right, f"{where}/{i}")
    elif number(a) is not None and number(b) is not None:
        np.testing.assert_allclose(number(a), number(b), rtol=1e-5, atol=1e-12, err_msg=where)
    else:
        assert a == b, where


def number(x: Any) -> float | None:
    try:
        return None if isinstance(x, bool) else float(x)
    except (TypeError, ValueError):
        return None


@pytest.mark.exhaustive("chart-csv", "group-csv", "state-space-csv")
@pytest.mark.parametrize("output", ESTIMATE)
def test_both_engines_estimate_the_same(estimates, output):
    by_c, by_jax = (estimates[engine][output] for engine in ENGINES)
    assert by_c
    assert_same(by_c, by_jax)
    if output == "json":
        assert by_jax["engine"] == "jax: as asked"
        assert by_c["engine"] == "c" or shutil.which("cc") is None


@pytest.mark.exhaustive("state-space-table", "state-space-comparison report")
@pytest.mark.parametrize("output", COMPARE)
def test_both_engines_compare_the_same(comparisons, output):
    by_c, by_jax = (comparisons[engine][output] for engine in ENGINES)
    assert by_c
    assert_same(by_c, by_jax)
