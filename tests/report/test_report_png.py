"""Still figures: files, sizes, and the house style."""

import sys

import numpy as np
import pytest

from covariant.report import Along, figure, new_figure, save_figure


def test_failed_save_leaves_the_old_figure(tmp_path):
    path = tmp_path / "figure.png"
    path.write_bytes(b"old")
    figure, axes = new_figure()
    axes[0, 0].set_title(r"$\nonsense$")
    with pytest.raises(ValueError, match="nonsense"):
        save_figure(figure, path)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["figure.png"]


def test_the_legend_names_the_bands_where_there_are_any(make):
    report = make(1, labels=("filter",))
    one = np.ones((len(report.t), 1))
    banded = (report._replace(std={"filter": one}), report._replace(along=Along(("hand",), ("N m",), one, one)))
    for each, named in ((report, False), *((each, True) for each in banded)):
        [legend] = figure(each).legends
        assert ("±2σ" in [text.get_text() for text in legend.get_texts()]) is named


def test_suffix_is_needed(tmp_path):
    with pytest.raises(ValueError, match="suffix"):
        save_figure(new_figure()[0], tmp_path / "figure")


def test_without_matplotlib(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"pip install 'covariant\[report\]'"):
        new_figure()
