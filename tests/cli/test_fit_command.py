"""`covariant fit` and `covariant init`: what they print, write and refuse."""

import numpy as np
import pytest
from commands import command, refused

from covariant import logs, models

MODEL = """system = "pendulum_chain"
[parameters]
mass = [1.0]     # from a scale
length = [0.5]
source = "a drawing"
[columns]
q = ["angle"]
u = []
[measurement]
quantum = 1e-3
"""
"""A point mass on a rod: only gravity and length give its frequency."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A log of a pendulum of 0.4 m that swings by up to 1.2 rad: its motion is that of an elliptic sine."""
    folder = tmp_path_factory.mktemp("fit")
    (folder / "model.toml").write_text(MODEL.replace("[columns]", "actuated = []\n[columns]"))
    t = np.arange(0, 12, 0.02)
    q, v, path = 1.2, 0.0, []
    for _ in t:
        path.append(q)
        for _ in range(20):  # leapfrog
            v -= 0.5e-3 * 9.81 / 0.4 * np.sin(q)
            q += 1e-3 * v
            v -= 0.5e-3 * 9.81 / 0.4 * np.sin(q)
    y = np.round(np.array(path) / 1e-3) * 1e-3
    logs.write(folder / "log.csv", {"t": t, "angle": y})
    logs.write(folder / "wrong.csv", {"t": t, "angle": np.where(t < 8, y, 0.5 * t**2)})
    return folder


@pytest.fixture(autouse=True)
def inside(folder, monkeypatch):
    monkeypatch.chdir(folder)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--parameters", "lenght"), "unknown number 'lenght'. Did you mean"),
        (("--parameters", "length", "-o", "model.toml"), "this is the model file itself; write to another file"),
    ],
)
def test_wrong_arguments_of_fit_are_told_in_one_line(arguments, message):
    refused("fit", "model.toml", "log.csv", *arguments, named=[message])


def test_init_drafts_a_file_that_loads():
    result = command("init", "log.csv", "-o", "draft.toml")
    assert result["columns"] == {"t": "t", "q": ["angle"], "u": [], "v": []}
    file = models.load("draft.toml")
    assert file.quantum == pytest.approx(1e-3, rel=1e-3)
    assert file.model.inputs == 0
    refused("init", "log.csv", "-o", "draft.toml", named=["there is such a file already"])
    logs.write("odd.csv", {"t": np.arange(9.0) / 100, "a": np.ones(9)})
    named = ["odd.csv: no column is named like a position", "the columns of numbers are t, a"]
    refused("init", "odd.csv", "-o", "odd.toml", named=named)
