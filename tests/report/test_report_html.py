"""The page: one file, no network, no markup from labels, all panels of one time axis and one legend."""

import base64
import gzip
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from plotly.offline import get_plotlyjs

from covariant.report import Along, _html, new_figure, save_figure, write_article


class Page(HTMLParser):
    """What a browser would find: elements with their attributes, and the text outside scripts and styles."""

    def __init__(self, text: str):
        super().__init__()
        self.elements, self.text, self.scripts, self._inside = [], "", [], ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self._inside = tag
        if tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag):
        self._inside = ""

    def handle_data(self, data):
        if self._inside == "script":
            self.scripts[-1] += data
        elif self._inside != "style":
            self.text += data

    def unpacked(self, name):
        """What page.js unpacks: base 85 in other letters, and gzip."""
        at = [attrs.get("id") for attrs in self.all("script")].index(name)
        packed = base64.b85decode(self.scripts[at].replace(",", "<"))
        return gzip.decompress(packed[: int(self.all("script")[at]["data-bytes"])]).decode()

    def figures(self):
        packed = json.loads(self.unpacked("figures"))
        for figure in packed["figures"]:
            for trace in figure["data"]:
                trace["x"] = packed["stamps"][trace["x"]]
        return packed["figures"]

    def timed(self):
        """The figures over time: those of correlations come last, and have bars."""
        return [figure for figure in self.figures() if figure["data"][0]["type"] == "scatter"]

    def all(self, tag):
        return [attrs for name, attrs in self.elements if name == tag]


def values(array) -> np.ndarray:
    """An array as plotly writes it."""
    return np.frombuffer(base64.b64decode(array["bdata"]), array["dtype"])


@pytest.fixture
def page(report) -> Page:
    return Page(_html.page(report))


def test_page_loads_nothing(page):
    for _, attrs in page.elements:
        for name in ("src", "href", "action", "data"):
            assert not re.match(r"\s*(https?:)?//", attrs.get(name) or ""), attrs
    assert not page.all("link")[0]["href"].removeprefix("data:,")
    assert "default-src 'none'" in page.all("meta")[2]["content"]


def test_labels_are_text(page, report):
    assert not page.all("b")
    assert not page.all("i")
    assert len(page.scripts) == 3
    buttons = [attrs["data-label"] for attrs in page.all("button")]
    assert buttons == ["difference of the readings", report.v_reference_label, *report.estimates]
    for text in (report.title, *report.notes, *report.estimates, *report.coordinates, "0.0123"):
        assert text in page.text


def test_the_result_stands_first_and_what_was_odd_below_it(make):
    odd = make(1)._replace(headline="velocity from 400 rows", warnings=("26 of 400 samples: no measurement",))
    text = _html.page(odd)
    verdict, warning, table = (text.index(part) for part in ("Velocity from 400 rows.", "26 of 400", "<table"))
    assert text.index("</h1>") < verdict < warning < table
    assert "No warnings" not in text
    calm = _html.page(odd._replace(warnings=()))
    assert "No warnings." in calm


def test_only_a_ranking_has_a_best_row(make):
    unranked = make(1)._replace(rows=[{"when": "before", "RMS": 2.0}, {"when": "after", "RMS": 1.0}], best=0)
    page = Page(_html.page(unranked))
    assert all("class" not in attrs for attrs in page.all("tr"))


def test_numbers_on_axes_have_no_prefixes_of_units(page):
    axes = [axis for figure in page.timed() for key, axis in figure["layout"].items() if key.startswith("yaxis")]
    assert {axis["exponentformat"] for axis in axes} == {"power"}


def test_terms_are_explained_where_they_occur(make):
    def terms(report):
        text = _html.page(report)
        return re.findall(r"<strong>([^<]*)</strong>: ", text)

    plain = make(1)._replace(innovation={}, distance={}, notes=(), rows=(), v_reference_label="truth")
    assert terms(plain) == []
    assert terms(plain._replace(notes=("NEES 1.2 a number",), rows=[{"NIS": 1.0, "RMSE w [rad/s]": 0.1}])) == [
        "NIS",
        "NEES",
        "RMSE",
    ]
    assert terms(make(1)) == ["Innovation", "Autocorrelation"]


def test_figures_and_tables_are_named_for_those_who_do_not_see_them(page, report):
    figures = [attrs for attrs in page.all("div") if attrs.get("class") == "figure"]
    assert len(figures) == len(report.coordinates)
    for attrs, name in zip(figures, report.coordinates, strict=True):
        assert attrs["aria-label"].startswith(f"{name}: velocity, velocity error, innovation")
    assert all("seconds" in attrs["aria-label"] for attrs in figures)
    for figure in page.figures():
        axes = [axis for key, axis in figure["layout"].items() if re.match("[xy]axis", key)]
        assert all(re.search(r"\[.+\]$", axis["title"]["text"]) for axis in axes)
        assert figure["layout"]["xaxis"]["title"]["text"] == "t [s]"


def test_curves_carry_the_colour_of_a_dark_page(page):
    for trace in page.figures()[0]["data"]:
        assert re.fullmatch("#[0-9A-F]{6}", trace["meta"]["dark"])


def test_one_figure_a_coordinate(page, report):
    figures = page.figures()
    assert len(figures) == len(page.all("section")) == len(report.coordinates)
    for figure in figures:
        assert {trace["xaxis"] for trace in figure["data"]} == {"x"}  # panels of a figure share one time axis
        assert {trace["legendgroup"] for trace in figure["data"]} <= {a["data-label"] for a in page.all("button")}
        assert figure["layout"]["hovermode"] == "x unified"
    assert len([key for key in figures[0]["layout"] if key.startswith("yaxis")]) == 3  # the position is left out
    assert page.all("tr")[1] == {"class": "best"}


def test_missing_samples_are_gaps(page, report):
    slopes = page.figures()[0]["data"][0]
    missing = np.isnan(report.q_measured[:, 0])
    np.testing.assert_array_equal(np.isnan(values(slopes["y"])), missing | np.roll(missing, 1) | (report.t == 0))


def test_a_long_log_of_many_estimators_stays_small_and_is_told(make):
    text = _html.page(make(2, 100_000, labels=tuple(f"estimator {i}" for i in range(13))))
    assert len(text) < 3_000_000
    page = Page(text)
    assert re.search(r"Of each \S+ of the 100000 samples the smallest and the largest", page.text)
    assert page.unpacked("plotly") == get_plotlyjs()


def test_all_samples_of_a_log_can_be_zoomed_to(make):
    """The velocity is one line through every sample, to four digits and more, not the range of an interval."""
    report = make(1, 5000, labels=("one",))
    report = report._replace(table={"t": report.t, "v": report.estimates["one"][:, 1]})
    page = Page(text := _html.page(report))
    assert len(text) < 3_000_000
    [line] = [
        trace for trace in page.figures()[0]["data"] if trace["legendgroup"] == "one" and trace.get("yaxis") == "y"
    ]
    np.testing.assert_array_equal(values(line["x"]), report.t)
    np.testing.assert_allclose(values(line["y"]), report.estimates["one"][:, 1], rtol=4e-5)
    rows = page.unpacked("csv").splitlines()
    assert rows[0] == "t,v"
    assert len(rows) == 5001


def test_bands_marks_pushes_and_forces_are_drawn(make):
    report = make(1, labels=("filter",))
    one = np.ones((len(report.t), 1))
    report = report._replace(
        std={"filter": 0.02 * one},
        innovation_std={"filter": 0.03 * one},
        along=Along(("hand",), ("N m",), 0.5 * one, 0.1 * one),
        marks={"refused": report.t > 19, "no measurement": (report.t > 8) & (report.t < 9)},
        shaded=np.array([[1.0, 2.0]]),
    )
    page = Page(_html.page(report))
    motion, force, _ = page.figures()
    assert [shape["x0"] for shape in motion["layout"]["shapes"]] == [1.0] == [force["layout"]["shapes"][0]["x0"]]
    bounds = [trace for trace in motion["data"] if trace["yaxis"] == "y3" and trace.get("hoverinfo") == "skip"]
    assert sorted(values(trace["y"])[0].round(4) for trace in bounds) == [-0.06, 0.06]
    assert "±2σ" in [attrs["data-label"] for attrs in page.all("button")]
    assert {trace["meta"].get("band") for trace in bounds} == {"±2σ"}
    assert "two standard deviations" in page.text
    marks = {trace["legendgroup"]: trace for trace in motion["data"] if trace.get("yaxis") == "y" and "marker" in trace}
    assert len(values(marks["refused"]["x"])) == int((report.t > 19).sum())
    assert force["layout"]["yaxis"]["title"]["text"] == "hand<br>[N m]"
    band = values(next(trace for trace in force["data"] if trace.get("fill") == "toself")["y"])
    np.testing.assert_allclose([np.nanmin(band), np.nanmax(band)], [0.3, 0.7], rtol=1e-4)


def test_a_page_without_bands_speaks_of_none(make):
    page = Page(_html.page(make(1)))
    assert "±2σ" not in page.text
    assert not any("band" in trace["meta"] for trace in page.timed()[0]["data"])


def test_hidden_curves_wait_for_a_click(make):
    report = make(1, labels=("one", "two"))._replace(hidden=("two",))
    page = Page(_html.page(report))
    pressed = {attrs["data-label"]: attrs["aria-pressed"] for attrs in page.all("button")}
    assert (pressed["one"], pressed["two"]) == ("true", "false")


def test_lines_to_copy_and_facts_are_text(make):
    report = make(1)._replace(code='[design]\na = "<b>"', facts={"command": "covariant estimate <arm>"})
    page = Page(_html.page(report))
    assert not page.all("b")
    assert '[design]\na = "<b>"' in page.text
    assert "covariant estimate <arm>" in page.text


def test_degenerate(degenerate):
    assert Page(_html.page(degenerate)).figures()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"estimates": {}}, "one estimate"),
        ({"units": ("rad",)}, "unit"),
        ({"estimates": {"EKF": np.zeros((400, 3))}}, "EKF"),
        ({"v_reference": np.zeros((400, 2))}, "v_reference"),
        ({"innovation": {"other": np.zeros((400, 3))}}, "other"),
        ({"distance": {"other": np.zeros(400)}}, "other"),
        ({"v_reference_label": "EKF $x"}, "EKF"),
        ({"std": {"EKF $x": np.zeros((400, 1))}}, "std"),
    ],
)
def test_check(make, change, message):
    with pytest.raises(ValueError, match=message):
        make()._replace(**change).check()


def test_a_figure_of_an_article_is_described_and_scrolls_by_itself(tmp_path):
    figure, _ = new_figure()
    save_figure(figure, tmp_path / "motion.png")
    blocks = ["# The <motion>", tmp_path / "motion.png", [{"law": "metric", "verdict": "holds"}]]
    page = Page(write_article("Audit", blocks, tmp_path / "a.html", headline="8 laws hold.").read_text("utf-8"))
    [picture] = page.all("img")
    assert picture["alt"] == "Figure: The <motion>"
    assert [attrs["class"] for attrs in page.all("div")] == ["picture", "table"]
    assert all(attrs["tabindex"] == "0" for attrs in page.all("div"))
    assert page.text.index("Audit") < page.text.index("8 laws hold.") < page.text.index("The <motion>")
