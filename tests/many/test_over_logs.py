"""Verbs over many logs: each its row or its reason, resumed by content; and what the rows say together."""

import csv
import os
import re
from pathlib import Path

import numpy as np
import pytest
from commands import leave

import covariant
from covariant import many
from covariant.many._over_logs import LogsResult
from covariant.verbs.base.among_logs import LogRow, among_logs
from scalargraph.errors import file_name


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Three good logs, one that is no table, a folder, and one in milliseconds."""
    folder = tmp_path_factory.mktemp("logs")
    for k in range(4):
        log = covariant.simulate("oscillator", duration=10.0, rate=50.0, q0=[1.0], noise=1e-3, seed=k)
        log.save(folder / f"log{k}.csv")
    late = covariant.simulate("oscillator", duration=10.0, rate=50.0, q0=[1.0], noise=1e-3, seed=3).to_pandas()
    late.assign(t=1e3 * late.t).to_csv(folder / "log3.csv", index=False)
    (folder / "broken.csv").write_bytes(b"\x00\x01 no table")
    (folder / "folder").mkdir()
    return sorted(folder.iterdir())


@pytest.fixture
def in_folder(tmp_path, monkeypatch):
    """An empty working folder, from which names are relative and begin as the files do."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_names_of_files_are_text_in_tables_pages_and_messages(in_folder):
    """None ends the run, is a formula in a spreadsheet, a command to a terminal, or a line of its own."""
    names = ["=1+1", "+1", "-1", "@a", "=d/c", "n\nFAILED x", "\x1b[2J", "\u202evsc.exe", "ö [bold] <b>"]
    names = [os.fsdecode(b"b\xff.csv"), *(f"{name}.csv" for name in names)]
    Path("=d").mkdir()
    for name in names:
        Path(name).write_text("far,second\n1,2\n3,4\n")
    code, *printed = leave("check", "oscillator", "--out", "out", "--workers", "1", "--", *names)
    assert code == 1
    with open("out/check.csv", encoding="utf-8", newline="") as table:
        rows = list(csv.DictReader(table))
    assert [row["log"].removeprefix("'") for row in rows] == list(map(file_name, names))
    cells = [cell for row in rows for cell in row.values()]
    assert not any(cell.startswith(("=", "+", "-", "@", "\t", "\r")) for cell in cells)
    assert all("There are: far, second" in row["failed"] for row in rows)
    page = Path("out/check.html").read_text(encoding="utf-8")
    assert all(c.isprintable() or c in "\n\t" for text in (*printed, *cells, page) for c in text)
    assert "\nFAILED x" not in "".join(printed)


def test_a_link_shows_nothing_of_the_file_that_it_leads_to(in_folder):
    for folder in ("logs", "private"):
        Path(folder).mkdir()
        Path(folder, "log.csv").write_text("SECRET:x:0:0\n")
    Path("logs/file.csv").symlink_to("../private/log.csv")
    Path("logs/folder").symlink_to("../private")
    logs = ["logs/log.csv", "logs/file.csv", "logs/folder/log.csv"]
    result = many.over_logs("check", "oscillator", logs, out="out")
    assert ["SECRET" in result.failed[log] for log in logs] == [True, False, False]
    Path("logs/log.csv").write_text("far,second\n1,2\n")
    result = many.over_logs("check", "oscillator", logs, out="out")
    written = [path.read_text(encoding="utf-8") for path in Path("out").iterdir() if path.is_file()]
    assert len(written) == 2
    assert not any("SECRET" in text for text in (str(result), *written))


def test_logs_that_are_unlike_the_others_are_named():
    rng = np.random.default_rng(0)
    rows = [
        LogRow(f"arm{k % 2}/log{k // 2:02d}.csv", {"nis": float(np.exp(0.1 * rng.normal())), "wrong": ""})
        for k in range(40)
    ]
    assert among_logs(rows) == ((), {})
    rows[5].row["nis"] = 30.0
    for k in range(20, 40, 2):
        rows[k].row["wrong"] = "delay of inputs"
    rows[3].row["wrong"] = rows[8].row["wrong"] = "unit of q1"
    found = among_logs(rows).sentences
    assert found[0] == "WRONG delay of inputs in 10 of 40 logs: all of arm0 from log10.csv on, and none before"
    assert found[1] == "WRONG unit of q1 in 2 of 40 logs: arm0/log04.csv; arm1/log01.csv"
    assert re.fullmatch(r"ODD nis in 1 of 28 logs \(30, median [\d.]+\): arm1/log02.csv", found[2])
    assert len(found) == 3


def test_many_logs_of_a_machine_are_one_phrase():
    rows = [LogRow(f"arm{k // 10}/log{k % 10}.csv", {"nis": 1.0, "wrong": ""}) for k in range(40)]
    for k in (*range(10, 20), *range(30, 37)):
        rows[k].row["wrong"] = "unit of time"
        rows[k].row["nis"] = 30.0
    rows[21].row["failed"] = "no column 'q1'"
    rows[22].row["failed"] = "no column 'q2'"
    for k in range(2, 9):
        rows[k].row["failed"] = f"{rows[k].name} leaves {k}.5e-3 %"
    assert among_logs(rows).sentences == (
        "FAILED 7 of 40 logs: 7 of the 10 of arm0, the first log2.csv. The first: arm0/log2.csv leaves 2.5e-3 %",
        "arm2/log1.csv: no column 'q1'",
        "arm2/log2.csv: no column 'q2'",
        "WRONG unit of time in 17 of 31 logs: all 10 of arm1; 7 of the 10 of arm3, the first log0.csv",
    ), "and none is odd for what is wrong with it"
    alone = [LogRow(f"log{k}.csv", {"failed": "no rows"}) for k in range(9)]
    assert among_logs(alone).sentences == ("FAILED 9 of 9 logs: all 9. The first: no rows",)


def test_numbers_of_many_logs_are_shared_differ_or_drift():
    rng = np.random.default_rng(1)
    rows = [
        LogRow(
            f"arm{k % 10}/log{k // 10:02d}.csv",
            {
                "viscous": 0.1 + 0.003 * rng.normal() + (0.002 * (k // 10) if k % 10 == 3 else 0.0),
                "viscous_std": 0.003,
                "mass": 1.0 + 0.002 * rng.normal() + 0.3 * (k % 10 == 5),
                "mass_std": 0.002,
            },
        )
        for k in range(300)
    ]
    found = among_logs(rows).sentences
    drifts = [line for line in found if "drifts" in line]
    assert len(drifts) == 1
    assert drifts[0].startswith("  viscous drifts on arm3: +0.05")
    assert sum(line.startswith("mass = 1 ±") and "shared by 9 of 10 machines" in line for line in found) == 1
    assert [line[:14] for line in found if line.startswith("  arm5")] == ["  arm5: +0.3 ±"]


def test_logs_are_in_the_order_of_their_dates_or_of_the_numbers_in_their_names():
    names = [f"arm/log{k}.csv" for k in range(14)]
    rows = [LogRow(name, {"wrong": "unit of time" if k >= 9 else "", "rows": 500.0}) for k, name in enumerate(names)]
    late = "WRONG unit of time in 5 of 14 logs: all of arm from log9.csv on, and none before"
    by_shell = sorted(rows)
    assert by_shell != rows
    assert among_logs([LogRow(*row) for row in by_shell] + [LogRow("b/log.csv", {})]).sentences == (
        late.replace("of 14", "of 15"),
    )
    dated = [
        LogRow(f"arm/{chr(110 - k)}.csv", row | {"t_counts_from": f"2026-01-{k + 1:02d}T00:00:00Z"})
        for k, (_, row) in enumerate(rows)
    ]
    assert among_logs([*sorted(dated), LogRow("b/log.csv", {})]).sentences == (
        "WRONG unit of time in 5 of 15 logs: all of arm from e.csv on, and none before",
    )


def test_any_name_has_a_place_and_one_or_two_machines_have_no_odd_one(recwarn):
    names = ["1²3/x²5.csv", "1²3/٣.csv", "a/b.csv", "²/²"]
    rows = [LogRow(name, {"mass": 1.0 + k, "mass_std": 0.01}) for k, name in enumerate(names)]
    for part in (rows[:3], [*rows[:1], *rows[:1], *rows[:1], LogRow("b/c.csv", {"failed": "no rows"})], rows):
        (line,) = (line for line in among_logs(part).sentences if "shared" in line)
        assert "of" not in line.split("shared by")[1].split("which")[0]
    assert not recwarn.list


def test_a_clock_a_percent_fast_is_odd_and_a_short_or_idle_log_is_not():
    rows = [
        LogRow(f"arm{k % 10}/log{k // 10}.csv", {"rows": 500.0, "rate": 250.0 * (1 + 1e-9 * k), "nis": 1.0})
        for k in range(40)
    ]
    for k in range(7, 40, 10):
        rows[k].row["rate"] = 247.5
    rows[0].row.update(rows=2.0, nis=30.0)
    rows[1].row.update(verdict="too little motion", notes="too little motion", wrong="")
    result = LogsResult("check", "oscillator", rows)
    assert result.warnings == (
        "IDLE 1 of 40 logs, which move too little: arm1/log0.csv",
        "ODD rate in 4 of 39 logs (247.5, median 250): all 4 of arm7",
    )
    assert result.columns["odd"][[7, 8]].tolist() == ["rate", ""]
    assert not result.wrong


def test_a_page_has_a_thousand_rows_and_says_where_the_others_are(tmp_path):
    rows = [LogRow(f"log{k}.csv", {"rows": 10.0}) for k in range(1200)]
    rows[1100].row["failed"] = "no rows"
    LogsResult("estimate", "oscillator", rows).report(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert page.count("<td>log") == 1000
    assert "200 more logs are in the table" in page
    assert "<td>log1100.csv" in page, "what failed comes first"


def test_an_arm_at_rest_is_idle_and_one_that_does_not_follow_its_commands_is_wrong():
    t = np.arange(300) / 50
    file = Path(__file__).parents[2] / "examples" / "so101.toml"
    y = np.tile(np.array([0.3, 0.1, 0.6, 0.2, 0.0]), (300, 1))
    rows = []
    for size in (0.0, 0.05, 0.5):
        result = covariant.check(file, covariant.Record(t, y + 0.05 + size * np.sin(t)[:, None] * np.eye(5)[1], y))
        assert result.wrong, "nothing can be told from it"
        rows.append(LogRow(f"log{size}", result.row))
    assert [row["verdict"] for _, row in rows] == ["too little motion", "too little motion", "WRONG"]
    assert [row["wrong"][:9] for _, row in rows] == ["", "", "servo off"]
    assert rows[0].row["notes"].startswith("nothing moves of ")
    assert "while a command moves by 1" in result.warnings[0]
    many = LogsResult("check", "arm", rows)
    assert many.wrong
    assert not LogsResult("check", "arm", rows[:2]).wrong
    assert many.warnings[1] == "IDLE 2 of 3 logs, which move too little: log0.0; log0.05"
