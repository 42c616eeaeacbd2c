"""Rewrites model files with other values, keeping their comments and layout."""

import json
import re
from typing import Any

from covariant._door import parse_toml
from covariant.models.files import _toml
from scalargraph.errors import InputError

_TOKEN = re.compile(
    r"""(?P<skip>#[^\n]*|"(?:[^"\\\n]|\\.)*"|'[^'\n]*')|(?P<number>[+-]?(?:[0-9][0-9_]*\.?[0-9_]*)(?:[eE][+-]?[0-9]+)?)"""
)
"""A comment, a string, or a number in the text of a value."""


def rewrite(text: str, content: dict[str, Any]) -> str:
    """Change values in the text of a model file.

    Numbers are replaced in place, so comments and layout remain. A new key replaces a comment that drafts it, such as
    `# acceleration = 2.0`, or is added at the end of its table.

    Args:
        text: Text of a model file.
        content: The document with the new values, as after `tomllib.loads`.

    Returns:
        The new text.

    Raises:
        ValueError: The file writes a table in an unsupported way, such as `parameters.mass = 1`; the message names it.

    Example:
        >>> from covariant import models
        >>> text = "[design]\\ndamping = 0.7  # of the error"
        >>> print(models.rewrite(text, {"design": {"damping": 0.5}}))
        [design]
        damping = 0.5  # of the error
    """
    before = parse_toml(text)
    stated = _tables(before, text)
    for table, values in _tables(content, text).items():
        old = stated.get(table, {})
        for key in [key for key in old if key not in values]:
            text = _replace_value(text, table, key, None)
        for key, value in values.items():
            if key not in old or old[key] != value:
                text = _replace_value(text, table, key, value, old.get(key))
    try:
        after = parse_toml(text)
    except InputError:  # a table written as parameters.mass = 1 now exists twice
        after = before
    wrong = next((table for table in content if after.get(table) != content[table]), None)
    if wrong is not None:
        raise InputError(f"[{wrong}] is written in a way that cannot be changed; write it as lines key = value")
    return text


def _tables(content: dict[str, Any], text: str) -> dict[str, dict[str, Any]]:
    """The tables of a document by their headers: one for each servo and loop, and each nested table that has a header
    in the text, such as [parameters.armature]."""
    tables, several = {}, (_toml.SERVO, _toml.LOOP)

    def add(header: str, values: dict[str, Any]) -> None:
        headers = {key: f"{header}.{_key(key)}" for key, entry in values.items() if isinstance(entry, dict)}
        within = {key: name for key, name in headers.items() if header in several or _has_header(text, name)}
        if header not in several:
            tables[header] = {key: entry for key, entry in values.items() if key not in within}
        for key, name in within.items():
            add(name, values[key])

    for header, values in content.items():
        if isinstance(values, dict):
            add(header, values)
    return tables


def _has_header(text: str, table: str) -> bool:
    """Whether a text has a header for a table, or for one nested in it."""
    return re.search(rf"^[ \t]*\[[ \t]*{re.escape(table)}[ \t]*[.\]]", text, re.MULTILINE) is not None


def _replace_value(text: str, table: str, key: str, value: object, old: object = None) -> str:
    """The text with one value changed, removed if it is None, or added at the end of its table."""
    begin, end = _span(text, table)
    if begin is None:
        return f"{text.rstrip()}\n\n[{table}]\n{key} = {written(value)}\n"
    line = re.compile(rf"^[ \t]*(?:{re.escape(key)}|\"{re.escape(key)}\")[ \t]*=[ \t]*", re.MULTILINE)
    match = line.search(text, begin, end)
    if match is None:
        drafted = re.compile(rf"^[ \t]*#[ \t]*{re.escape(key)}[ \t]*=[ \t]*", re.MULTILINE).search(text, begin, end)
        if drafted is not None and _is_value(text[drafted.end() : _value_end(text, drafted.end())]):
            # The commented draft of a key is replaced; if it stayed, uncommenting it later would define the key twice.
            return f"{text[: drafted.start()]}{key} = {written(value)}{text[_value_end(text, drafted.end()) :]}"
        body = text[begin:end].rstrip()
        return f"{text[:begin]}{body}\n{key} = {written(value)}\n{text[begin + len(body) :].removeprefix(chr(10))}"
    stop = _value_end(text, match.end())
    if value is None:
        return text[: match.start()] + text[text.find("\n", stop) + 1 :]
    return text[: match.end()] + _value(text[match.end() : stop], value, old) + text[stop:]


def _is_value(text: str) -> bool:
    """Whether a text is a TOML value, and not prose."""
    try:
        return bool(parse_toml(f"key = {text}"))
    except InputError:
        return False


def _span(text: str, table: str) -> tuple[int | None, int]:
    """Begin and end of the lines of a table."""
    head = re.search(rf"^[ \t]*\[[ \t]*{re.escape(table)}[ \t]*\][^\n]*\n", text, re.MULTILINE)
    if head is None:
        return None, 0
    header = re.compile(r"^[ \t]*\[[ \t]*[A-Za-z\"'\[]", re.MULTILINE)  # excludes rows and ends of matrices
    following = header.search(text, head.end())
    return head.end(), following.start() if following else len(text)


def _value_end(text: str, begin: int) -> int:
    """End of a value that begins at a position: its closing bracket, a comment, or the end of the line."""
    depth, position = 0, begin
    while position < len(text):
        token = _TOKEN.match(text, position)
        if token and token.lastgroup == "skip" and not (text[position] == "#" and depth == 0):
            position = token.end()
            continue
        depth += {"[": 1, "{": 1, "]": -1, "}": -1}.get(text[position], 0)
        if depth == 0 and text[position] in "#\n":
            break
        position += 1
        if depth == 0 and text[position - 1] in "]}":
            return position
    return begin + len(text[begin:position].rstrip())


def _value(text: str, value: object, old: object) -> str:
    """The text of a value with other numbers, if their count is the same as before; otherwise it is written anew."""
    before, after = _leaves(old), _leaves(value)
    tokens = [token for token in _TOKEN.finditer(text) if token.lastgroup == "number"]
    # Hexadecimal numbers match as several tokens, inf and nan as none, so the counts differ then.
    if not len(before) == len(after) == len(tokens) or not all(isinstance(leaf, int | float) for leaf in after):
        return written(value)
    # The tokens are replaced from the end, so that the positions of earlier ones remain valid.
    for token, previous, current in reversed(list(zip(tokens, before, after, strict=True))):
        if previous != current:
            text = text[: token.start()] + written(current) + text[token.end() :]
    return text


def _leaves(value: object) -> list[Any]:
    return [leaf for entry in value for leaf in _leaves(entry)] if isinstance(value, list) else [value]


def written(value: object) -> str:
    """A value as TOML; a dictionary becomes an inline table."""
    if isinstance(value, list):
        return "[" + ", ".join(map(written, value)) + "]"
    if isinstance(value, dict):
        pairs = (f"{_key(key)} = {written(entry)}" for key, entry in value.items())
        return "{ " + ", ".join(pairs) + " }"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)  # JSON's escapes are among those of TOML
    return str(value).lower() if isinstance(value, bool) else repr(value)


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else written(key)
