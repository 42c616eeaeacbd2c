"""Every example in the README and the pages runs as it stands."""

import re
import shlex
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.cli import main
from covariant.observers import Intrinsic

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


each_page = pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)


@each_page
def test_python_examples_run(page):
    """One after the other; the names a page takes for granted are a short log of a double pendulum and an observer."""
    t = jnp.arange(20.0) * 0.002
    names = {"t": t, "u": jnp.zeros((20, 2)), "y": jnp.stack([t, -t], axis=1)}
    names["observer"] = Intrinsic(models.pendulum_chain(), 20.0, 200.0)
    for text in blocks(page, "python"):
        exec(compile(text, page.name, "exec"), names)
    assert "result" not in names or names["result"].estimate.shape == (20, 4)


@each_page
def test_model_file_examples_load(page, tmp_path):
    for text in blocks(page, "toml"):
        (tmp_path / "model.toml").write_text(text)
        assert models.load(str(tmp_path / "model.toml")).model.coordinates in (("q1", "q2"), ("q1",), ("q", "q_dot"))


def test_the_commands_of_the_page_on_identification_run(tmp_path, monkeypatch):
    """They work on what the page makes: its model file, and a log that is simulated."""
    monkeypatch.chdir(tmp_path)
    page = ROOT / "docs" / "identification.md"
    [rough] = blocks(page, "toml")
    Path("rough.toml").write_text(rough)
    for line in "".join(blocks(page, "bash")).replace("\\\n", " ").splitlines():
        assert left_with(line) == 0, line
    fitted = models.load("calibrated.toml").model.parameters
    np.testing.assert_allclose(fitted["mass"].value, [0.6, 0.4], rtol=0.05)
    assert Path("calibrated.toml").read_text().count("from the drawing") == 1
    assert models.load("draft.toml").columns.u == ("u1", "u2")


def left_with(line: str) -> int:
    """Run the command of a line; returns its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", shlex.split(line))
        with pytest.raises(SystemExit) as left:
            main()
    return int(left.value.code or 0)


@pytest.mark.data
def test_the_newcomers_page_shows_what_its_commands_print(tmp_path, monkeypatch, capsys, data_folder):
    """On two recorded logs without the columns that tell more than stamps, readings and torques."""
    monkeypatch.chdir(tmp_path)
    for name, log in (("log", "ddp"), ("other", "dircol")):
        rows = (data_folder / "dfki_simple_pendulum" / f"{log}.csv").read_text().splitlines()
        cells = [row.split(",") for row in rows]
        Path(f"{name}.csv").write_text("\n".join(",".join((row[0], row[1], row[3])) for row in cells) + "\n")
    page = ROOT / "docs" / "your-log.md"
    [rough] = blocks(page, "toml")
    Path("rough.toml").write_text(rough)
    head, *texts = blocks(page, "text")
    assert Path("log.csv").read_text().startswith(head)
    for line, text in zip(blocks(page, "bash"), texts, strict=True):
        assert left_with(line) == (1 if "WRONG" in text else 0), line
        printed = capsys.readouterr().out.splitlines()
        for shown in filter(None, text.splitlines()):
            assert any(same(shown, found) for found in printed), f"{line}prints no line {shown!r}"


def same(shown: str, printed: str) -> bool:
    """Whether two lines have the same words, and numbers that differ by 5 % at most; … stands for any word."""
    pairs = list(zip(shown.split(), printed.split(), strict=False))
    return len(shown.split()) == len(printed.split()) and all(a in ("…", b) or near(a, b) for a, b in pairs)


def near(a: str, b: str) -> bool:
    try:
        return float(a.rstrip(",;")) == pytest.approx(float(b.rstrip(",;")), rel=0.05)
    except ValueError:
        return False
