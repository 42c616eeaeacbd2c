"""What a command says while it works, to whoever has no terminal."""

import time

import pytest

from covariant.cli import _console


def test_a_line_now_and_then_says_what_is_done(monkeypatch, capsys):
    monkeypatch.setattr(_console, "LINE_EVERY", 0.02)
    with _console.progress_bar() as progress:
        time.sleep(0.1)
        progress("solving", 0.35)
        time.sleep(0.1)
    printed = capsys.readouterr()
    lines = printed.err.splitlines()
    assert lines[0] == "covariant: reading, 0 s"
    assert lines[-1] == "covariant: solving, 35 %, 0 s"
    assert printed.out == ""
    time.sleep(0.05)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("quiet", [True, False])
def test_a_quick_or_quiet_command_says_nothing(quiet, monkeypatch, capsys):
    monkeypatch.setattr(_console, "LINE_EVERY", 0.02 if quiet else 10.0)
    with _console.progress_bar(quiet) as progress:
        progress("solving")
        time.sleep(0.06)
    assert capsys.readouterr() == ("", "")


def test_the_lines_end_with_the_work_that_fails(monkeypatch, capsys):
    monkeypatch.setattr(_console, "LINE_EVERY", 0.02)
    with pytest.raises(ValueError, match="broken"), _console.progress_bar():
        raise ValueError("broken")
    time.sleep(0.06)
    assert capsys.readouterr().err == ""
