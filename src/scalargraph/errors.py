"""Defines the error of refused input, and shows file names and texts in printable form."""

import os


def printable(text: str, keep: str = "\n\t") -> str:
    r"""A text in which every character that cannot be shown is replaced by its escape.

    Such characters are control characters, marks that change the writing direction, and the surrogates by which Python
    represents bytes of a file name that are not UTF-8; tables and pages cannot contain the latter.

    Example:
        >>> from scalargraph.errors import printable
        >>> print(printable("run\x1b[2J\udcff.csv"))
        run\x1b[2J\udcff.csv
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else ascii(c)[1:-1] for c in text)


def file_name(path: str | os.PathLike[str]) -> str:
    """A path as one printable line, as it is written in tables, pages and messages."""
    return printable(os.fspath(path), keep="")


class InputError(ValueError):
    """Error of a file, a column or an argument that cannot be used.

    The message is one line: the file, column or argument, the value found, and what to do. Every refusal of the library
    is an `InputError`; any other exception that leaves a function is a bug. The command line prints an `InputError` as
    one line with exit code 2, and any other exception with its traceback.

    It is a `ValueError`, so that one `except` also catches errors of NumPy and JAX. The message is made `printable`,
    since it contains names of files and cells of logs.

    Attributes:
        exit_code: Exit code of a command that ends with this error.

    Example:
        >>> from scalargraph import box
        >>> from scalargraph.errors import InputError
        >>> try:
        ...     box(x=(1.0, 0.0, "m"))
        ... except InputError as error:
        ...     print(error)
        bounds of x must be finite, the lower one first; got 1 to 0
    """

    exit_code = 2

    def __init__(self, *details: object):
        super().__init__(*(printable(each) if isinstance(each, str) else each for each in details))


class MissingPackageError(InputError, ImportError):
    """Error of an optional package that is not installed; the message has the line that installs it.

    Example:
        >>> from scalargraph.errors import MissingPackageError
        >>> issubclass(MissingPackageError, ImportError)
        True
    """
