"""Reads logs as text: detects header, delimiter and decimal mark, and leaves comments out."""

import csv
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from covariant._door import MOST_COLUMNS, TEXT_LOG
from covariant._numbers import DECIMAL, NUMBER
from covariant.logs._columns import LogError
from scalargraph.files import read_bytes

DELIMITERS = {"\t": "tabs", ";": "semicolons", ",": "commas", "|": "strokes", " ": "spaces"}
"""Delimiters of cells with their names, the least ambiguous first; any number of spaces counts as one delimiter."""
LONGEST_LINE = 2**20
"""Longest line [bytes] that is accepted in header and sample."""
SAMPLE = 30
"""Number of rows from which the delimiter is determined."""
_NOTHING = re.compile(rb"^[ \t]*(?:[#%][^\n]*)?(?:\n|\Z)", re.MULTILINE)
"""A line that is empty or a comment."""
DATE = r"^\s*[0-9]{4}-[0-9]{2}-[0-9]{2}"
"""Beginning of a date."""
TIME_OF_DAY = (
    r"^\s*(?:[0-9]{1,4}[-/.][0-9]{1,2}[-/.][0-9]{1,4}[T ,]+)?(?:(?P<days>[0-9]+) days? \+?)?"
    r"(?:(?P<hours>[0-9]{1,2}):)?(?P<minutes>[0-9]{1,2}):"
    r"(?P<seconds>[0-9]{2}(?:[.,][0-9]*)?)(?:\s*(?P<half>[AaPp])\.?[Mm]\.?)?\s*$"
)
"""A time of day, as 14:43:24.754 or 2:43:24 PM, perhaps after a date that is not in the order of ISO 8601; or the time
since the start, as pandas writes it."""
_COMMA = r"^(\s*[+-]?[0-9]*),([0-9]+(?:[eE][+-]?[0-9]+)?\s*)$"
_CERTAIN_COMMA = r"^\s*[+-]?(?:0*,[0-9]+|[0-9]+,(?:[0-9]{1,2}|[0-9]{4,})|[0-9]{4,},[0-9]+)(?:[eE][+-]?[0-9]+)?\s*$"
"""A number whose comma cannot separate thousands."""
_POINT = r"^\s*[+-]?(?:[0-9]+\.[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?\s*$"


class Sheet(NamedTuple):
    """The text of a log, split into its parts.

    Attributes:
        header: Names of the columns; 1, 2, 3 and so on if the file has none.
        delimiter: Character between two cells, a key of `DELIMITERS`.
        rows: Bytes of the rows in UTF-8, without comments and empty lines.
        first_line: The first line of a file without a header; empty if there is a header.
    """

    header: list[str]
    delimiter: str
    rows: bytes
    first_line: str = ""


def sheet(path: Path) -> Sheet:
    """Read a text file, and detect its delimiter and header."""
    text = _unix(read_bytes(path, TEXT_LOG))
    remark = _remark(text)
    text = _NOTHING.sub(b"", text)
    first, _, rows = text.partition(b"\n")
    if not first.strip(b" \t"):
        raise LogError(f"{path}: the file is empty; its first line must name the columns")
    if max(map(len, (first, *rows.split(b"\n", SAMPLE)[:SAMPLE]))) > LONGEST_LINE:
        raise LogError(f"{path}: a line is longer than {LONGEST_LINE >> 20} MiB; put each row on its own line")
    lines = [first.decode(), *(line.decode() for line in rows.split(b"\n", SAMPLE)[:SAMPLE] if line)]
    delimiter = next((d for d in DELIMITERS if _agrees(_split_cells(path, lines, d))), None) or _of_header(lines[0])
    header, *sample = _split_cells(path, lines, delimiter)
    if len(header) > MOST_COLUMNS:
        raise LogError(f"{path}: it has {len(header)} columns, more than {MOST_COLUMNS}; keep those of the machine")
    first_line = ""
    if remark and all(is_number(cell) for cell in header if cell):  # numpy.savetxt writes its header as a comment
        names = _split_cells(path, [remark.replace(",", " ") if delimiter == " " else remark], delimiter)[0]
        if len(names) == len(header):
            # The first line has only numbers, and the last comment has as many cells: the comment is the header.
            header, sample, rows = names, [header, *sample], text
    if _is_row(header, sample):
        # The first line is a measurement too, although its cells now have names.
        first_line, sample, rows = lines[0], [header, *sample], text
        header = [str(k + 1) for k in range(max(map(len, sample)))]
    # If only the rows, or only the header, end with a delimiter, the other one lacks an empty cell, added here.
    if header[-1] and sample and all(len(row) == len(header) + 1 and not row[-1] for row in sample):
        header = [*header, ""]
    elif not header[-1] and sample and all(len(row) == len(header) - 1 for row in sample):
        header = header[:-1]
    if delimiter == "," and not header[-1] and sample and all(row[-1].isdigit() for row in sample):
        raise LogError(
            f"{path}: the last column has no name, and its first cell is {sample[0][-1]!r}: are the commas of the rows "
            "decimal marks? write numbers with a decimal point, or give the column a name"
        )
    if delimiter == " ":
        rows = re.sub(rb"[ \t]+", b" ", re.sub(rb"(?m)^[ \t]+|[ \t]+$", b"", rows))
    return Sheet(header, delimiter, rows, first_line)


def _is_row(header: list[str], sample: list[list[str]]) -> bool:
    """Whether the first line is a row: no cell is a word above numbers, and the numbers do not just count the columns.

    pandas writes such a count above columns without names; it differs in form from the rows.
    """
    numbers = [cell for cell in header if _is_value(cell)]
    below = [[row[k] for row in sample if k < len(row) and row[k]] for k in range(len(header))]
    for cell, column in zip(header, below, strict=True):
        if cell and not _is_value(cell) and all(map(_is_value, column)):
            return False
    is_count = numbers in ([str(first + k) for k in range(len(numbers))] for first in (0, 1))
    return bool(numbers) and (not is_count or all(cell.isdigit() for column in below for cell in column))


def _is_value(cell: str) -> bool:
    """Whether a cell contains a value, as in a row: a number, NaN, a date, or a time of day."""
    times = re.match(DATE, cell) or re.match(TIME_OF_DAY, cell)
    return is_number(cell) or re.fullmatch(NUMBER, cell) is not None or times is not None


def read_text(pa: ModuleType, path: Path, found: Sheet, wanted: Sequence[str]) -> Any:
    """Read columns of a sheet as text."""
    if not found.rows.strip():
        raise LogError(f"{path}: the file has a header and no rows")
    ragged = []
    # Columns are selected by position, since two of them may have the same name.
    places = [str(place) for place, name in enumerate(found.header) if name in wanted]
    table = pa.csv.read_csv(
        pa.BufferReader(found.rows),
        # With several threads Arrow would not know the number of an invalid row.
        read_options=pa.csv.ReadOptions(
            use_threads=False, column_names=[str(place) for place in range(len(found.header))]
        ),
        parse_options=pa.csv.ParseOptions(
            delimiter=found.delimiter, invalid_row_handler=lambda row: ragged.append(row) or "skip"
        ),
        convert_options=pa.csv.ConvertOptions(
            include_columns=places,
            column_types=dict.fromkeys(places, pa.string()),
            # Only empty cells count as missing: Arrow's default list has words such as NA, which are faults here.
            null_values=[""],
            strings_can_be_null=True,
        ),
    )
    if ragged:
        row = ragged[0]
        raise LogError(
            f"{path}: row {row.number} has {row.actual_columns} cells where the header has {row.expected_columns}: "
            f"{row.text[:60]!r}; a missing measurement is an empty cell between its {DELIMITERS[found.delimiter]}"
        )
    # A quoted cell may contain line breaks, but if its closing mark is missing, it swallows whole rows.
    if b'"' in found.rows and table.num_rows < found.rows.strip(b"\n").count(b"\n") + 1:
        _check_quotes(path, found)
    table = table.rename_columns([found.header[int(place)] for place in table.column_names])
    if found.delimiter == ",":
        for name, column in zip(table.column_names, table.columns, strict=True):
            row = _matching(pa, column, _COMMA)
            if row is not None:
                raise LogError(
                    f"{path}: column {name!r}, row {row + 1}: found {column[row].as_py()!r} in a file "
                    "whose cells have commas between them: a decimal mark or thousands? write numbers with a decimal "
                    "point and no other commas, or put semicolons between cells"
                )
    return table


def _check_quotes(path: Path, found: Sheet) -> None:
    """Raise `LogError` if a line of a quoted cell has as many cells as a row."""
    cells = _split_lines(path, found.rows.decode().splitlines(keepends=True), found.delimiter)
    for row, line in enumerate((line for line in cells if line), 1):
        for cell in line:
            if any(part.count(found.delimiter) >= len(found.header) - 1 for part in cell.split("\n")[1:]):
                raise LogError(
                    f"{path}: row {row} has a quotation mark that is not closed before the next row: {cell[:60]!r}; "
                    "close it, or take it away"
                )


def with_points(pa: ModuleType, log: str, table: Any, certain: bool) -> Any:
    """Replace decimal commas by points. If they are not `certain`, a single 1,234 may also mean a thousand."""
    texts = [name for name in table.column_names if pa.types.is_string(table.schema.field(name).type)]
    commas = {name: _matching(pa, table.column(name), _COMMA) for name in texts}
    certain |= any(_matching(pa, table.column(name), _CERTAIN_COMMA) is not None for name in texts)
    for name, row in commas.items():
        if row is not None and not certain:
            raise LogError(
                f"{log}: column {name!r}, row {row + 1}: found the text {table.column(name)[row].as_py()!r}, whose "
                "comma may be a decimal mark or one between thousands; write numbers with a decimal point"
            )
    commas = {name: row for name, row in commas.items() if row is not None}
    for name in texts if commas else ():
        row = _matching(pa, table.column(name), _POINT)
        if row is not None:
            other, its = next(iter(commas.items()))
            raise LogError(
                f"{log}: column {other!r}, row {its + 1}: found {table.column(other)[its].as_py()!r}, and column "
                f"{name!r}, row {row + 1}, has {table.column(name)[row].as_py()!r}; use one decimal mark, and no "
                "commas between thousands"
            )
    for name in commas:
        pointed = pa.compute.replace_substring_regex(table.column(name), _COMMA, r"\1.\2")
        table = table.set_column(table.column_names.index(name), name, pointed)
    return table


def _matching(pa: ModuleType, column: Any, pattern: str) -> int | None:
    """The first row whose text matches a pattern."""
    if "," in pattern and not pa.compute.any(pa.compute.match_substring(column, ",")).as_py():
        return None
    row = pa.compute.index(pa.compute.match_substring_regex(column, pattern), True).as_py()
    return row if row >= 0 else None


def _unix(text: bytes) -> bytes:
    """The text in UTF-8 without a byte order mark, with each line ended by a line feed."""
    if text[:2] in (b"\xff\xfe", b"\xfe\xff"):
        text = text.decode("utf-16").encode()
    text = text.removeprefix(b"\xef\xbb\xbf")
    return text.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in text else text


def _remark(text: bytes) -> str:
    """The last comment before the first line that is not a comment, without its comment mark."""
    last = b""
    for line in text.split(b"\n", SAMPLE):
        plain = line.strip(b" \t")
        if plain and plain[:1] not in b"#%":
            break
        last = plain or last
    return last.lstrip(b"#% \t").decode()


def _split_cells(path: Path, lines: Sequence[str], delimiter: str) -> list[list[str]]:
    """The cells of each line, without surrounding spaces."""
    if delimiter == " ":
        lines = [" ".join(line.split()) for line in lines]
    return [[cell.strip() for cell in row] for row in _split_lines(path, lines, delimiter)]


def _split_lines(path: Path, lines: Sequence[str], delimiter: str) -> Iterator[list[str]]:
    """The cells of each line; raises `LogError` for a cell that is longer than `csv` allows."""
    reader = csv.reader(lines, delimiter=delimiter)
    try:
        yield from reader
    except csv.Error as error:
        raise LogError(
            f"{path}: line {reader.line_num} without comments has a cell of more than {csv.field_size_limit():,} "
            "letters; take that column away, or close the quotation mark before it"
        ) from error


def _agrees(rows: list[list[str]]) -> bool:
    """Whether a delimiter gives all lines the same number of cells; header and rows may differ by one cell."""
    header, *others = rows
    widths = {len(row) for row in others} or {len(header)}
    return len(header) > 1 and len(widths) == 1 and abs(len(header) - widths.pop()) <= 1


def _of_header(line: str) -> str:
    """The delimiter of a file whose rows do not agree: the first delimiter that its header contains."""
    return next((delimiter for delimiter in DELIMITERS if delimiter in line), ",")


def is_number(cell: str) -> bool:
    """Whether a cell holds a number, with a decimal point or a decimal comma."""
    return re.fullmatch(DECIMAL, cell.replace(",", ".")) is not None
