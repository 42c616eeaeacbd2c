"""The style of a package of Python in numbers: docstrings, examples, comments, private words, long functions and files.

    python tools/style.py [FOLDER ...]
    python tools/style.py --pages

For each folder, by default this library's own, prints one line per number. What is public is what has no name with a
leading underscore, whichever file it is in. Prose is docstrings and comments. With `--pages`, every number in README,
changelog and `docs` gets the zero that SI wants before its decimal point.
"""

import argparse
import ast
import io
import re
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parents[1] / "src" / "covariant"
WORDS = {
    *("told", "tells", "tell", "said", "found", "kept", "keep", "made", "worth", "taken", "way", "near", "far"),
    *("spread", "sought", "sound", "moves", "held", "age", "about", "own", "whatever", "given"),
}
"""Words that say little by themselves: right English in places, and riddles as names."""
MOST_PARAMETERS, LONGEST_BODY, LONGEST_FILE = 7, 60, 400
WITHOUT_ZERO = re.compile(r"(?<![\w.)\]\\:%~])\.(?=\d)")
"""The decimal point of a number without a digit before it; those of formats, as in `{x:.3f}`, are none."""
ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
Function = ast.FunctionDef | ast.AsyncFunctionDef


class Style(NamedTuple):
    """The numbers of a package.

    - `numbers`: files, lines, code (lines that are neither empty, nor comments, nor docstrings), comments; public
      functions, methods and classes, and of these undocumented and one_line; offered, public functions and classes at
      the top of a file, and of these with_example.
    - `words`: how often each of `WORDS` is in identifiers and prose.
    - `wide`: functions with more than `MOST_PARAMETERS` parameters.
    - `long`: functions with more than `LONGEST_BODY` lines of body.
    - `large`: files of more than `LONGEST_FILE` lines, docstrings not counted.
    """

    numbers: Counter
    words: Counter
    wide: list[str]
    long: list[str]
    large: list[str]


def documented(tree: ast.Module) -> Iterator[ast.AST]:
    """Public classes, functions and methods of a file; those within functions are nobody's."""
    for node in tree.body:
        if isinstance(node, Function | ast.ClassDef) and not node.name.startswith("_"):
            yield node
            for inner in node.body if isinstance(node, ast.ClassDef) else ():
                if isinstance(inner, Function) and not inner.name.startswith("_"):
                    yield inner


def docstrings(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Every docstring and its number of lines, those that follow an assignment too."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        for child in body if isinstance(body, list) else ():
            if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant) and type(child.value.value) is str:
                yield child.value.value, (child.end_lineno or child.lineno) - child.lineno + 1


def parts(name: str) -> list[str]:
    """The words of an identifier."""
    return re.findall(r"[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1_\2", name).lower())


def identifiers(tree: ast.Module) -> Iterator[str]:
    """Names where they are bound: functions, classes, arguments, variables, attributes."""
    for node in ast.walk(tree):
        if isinstance(node, Function | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, ast.Attribute):
            yield node.attr


def arguments(node: Function) -> int:
    a = node.args
    names = [arg.arg for arg in (*a.posonlyargs, *a.args, *a.kwonlyargs)]
    return len([name for name in names if name not in ("self", "cls")])


def body_lines(node: Function) -> int:
    first = node.body[1:] if ast.get_docstring(node) is not None else node.body
    return 0 if not first else (node.end_lineno or 0) - first[0].lineno + 1


def measure(folder: Path) -> Style:
    """The numbers of all files of a folder; raises `SyntaxError` for one that is no Python."""
    numbers, words = Counter(), Counter()
    wide, long, large = [], [], []
    for path in sorted(folder.rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        tree, lines, place = ast.parse(source), source.count("\n"), path.relative_to(folder).as_posix()
        texts = list(docstrings(tree))
        tokens = list(tokenize.generate_tokens(io.StringIO(source).readline))
        comments = [t.string for t in tokens if t.type == tokenize.COMMENT]
        alone = sum(line.strip().startswith("#") for line in source.split("\n"))
        blank = sum(not line.strip() for line in source.split("\n"))
        inner_blank = sum(text.count("\n\n") for text, _ in texts)
        numbers["files"] += 1
        numbers["lines"] += lines
        numbers["code"] += lines - alone - blank - sum(n for _, n in texts) + inner_blank
        numbers["comments"] += len(comments)
        for node in documented(tree):
            text = ast.get_docstring(node)  # pyright: ignore[reportArgumentType]
            numbers["public"] += 1
            numbers["undocumented"] += text is None
            numbers["one_line"] += text is not None and "\n" not in text.strip()
        for node in tree.body:
            if isinstance(node, Function | ast.ClassDef) and not node.name.startswith("_"):
                numbers["offered"] += 1
                numbers["with_example"] += ">>>" in (ast.get_docstring(node) or "")
        for name in identifiers(tree):
            words.update(part for part in parts(name) if part in WORDS)
        for text in [*(text for text, _ in texts), *comments]:
            words.update(word for word in re.findall(r"[a-z]+", text.lower()) if word in WORDS)
        for node in ast.walk(tree):
            if isinstance(node, Function):
                wide += [f"{place}:{node.name}"] * (arguments(node) > MOST_PARAMETERS)
                long += [f"{place}:{node.name}"] * (body_lines(node) > LONGEST_BODY)
        large += [place] * (lines - sum(n for _, n in texts) > LONGEST_FILE)
    return Style(numbers, words, wide, long, large)


def with_zeros(text: str) -> str:
    """The text with a zero before each decimal point that has no digit there."""
    return WITHOUT_ZERO.sub("0.", text)


def report(name: str, style: Style) -> str:
    """The numbers as lines of text."""
    of = style.numbers
    share = 100 * of["one_line"] / max(of["public"] - of["undocumented"], 1)
    rows = [
        ("files", f"{of['files']}, {of['lines']} lines, {of['code']} of code"),
        ("public names", f"{of['public']}, {of['undocumented']} without a docstring"),
        ("docstrings of one line", f"{share:.0f} %"),
        ("with an example", f"{of['with_example']} of {of['offered']} public classes and functions"),
        ("comments", f"{100 * of['comments'] / max(of['lines'], 1):.1f} per 100 lines"),
        (f"functions of > {MOST_PARAMETERS} parameters", f"{len(style.wide)}"),
        (f"bodies of > {LONGEST_BODY} lines", f"{len(style.long)}"),
        (f"files of > {LONGEST_FILE} lines but docstrings", f"{len(style.large)}"),
        ("words", ", ".join(f"{word} {count}" for word, count in style.words.most_common())),
    ]
    return "\n".join([name, *(f"  {key:38} {value}" for key, value in rows)])


def main() -> None:
    """Print the numbers of the folders that are named."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folders", nargs="*", type=Path, default=[HERE])
    parser.add_argument("--pages", action="store_true", help="write zeros before decimal points into the pages")
    options = parser.parse_args()
    for page in PAGES if options.pages else ():
        page.write_text(with_zeros(page.read_text(encoding="utf-8")), encoding="utf-8")
    for folder in options.folders if not options.pages else ():
        print(report(str(folder), measure(folder)))


if __name__ == "__main__":
    main()
