"""What takes long of `test_report_html.py`."""

import sys

import numpy as np
import pytest

from covariant.report import write_report


@pytest.mark.parametrize("missing", ["plotly.offline", "matplotlib.figure"])
def test_page_and_figures_are_written_all_or_none(missing, make, tmp_path, monkeypatch):
    names = ["log.html", "log_distance.png", "log_position.png", "log_velocity.png"]
    assert sorted(path.name for path in write_report(make(1), tmp_path / "log.html")) == names
    (tmp_path / "log.html").write_text("old")
    for path in tmp_path.glob("*.png"):
        path.unlink()
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ImportError, match=r"pip install 'covariant\[report\]'") as caught:
        write_report(make(1), tmp_path / "log.html")
    assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["log.html"]
    assert (tmp_path / "log.html").read_text() == "old"


def test_failure_leaves_the_old_page(make, tmp_path, monkeypatch):
    path = tmp_path / "report.html"
    path.write_text("old")
    with pytest.raises(ValueError, match="q_measured"):
        write_report(make()._replace(q_measured=np.zeros(3)), path)

    def full_disk(_):
        raise OSError("no space left on device")

    monkeypatch.setattr("os.fsync", full_disk)
    with pytest.raises(OSError, match="no space"):
        write_report(make(), path)
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
