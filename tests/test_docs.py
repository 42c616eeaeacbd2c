"""Every example in the README and the pages runs as it stands."""

import re
from pathlib import Path

import jax.numpy as jnp
import pytest

from covariant import models
from covariant.observers import Intrinsic

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(language: str) -> list:
    found = []
    for page in PAGES:
        for i, text in enumerate(re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)):
            found.append(pytest.param(text, id=f"{page.name}-{i}"))
    return found


@pytest.mark.parametrize("text", blocks("python"))
def test_python_examples_run(text):
    """The names a page takes for granted are a short log of a double pendulum and an observer for it."""
    t = jnp.arange(20.0) * 0.002
    names = {"t": t, "u": jnp.zeros((20, 2)), "y": jnp.stack([t, -t], axis=1)}
    names["observer"] = Intrinsic(models.pendulum_chain(), 20.0, 200.0)
    exec(compile(text, "example", "exec"), names)
    assert "result" not in names or names["result"].estimate.shape == (20, 4)


@pytest.mark.parametrize("text", blocks("toml"))
def test_model_file_examples_load(text, tmp_path):
    (tmp_path / "model.toml").write_text(text)
    assert models.load(str(tmp_path / "model.toml")).model.coordinates == ("q1", "q2")


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_lead_to_files_that_exist(page):
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target
