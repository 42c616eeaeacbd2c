"""The result of a verb: a frozen object that holds its numbers and can print, tabulate, draw and save them."""

import abc
import base64
import html
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from covariant._optional import load_optional
from covariant.verbs.base.outputs import FIGURES, check_output, has_columns
from scalargraph.errors import InputError


class WrittenFiles(list[Path]):
    """Paths of the files that were written, which a notebook shows as links."""

    def _repr_html_(self) -> str:
        links = (f'<a href="{html.escape(path.as_posix())}">{html.escape(str(path))}</a>' for path in self)
        return "wrote " + ", ".join(links)


_TABLES = (
    "<style>.covariant table td, .covariant table th {text-align: left} "
    ".covariant table .number {text-align: right}</style>"
)
"""Notebooks align all cells to the right, and sentences too."""


def _html(text: str) -> str:
    """The printed text in HTML: its tables as tables, its lines as lines, and everything else escaped."""
    try:
        from markdown_it import MarkdownIt
    except ImportError:  # it comes with the command line's `rich`
        return f"<pre>{html.escape(text)}</pre>"
    # The rules of "zero" leave signs such as * and _ alone: the text has names of columns, not emphasis.
    return MarkdownIt("zero", {"breaks": True}).enable(["table", "newline"]).render(text)


class AbstractResult(abc.ABC):
    """Result of a verb, such as `estimate`: its numbers, and the means to print, draw and save them.

    `str(result)` is the text that the command line prints, `repr(result)` one line of it, and `result.summary` the
    same numbers as plain data, as the option `--json` prints them. A result is complete before anything is drawn or
    written, so that a failure later loses nothing. Subclasses are frozen dataclasses.

    Example:
        >>> from dataclasses import dataclass
        >>> from covariant import verbs
        >>> @dataclass(frozen=True, repr=False)
        ... class MeanResult(verbs.AbstractResult):
        ...     mean: float
        ...
        ...     @property
        ...     def summary(self):
        ...         return {"mean": self.mean}
        ...
        ...     @property
        ...     def headline(self):
        ...         return f"mean {self.mean:g} m"
        ...
        ...     def __str__(self):
        ...         return self.headline
        >>> MeanResult(0.5)
        <MeanResult: mean 0.5 m>
    """

    @property
    @abc.abstractmethod
    def summary(self) -> dict[str, Any]:
        """All numbers and sentences of the result as plain data that `json.dumps` accepts."""

    @property
    @abc.abstractmethod
    def headline(self) -> str:
        """The result in one line, such as "5000 rows, intrinsic observer, velocity RMSE 0.031 rad/s"."""

    warnings = tuple[str, ...]()
    """Sentences on what was unusual, in the order in which they are printed; empty by default."""

    @abc.abstractmethod
    def __str__(self) -> str:
        """The text that the command line prints."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.headline}>"

    def _repr_html_(self) -> str:
        """What a notebook shows: headline, warnings, the tables of the page or else the text, and the figure."""
        warnings = (f'<p style="color:#b45309;margin:0">⚠ {html.escape(each)}</p>' for each in self.warnings)
        parts = [f"<p><b>{html.escape(self.headline)}</b></p>", *warnings]
        blocks = self._blocks
        if blocks:
            from covariant.report import block_html

            parts += [_TABLES, '<div class="covariant">', *(block_html(block, "") for block in blocks), "</div>"]
        else:
            rest = str(self)
            for warning in self.warnings:
                rest = rest.replace(warning, "")
            parts.append(_html(rest))
        try:
            picture = self._figure()._repr_png_()
        except InputError:  # a result without a figure, or nothing that draws
            return "".join(parts)
        alt = html.escape(self.headline, quote=True)
        image = f'<img src="data:image/png;base64,{base64.b64encode(picture).decode()}" alt="{alt}">'
        return "".join([*parts, image])

    _blocks = tuple[Any, ...]()
    """Paragraphs, headings and rows of tables that the page has, and a notebook; empty where there is only text."""

    written: ClassVar[tuple[str, ...]] = ()
    """Suffixes of the file that `save` writes; none for a result that has no file."""

    _log = None
    """The log that was read, whose file is never replaced; None by default."""

    def save(self, path: str | Path, overwrite: bool = True) -> Path:
        """Write the result to a file, whole or not at all.

        Args:
            path: The file to write; its suffix, one of `written`, chooses the format.
            overwrite: Whether a file that exists may be replaced, other than the log that was read. A table that an
                earlier run wrote, with the same columns, is replaced in any case.

        Returns:
            The path.

        Raises:
            ValueError: For a suffix that the result does not have, a folder that does not exist, the path of the log
                that was read, or a result that has no file.
        """
        path = Path(path)
        if not self.written:
            raise InputError(f"{path}: a {type(self).__name__} has no file of its own to write; use report()")
        check_output(path, *self.written, log=self._log, overwrite=overwrite or self._wrote(path))
        self._write(path)
        return path

    def _wrote(self, path: Path) -> bool:
        """Whether a file is one that an earlier run of the same verb wrote, which is replaced without being asked."""
        return False

    def written_files(self, path: str | Path) -> list[Path]:
        """List the files that `save` writes.

        Args:
            path: The path that is given to `save`.

        Returns:
            The paths, that one first.
        """
        return [Path(path)]

    def _write(self, path: Path) -> None:
        """Write the file; for results that have one."""
        raise NotImplementedError

    def report(self, path: str | Path) -> list[Path]:
        """Write an interactive page, and figures (.png) beside it, all or none.

        Args:
            path: The page to write (.html).

        Returns:
            The paths of all files, a list that a notebook shows as links.

        Raises:
            ValueError: For a result that has no page, another suffix, or a folder that does not exist.
            ImportError: Without the packages that draw, `pip install 'covariant[report]'`; nothing is written then.
        """
        check_output(Path(path), ".html")
        return WrittenFiles(self._write_page(Path(path)))

    def _write_page(self, path: Path) -> list[Path]:
        raise InputError(f"{path}: a {type(self).__name__} has no page")

    def plot(self, path: str | Path | None = None) -> Any:
        """Draw the result.

        Args:
            path: Where the figure is written as well (.png, .pdf, .svg); by default it is not.

        Returns:
            A `matplotlib.figure.Figure`.

        Raises:
            ValueError: For a result that has no figure.
            ImportError: Without matplotlib.
        """
        if path is not None:
            check_output(Path(path), *FIGURES)
        figure = self._figure()
        if path is not None:
            from covariant.report import save_figure

            save_figure(figure, path)
        return figure

    def _figure(self) -> Any:
        raise InputError(f"a {type(self).__name__} has no figure")

    def draw(self, path: str | Path) -> list[Path]:
        """Draw the figures of the result into files.

        Args:
            path: The file of the first figure (.png, .pdf, .svg).

        Returns:
            The paths of all files.

        Raises:
            ValueError: For a result that has no figure.
        """
        self.plot(path)
        return [Path(path)]


class AbstractTable(AbstractResult):
    """Result whose numbers are a table: columns by name, all of one length.

    Example:
        >>> import covariant
        >>> table = covariant.simulate("oscillator", duration=1.0, rate=10.0)
        >>> isinstance(table, covariant.verbs.AbstractTable)
        True
        >>> table.columns["q"].shape, table.units["true_v"]
        ((11,), 'm/s')
    """

    @property
    @abc.abstractmethod
    def columns(self) -> dict[str, np.ndarray]:
        """The columns (T,) of the table by name, in order."""

    def _wrote(self, path: Path) -> bool:
        # A log may have the very columns of the result; then a file with them may be another log.
        log = self._log
        is_log = isinstance(log, str | Path) and has_columns(Path(log), self.columns)
        return has_columns(path, self.columns) and not is_log

    @property
    def units(self) -> dict[str, str]:
        """Units, such as "rad/s", by name of the column; columns without a unit may be absent."""
        return {}

    def to_pandas(self) -> Any:
        """Convert the table to a `pandas.DataFrame`, with the units in its `attrs["units"]`.

        Raises:
            ImportError: Without pandas.
        """
        pandas = load_optional("pandas", use="to_pandas needs", extra="tables")
        table = pandas.DataFrame(self.columns)
        table.attrs["units"] = self.units
        return table

    def to_xarray(self) -> Any:
        """Convert the table to an `xarray.Dataset` along its first column, with the units in each `attrs["units"]`.

        Raises:
            ImportError: Without xarray.
        """
        xarray = load_optional("xarray", use="to_xarray needs", extra="scale")
        index, *names = self.columns
        data = {name: (index, self.columns[name], {"units": self.units.get(name, "")}) for name in names}
        return xarray.Dataset(data, coords={index: self.columns[index]})
