"""What every verb returns: a frozen object that holds its numbers and can print, tabulate, draw and save them."""

import abc
import html
from pathlib import Path
from typing import Any

import numpy as np

from covariant._optional import load_optional


class AbstractResult(abc.ABC):
    """The result of a verb: complete before anything is drawn or written, so that what fails later loses nothing.

    `str(result)` is the text that the command line prints, `repr(result)` one line of it, and `result.summary` the
    same numbers as plain data, as the option `--json` prints them. Subclasses are frozen dataclasses.
    """

    @property
    @abc.abstractmethod
    def summary(self) -> dict[str, Any]:
        """All numbers and sentences of the result as plain data that `json.dumps` accepts."""

    @property
    @abc.abstractmethod
    def headline(self) -> str:
        """The result in one line, such as "5000 rows, intrinsic observer, velocity RMSE 0.031 rad/s"."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on what was odd; none where nothing was."""
        return ()

    @abc.abstractmethod
    def __str__(self) -> str:
        """The text that the command line prints."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.headline}>"

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        return f"<b>{html.escape(self.headline)}</b><pre>{html.escape(str(self))}</pre>"

    def save(self, path: str | Path, overwrite: bool = True) -> Path:
        """Write the result to a file, whole or not at all. Raises `ValueError` where a result has no file."""
        raise ValueError(f"{path}: a {type(self).__name__} has no file of its own to write; use report()")

    def report(self, path: str | Path) -> list[Path]:
        """Write an interactive page (.html), and figures beside it; returns all paths.

        Raises `ValueError` where a result has no page, and `ImportError` without the packages that draw.
        """
        raise ValueError(f"{path}: a {type(self).__name__} has no page")

    def plot(self, path: str | Path | None = None) -> Any:
        """Draw the result; the figure is written where a path is given. Raises `ValueError` where a result has none."""
        raise ValueError(f"a {type(self).__name__} has no figure")

    def draw(self, path: str | Path) -> list[Path]:
        """Draw the figures of the result into files, the first at `path`; returns all paths."""
        self.plot(path)
        return [Path(path)]


class AbstractTable(AbstractResult):
    """A result whose numbers are a table: columns by name, all of one length."""

    @property
    @abc.abstractmethod
    def columns(self) -> dict[str, np.ndarray]:
        """The columns (T,) of the table by name, in order."""

    @property
    def units(self) -> dict[str, str]:
        """Units of the columns that have one, by name."""
        return {}

    def to_pandas(self) -> Any:
        """The table as a `pandas.DataFrame`; raises `ImportError` without pandas."""
        pandas = load_optional("pandas", use="to_pandas needs", extra="tables")
        table = pandas.DataFrame(self.columns)
        table.attrs["units"] = self.units
        return table

    def to_xarray(self) -> Any:
        """The table as an `xarray.Dataset` along its first column; raises `ImportError` without xarray."""
        xarray = load_optional("xarray", use="to_xarray needs", extra="scale")
        index, *names = self.columns
        data = {name: (index, self.columns[name], {"units": self.units.get(name, "")}) for name in names}
        return xarray.Dataset(data, coords={index: self.columns[index]})
