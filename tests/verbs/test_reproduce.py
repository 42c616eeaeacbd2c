"""`reproduce_paper` reports its steps, and gives back what the module of a paper computes, prints and draws."""

import sys
from types import SimpleNamespace

import pytest

from covariant import verbs
from covariant.verbs import _reproduce


@pytest.fixture
def paper(monkeypatch):
    """A paper of two steps."""

    def reproduce(begin):
        begin("one")
        begin("two")
        return {"answer": 42.0, "seconds": 0.1}

    def draw(path):
        path.write_text("figure")
        return (path,)

    def page(results, figures):
        return [f"{results['answer']} {figures[0].name}"]

    module = SimpleNamespace(
        STAGES=2,
        reproduce=reproduce,
        draw=draw,
        TITLE="A stub",
        page=page,
        summary=lambda results: ["Answers", [{"answer": f"{results['answer']:g}"}]],
    )
    monkeypatch.setitem(sys.modules, "covariant.papers.stub", module)
    monkeypatch.setitem(_reproduce.PAPERS, "stub", "stub")


def test_progress_is_reported_within_the_work(paper):
    reports = []
    result = verbs.reproduce_paper("stub", progress=lambda text, fraction=None: reports.append((text, fraction)))
    assert reports[1:] == [("one (1 of 2)", 0.0), ("two (2 of 2)", 0.5)]
    assert result.summary["answer"] == 42.0
    assert "42" in str(result)
    assert repr(result) == "<ReproduceResult: stub: 1 groups of numbers in 0.1 s>"


def test_a_page_holds_the_figures_beside_it(paper, tmp_path):
    paths = verbs.reproduce_paper("stub").report(tmp_path / "page.html")
    assert [path.name for path in paths] == ["page.png", "page.html"]
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "A stub" in text
    assert "42.0 page.png" in text
