"""Run the commands and the Python examples of a page in order, as a reader who types them would.

    python tools/run_page.py docs/groups.md

runs them in the present folder and ends with exit code 1 where one fails. Blocks between fences are taken by their
language:

- `bash`: commands, which must succeed;
- `python`: code; all blocks of a page share their names;
- `text` after either of them: lines that it prints, with the same words and numbers within 5 %; `…` is any word;
- `toml`: a model file, which must load, or a study with axes; with `title="name"` it is written to the file of that
  name first;
- `text` with `title="name"`: the first lines of that file;
- other languages, and code with a title, are parts of larger programs, and other tests compile them.

A table with a column named `command` is a block of the commands in it. A comment in the line before a block changes
what is done with it: `<!-- not run: REASON -->` leaves it out, `<!-- long: REASON -->` leaves it out unless `--long` is
given, `<!-- needs cc: REASON -->` where there is no compiler of C; `<!-- run instead: COMMAND -->` runs another
command, and `<!-- exit code 1 -->` is what its last command ends with.
"""

import argparse
import contextlib
import io
import linecache
import re
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any, NamedTuple

RUN = ("bash", "python", "toml", "text")
PARTS = ("c", "cpp", "cmake", "diff", "js", "xml")
"""Languages of blocks that are parts of larger programs."""
TOLERANCE = 0.05
"""Largest relative difference of a printed number from the one on the page."""


class Block(NamedTuple):
    """A block of a page: its language, title, text and first line (from 1), and the comments before it.

    `reason` is why it is not run, `long` why it is run by the long suite only, `needs_cc` why it needs a compiler of C;
    they are empty for other blocks.
    """

    language: str
    title: str
    text: str
    line: int
    reason: str = ""
    long: str = ""
    exit_code: int = 0
    needs_cc: str = ""


FENCE = r"^```(?P<head>.*)\n(?P<text>(?:(?!```).*\n)*?)```$"
COMMAND = re.compile(r"`(covariant .+?)`")
TABLE = r"^\|.*\bcommand\b.*\|\n\|[-:| ]+\|\n(?P<rows>(?:\|.*\n)+)"
BLOCK = re.compile(rf"(?P<comments>(?:^<!-- .*? -->\n)*)(?:{FENCE}|{TABLE})", re.MULTILINE)


def blocks(page: str) -> list[Block]:
    """The blocks of a page, in order: those between fences, and tables of commands."""
    return [block for match in BLOCK.finditer(page) if (block := _block(match, page)).text]


def _block(match: re.Match[str], page: str) -> Block:
    part = "text" if match["rows"] is None else "rows"
    language, _, rest = (match["head"] or "bash").partition(" ")
    text = match[part] if part == "text" else "".join(f"{command}\n" for command in COMMAND.findall(match[part]))
    title = re.search(r'title="(.+?)"', rest)
    comments = dict(re.findall(r"<!-- (not run|long|needs cc|run instead|exit code):? (.+?) -->", match["comments"]))
    text = f"{comments['run instead']}\n" if "run instead" in comments else text
    reason, exit_code = comments.get("not run", ""), int(comments.get("exit code", 0))
    line = page.count("\n", 0, match.start(part)) + 1
    long, needs_cc = comments.get("long", ""), comments.get("needs cc", "")
    return Block(language, title[1] if title else "", text, line, reason, long, exit_code, needs_cc)


def run_page(page: Path, long: bool = False) -> list[str]:
    """Run the blocks of a page in the present folder; returns what failed, one message for each block."""
    names: dict[str, Any] = {"__name__": "__main__"}
    printed, failures = "", []
    for block in blocks(page.read_text(encoding="utf-8")):
        omitted = block.reason or (block.long if not long else "") or (block.needs_cc if not shutil.which("cc") else "")
        if omitted:
            print(f"-- {page.name}:{block.line} not run: {omitted}", flush=True)
            printed = None
            continue
        began = time.perf_counter()
        try:
            printed = _run(block, page, names, printed)
        except Exception as error:  # whatever a block raises is its failure, and the others run
            failures.append(f"{page.name}:{block.line}: {error}")
            print(failures[-1], flush=True)
            printed = None
        print(f"-- {page.name}:{block.line} {block.language} {time.perf_counter() - began:.1f} s", flush=True)
    return failures


def _run(block: Block, page: Path, names: dict[str, Any], printed: str | None) -> str | None:
    """Run one block; returns what it printed, or for one that prints nothing what was printed before."""
    match block.language:
        case "bash":
            return _commands(block)
        case "python" if not block.title:
            return _python(block, page, names)
        case "toml":
            _model_file(block)
        case "text" if block.title:
            if not Path(block.title).read_text(encoding="utf-8").startswith(block.text):
                raise AssertionError(f"{block.title} does not begin so")
        case "text" if printed is not None:
            _compare(block.text, printed)
    return printed


def _commands(block: Block) -> str:
    print(block.text, end="", flush=True)
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", block.text], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    print(done.stdout, end="", flush=True)
    if done.returncode != block.exit_code:
        raise AssertionError(
            f"exit code {done.returncode}, not {block.exit_code}, of\n{block.text}{done.stdout[-2000:]}"
        )
    return done.stdout


def _python(block: Block, page: Path, names: dict[str, Any]) -> str:
    source = "\n" * (block.line - 1) + block.text  # tracebacks name the lines of the page
    out = io.StringIO()
    linecache.cache[str(page)] = (len(source), None, source.splitlines(keepends=True), str(page))
    try:
        with contextlib.redirect_stdout(out):
            exec(compile(source, str(page), "exec"), names)
    except BaseException:
        raise AssertionError(traceback.format_exc()) from None
    print(out.getvalue(), end="", flush=True)
    return out.getvalue()


def _model_file(block: Block) -> None:
    from covariant import models

    if block.title:
        Path(block.title).write_text(block.text, encoding="utf-8")
        if "[axes]" not in block.text:  # a study, which the command below it reads
            models.load(block.title)
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "model.toml")
        path.write_text(block.text, encoding="utf-8")
        models.load(str(path))


def _compare(shown: str, printed: str) -> None:
    """Raise `AssertionError` with the lines of a page that were not printed in this order."""
    lines, missing = iter(printed.splitlines()), []
    for line in filter(None, shown.splitlines()):
        if not any(same(line, other) for other in lines):
            missing.append(line)
            lines = iter(printed.splitlines())
    if missing:
        raise AssertionError("not printed:\n" + "\n".join(missing))


def same(shown: str, printed: str) -> bool:
    """Whether two lines have the same words, and numbers that differ by 5 % at most; `…` stands for any word."""
    left, right = ([word.strip("[](),;:") for word in line.split()] for line in (shown, printed))
    return len(left) == len(right) and all(a in ("…", b) or _near(a, b) for a, b in zip(left, right, strict=True))


def _near(shown: str, printed: str) -> bool:
    try:
        a, b = float(shown), float(printed)
    except ValueError:
        return False
    return abs(a - b) <= TOLERANCE * max(abs(a), abs(b))


def main() -> int:
    """Run the pages that the command line names; returns the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("page", type=Path)
    parser.add_argument("--long", action="store_true", help="run the blocks marked as long too")
    options = parser.parse_args()
    sys.path[0] = ""  # modules are found in the present folder, as in a session of Python
    failures = run_page(options.page.resolve(), options.long)
    print("\n".join([f"{len(failures)} blocks failed", *failures]))
    return min(len(failures), 1)


if __name__ == "__main__":
    sys.exit(main())
