"""What a terminal shows of a printed text: rows within its width, from which nothing is lost; a file gets the text."""

import io
import re

from covariant.cli._terminal import say

TEXT = """PROVED: any estimate that starts near enough stays so, and its distance in the metric halves every 0.7 s
- a remark on [uncertainty] and [design] that is longer than the eighty columns which the terminal of a stranger has

| estimator           | RMSE dq1/dt [rad/s] | RMSE dq2/dt [rad/s] | predicted q1 [rad] | predicted q2 [rad] |    NIS |
| ------------------- | ------------------: | ------------------: | -----------------: | -----------------: | -----: |
| filtered-derivative |             0.20403 |             0.31349 |          0.0027697 |          0.0042856 | 0.9213 |
wrote /a/path/that/is/longer/than/a/row/and/stays/whole/so/that/somebody/can/copy/it/with/a/mouse.csv
"""


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def shown(monkeypatch, width: int) -> str:
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setenv("TERM", "xterm-256color")
    terminal = Terminal()
    say(TEXT, terminal)
    return terminal.getvalue()


def words(text: str) -> set[str]:
    return {*re.sub(r"[|]|-{3,}:?|─+", " ", text).split()}


def test_rows_fit_and_nothing_is_lost(monkeypatch):
    monkeypatch.setenv("NO_COLOR", "1")
    for width in (40, 80, 120):
        text = shown(monkeypatch, width)
        assert "\x1b[3" not in text
        rows = re.sub(r"\x1b\[[\d;]*m", "", text).splitlines()
        assert all(len(row.rstrip()) <= width for row in rows if "/a/path" not in row)
        assert words("\n".join(rows)) >= words(TEXT)


def test_a_verdict_has_its_colour(monkeypatch):
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert "\x1b[1;32mPROVED" in shown(monkeypatch, 80)


def test_a_file_gets_the_text_as_it_is():
    file = io.StringIO()
    say(TEXT, file)
    assert file.getvalue() == TEXT + "\n"
