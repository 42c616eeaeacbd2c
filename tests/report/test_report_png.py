"""Still figures: files, sizes, and the house style."""

import sys

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import pyplot
from PIL import Image

from covariant.report import PALETTE, new_figure, save_figure, write_png

NAMES = ["log_velocity.png", "log_position.png", "log_distance.png"]


def ink(image: Image.Image) -> np.ndarray:
    """Where an image is not white, (height, width)."""
    return np.asarray(image.convert("L")) < 250


@pytest.mark.long("n=3")
def test_files(report, tmp_path):
    paths = write_png(report, tmp_path / "log.png")
    assert [path.name for path in paths] == NAMES
    for path in paths:
        with Image.open(path) as image:
            assert image.info["dpi"] == pytest.approx((150, 150), abs=0.1)
            assert image.width == round(150 * (7.2 if "distance" in path.name else 2 * 4.8))
            drawn = ink(image)
        assert drawn.mean() > 0.02
        edges = np.concatenate([drawn[0], drawn[-1], drawn[:, 0], drawn[:, -1]])
        assert not edges.any()  # no text runs out of the figure
        assert path.stat().st_size < 2**20


@pytest.mark.long
def test_a_row_a_coordinate(make, tmp_path):
    heights = []
    for n in (1, 3):
        with Image.open(write_png(make(n), tmp_path / f"n{n}")[0]) as image:
            heights.append(image.height)
    assert heights[1] - heights[0] == pytest.approx(2 * 2.3 * 150, abs=1)


@pytest.mark.long("diverged", "zero_distances")
def test_degenerate(degenerate, tmp_path):
    for path in write_png(degenerate, tmp_path / "log"):
        with Image.open(path) as image:
            assert ink(image).any()


def test_long_texts(make, tmp_path):
    report = make(1, labels=tuple(f"observer {i} " + "with a long name " * 6 for i in range(9)))
    path, *_ = write_png(report._replace(title="word " * 60, coordinates=("joint " * 20,)), tmp_path / "log")
    with Image.open(path) as image:
        drawn = ink(image)
    assert not np.concatenate([drawn[0], drawn[-1], drawn[:, 0], drawn[:, -1]]).any()


@pytest.mark.long
def test_new_figure_has_the_house_style_and_touches_nothing_global(tmp_path):
    before = dict(mpl.rcParams)
    figure, axes = new_figure(2, 3, titles=list("abcdef"))
    assert axes.shape == (2, 3)
    assert [ax.get_title(loc="left") for ax in axes.flat] == list("abcdef")
    lines = [axes[0, 0].plot([0, 1], [0, k])[0].get_color() for k in range(len(PALETTE))]
    assert lines == list(PALETTE)
    for suffix in ("png", "pdf", "svg"):
        assert save_figure(figure, tmp_path / f"figure.{suffix}").stat().st_size > 1000
    assert dict(mpl.rcParams) == before
    assert pyplot.get_fignums() == []


def test_failed_save_leaves_the_old_figure(tmp_path):
    path = tmp_path / "figure.png"
    path.write_bytes(b"old")
    figure, axes = new_figure()
    axes[0, 0].set_title(r"$\nonsense$")
    with pytest.raises(ValueError, match="nonsense"):
        save_figure(figure, path)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["figure.png"]


def test_suffix_is_needed(tmp_path):
    with pytest.raises(ValueError, match="suffix"):
        save_figure(new_figure()[0], tmp_path / "figure")


def test_without_matplotlib(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"pip install 'covariant\[report\]'"):
        new_figure()
