"""Still figures: files, sizes, and the house style: what takes long."""

import io

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import pyplot
from PIL import Image

from covariant.report import PALETTE, new_figure, save_figure
from covariant.report._png import draw_png

NAMES = ["log_velocity.png", "log_position.png", "log_distance.png"]


def ink(image: Image.Image) -> np.ndarray:
    """Where an image is not white, (height, width)."""
    return np.asarray(image.convert("L")) < 250


def images(report) -> dict[str, Image.Image]:
    """The figures of a report by the name of their file."""
    return {path.name: Image.open(io.BytesIO(drawn)) for path, drawn in draw_png(report, "log.png").items()}


def within(image: Image.Image) -> bool:
    """Whether no text runs out of the figure."""
    drawn = ink(image)
    return not np.concatenate([drawn[0], drawn[-1], drawn[:, 0], drawn[:, -1]]).any()


@pytest.mark.exhaustive("n=3")
def test_files(report):
    drawn = images(report)
    assert list(drawn) == NAMES
    assert max(map(len, draw_png(report, "log").values())) < 2**20
    for name, image in drawn.items():
        assert image.info["dpi"] == pytest.approx((150, 150), abs=0.1)
        assert image.width == round(150 * (7.2 if "distance" in name else 2 * 4.8))
        assert ink(image).mean() > 0.02
        assert within(image)


@pytest.mark.exhaustive
def test_a_row_a_coordinate(make):
    low, high = (images(make(n))["log_velocity.png"].height for n in (1, 3))
    assert high - low == pytest.approx(2 * 2.3 * 150, abs=1)


def test_degenerate(degenerate):
    assert all(ink(image).any() for image in images(degenerate).values())


def test_long_texts(make):
    report = make(1, labels=tuple(f"observer {i} " + "with a long name " * 6 for i in range(9)))
    assert within(images(report._replace(title="word " * 60, coordinates=("joint " * 20,)))["log_velocity.png"])


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
