"""Converts trees of boxes and graphs of scalars to data for a file, and back."""

import string
from collections.abc import Sequence

import numpy as np

from scalargraph import FOLD, Lowered
from scalargraph.errors import InputError
from scalargraph.proofs._file import MOST_VALUES, Field, is_number

LETTERS = string.ascii_letters
"""One letter for each variable across whose middle a box may be halved; leaves are dots, open leaves question marks."""
MOST_LEVELS, MOST_LETTERS = 400, 10**7
"""Largest number of levels of a tree, and of letters of all trees of a file together."""
ARGUMENTS = {op: range(n := fold.nin if isinstance(fold, np.ufunc) else 3, n + 1) for op, fold in FOLD.items()}
ARGUMENTS |= {"either": range(4, 5), "stumpff": range(2, 3)}
"""Operations of a graph of scalars, with the allowed numbers of their arguments."""


def to_letters(levels: Sequence[np.ndarray]) -> list[str]:
    """A tree of boxes as text, for a file.

    Args:
        levels: One array of integers for each level, as in `Proof.levels`.

    Returns:
        One string for each level, with one character for each box: the letter of the variable that is halved, "." for
        proved, "?" for open.

    Raises:
        ValueError: A variable has no letter: there are more than 52.

    Example:
        >>> import numpy as np
        >>> from scalargraph.proofs import OPEN, PROVED, to_letters
        >>> to_letters([np.array([1]), np.array([PROVED, OPEN])])
        ['b', '.?']
    """
    most = max((int(codes.max()) for codes in levels if codes.size), default=-1) + 1
    if most > len(LETTERS):
        raise InputError(f"files hold trees over at most {len(LETTERS)} variables; this one halves {most}")
    table = np.array([ord(c) for c in LETTERS + "?."], np.uint8)  # indices −1 and −2 select the last two characters
    return [table[codes].tobytes().decode("ascii") for codes in levels]


def from_letters(levels: Sequence[str]) -> list[np.ndarray]:
    """Convert the strings of `to_letters` back to a tree of boxes.

    Args:
        levels: One string for each level.

    Returns:
        One array of integers for each level: the index of the variable that is halved, −1 for proved, −2 for open.

    Raises:
        KeyError: A character is not one of these; `saved_levels` checks that.

    Example:
        >>> from scalargraph.proofs import from_letters
        >>> [codes.tolist() for codes in from_letters(["b", ".?"])]
        [[1], [-1, -2]]
    """
    codes = {letter: code for code, letter in enumerate(LETTERS)} | {".": -1, "?": -2}
    return [np.array([codes[letter] for letter in level], int) for level in levels]


def saved_levels(field: Field, variables: int) -> tuple[str, ...]:
    """Read the levels of a tree from a file, and check that it covers its box: both halves of each halved box exist.

    Args:
        field: The list of strings, as written by `to_letters`.
        variables: Number of variables of the box.

    Returns:
        The strings, one for each level.

    Raises:
        ValueError: The strings do not form a tree over a box of so many variables.

    Example:
        >>> from scalargraph.proofs import Field, saved_levels
        >>> saved_levels(Field("claims.json", "levels", ["a", ".."]), 1)
        ('a', '..')
    """
    field.need(variables <= len(LETTERS), f"a tree over at most {len(LETTERS)} variables, not {variables}")
    rows, known, size = field.rows(1, MOST_LEVELS), set(LETTERS[:variables]) | {".", "?"}, 1
    for row in rows:
        fits = type(row.value) is str and len(row.value) == size and known >= set(row.value)
        row.need(fits, f"{size} of the letters a to {LETTERS[variables - 1]}, dots and question marks")
        # Each box that is not a leaf has two halves on the next level, so a tree is complete if the count ends at
        # zero.
        size = 2 * (size - row.value.count(".") - row.value.count("?"))
    field.need(size == 0, f"levels down to the last boxes, of which {size} are missing")
    return tuple(row.value for row in rows)


def saved_graph(field: Field) -> dict[str, list]:
    """Read the rows of a graph of scalars from a file, and check that they refer to earlier rows only.

    Args:
        field: The object with "nodes" and "outputs", as written by `graph_rows`.

    Returns:
        The same object as a dictionary of lists.

    Raises:
        ValueError: A row is not a known operation, or it refers to itself, to a later row, or to a row that is missing.

    Example:
        >>> from scalargraph.proofs import Field, saved_graph
        >>> rows = {"nodes": [["input", 0], ["add", 0, 0]], "outputs": [1]}
        >>> saved_graph(Field("claims.json", "graph", rows)) == rows
        True
    """
    fields = field.record(["nodes", "outputs"])
    nodes, outputs = fields["nodes"], fields["outputs"]
    nodes.need(isinstance(nodes.value, list), "a list of rows")
    for k, row in enumerate(nodes.value):
        if not _is_node(row, k):
            wanted = "[operation, numbers of earlier rows ...], ['input', number] or ['constant', value]"
            Field(field.file, f"{nodes.key}[{k}]", row).refuse(wanted)
    rows = outputs.rows(0, MOST_VALUES)
    return {"nodes": nodes.value, "outputs": [row.whole(0, len(nodes.value) - 1) for row in rows]}


def _is_node(row: object, k: int) -> bool:
    """Whether a row k of a graph is valid: a constant, an input, or an operation on earlier rows."""
    if not (type(row) is list and row and type(row[0]) is str):
        return False
    op, *arguments = row
    if op == "constant":
        return len(arguments) == 1 and (type(arguments[0]) is bool or is_number(arguments[0]))
    if op == "input":
        return len(arguments) == 1 and type(arguments[0]) is int and 0 <= arguments[0] <= 9999
    known = op in ARGUMENTS and len(arguments) in ARGUMENTS[op]
    return known and all(type(argument) is int and 0 <= argument < k for argument in arguments)


def graph_rows(lowered: Lowered) -> dict[str, list]:
    """A graph of scalars as rows, for readers without JAX.

    Args:
        lowered: The graph, as from `scalargraph.lower`.

    Returns:
        "nodes": a row for each node, an operation and the numbers of earlier rows, ["input", number] or ["constant",
        value]; "outputs": the numbers of the rows that are results.

    Example:
        >>> import jax.numpy as jnp
        >>> from scalargraph import lower
        >>> from scalargraph.proofs import graph_rows
        >>> graph_rows(lower(lambda x: x * 2.0, jnp.zeros(())))
        {'nodes': [['input', 0], ['constant', 2.0], ['mul', 0, 1]], 'outputs': [2]}
    """
    rows = [[node.op, *(node.arguments or (node.value,))] for node in lowered.graph.nodes]
    return {"nodes": rows, "outputs": list(lowered.outputs)}
