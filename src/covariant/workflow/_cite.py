"""`cite`: the works behind an observer and the numbers of a model, for a paper that uses them."""

import functools
import importlib.resources
import re
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax

from covariant import models
from covariant._errors import InputError
from covariant._files import write_atomically
from covariant.calibration import estimators
from covariant.models import Overrides, Parameter
from covariant.observers import REGISTRY
from covariant.workflow._result import AbstractResult

PLACES = "journal", "booktitle", "publisher", "eprint"
"""Fields of a BibTeX entry that say where a work appeared."""


def cite(model: Any, *, observer: str | None = None, overrides: Overrides = ()) -> "CiteResult":
    """Say which works an observer and the numbers of a model are from, with BibTeX entries.

    Args:
        model: A model file (.toml), a robot, `module:attribute`, the name of a system, a `ModelFile`, or a system.
        observer: Name of the observer; by default the one that `estimate` would run.
        overrides: Values that replace those of the model file.

    Returns:
        The observer's source, the works it names, and where the numbers of the model are from.

    Raises:
        ValueError: For a model that cannot be loaded, or an observer that does not fit it.

    Example:
        >>> from covariant import workflow
        >>> cited = workflow.cite("ball_and_beam", observer="geodesic")
        >>> cited
        <CiteResult: geodesic on ball_and_beam: Aghannan & Rouchon 2003>
        >>> cited.bibtex.splitlines()[0]
        '@article{aghannan2003,'
    """
    name = models.spec_name(model)
    system = models.load(model, overrides).model
    fitting = estimators(system)
    observer = observer or fitting[0]
    if observer not in fitting:
        raise InputError(f"observer {observer} does not fit {name}; these do: {', '.join(fitting)}")
    source = next(entry.source for entry in REGISTRY if entry.name == observer)
    leaves = jax.tree.leaves(system, is_leaf=lambda leaf: isinstance(leaf, Parameter))
    numbers = dict.fromkeys(leaf.source for leaf in leaves if isinstance(leaf, Parameter))
    return CiteResult(name, observer, source, tuple(works_in(source)), tuple(numbers))


@dataclass(frozen=True, repr=False)
class CiteResult(AbstractResult):
    """The works that an observer and a model are from.

    Attributes:
        model_name: The model, by its path or name.
        observer_name: Name of the observer.
        source: Where the observer is from, with the equations, in words.
        works: The works that `source` names.
        numbers: Where the numbers of the model are from, in words, each once.

    Example:
        >>> from covariant import workflow
        >>> cited = workflow.cite("lorenz", observer="riccati")
        >>> [work.label for work in cited.works], cited.numbers
        (['Sanfelice & Praly 2015'], ('Lorenz 1963, section 7',))
    """

    model_name: str
    observer_name: str
    source: str
    works: tuple["Work", ...]
    numbers: tuple[str, ...]

    @property
    def bibtex(self) -> str:
        """BibTeX entries of the works, and of this library."""
        own = (
            f"@software{{covariant,\n  author = {{The covariant developers}},\n"
            f"  title = {{covariant: intrinsic and contracting observers}},\n  version = {{{version('covariant')}}}\n}}"
        )
        return "\n\n".join([*(work.bibtex for work in self.works), own])

    @property
    def headline(self) -> str:
        works = "; ".join(work.label for work in self.works) or self.source
        return f"{self.observer_name} on {self.model_name}: {works}"

    @property
    def summary(self) -> dict[str, Any]:
        return {
            "model": self.model_name,
            "observer": self.observer_name,
            "source": self.source,
            "works": [str(work) for work in self.works],
            "numbers": list(self.numbers),
            "bibtex": self.bibtex,
        }

    def __str__(self) -> str:
        lines = [f"Observer {self.observer_name}: {self.source}"]
        lines += [f"  {work}" for work in self.works]
        if self.numbers:
            lines.append(f"Numbers of {self.model_name}: {'; '.join(self.numbers)}")
        return "\n".join([*lines, "", self.bibtex])

    written = (".bib",)

    def _write(self, path: Path) -> None:
        write_atomically(path, lambda file: file.write(f"{self.bibtex}\n".encode()))


@dataclass(frozen=True)
class Work:
    """A published work, by its BibTeX entry as `references.bib` has it, with a field in each line."""

    bibtex: str

    @property
    def fields(self) -> dict[str, str]:
        """The fields of the entry by name; a title without the braces that keep its capitals."""
        return {
            name: value.strip("{}") for name, value in re.findall(r"^  (\w+) = \{(.*)\},?$", self.bibtex, re.MULTILINE)
        }

    @property
    def label(self) -> str:
        """How sentences name it: "Aghannan & Rouchon 2003"."""
        *others, last = [author.partition(",")[0] for author in self.fields["author"].split(" and ")]
        return f"{', '.join(others)}{' & ' if others else ''}{last} {self.fields['year']}"

    def __str__(self) -> str:
        fields = self.fields
        where = next(fields[place] for place in PLACES if place in fields)
        where = f"{fields['archiveprefix']}:{where}" if "archiveprefix" in fields else where
        number = f" {fields['volume']}" if "volume" in fields else ""
        number += f"({fields['number']})" if "number" in fields else ""
        pages = f", {fields['pages'].replace('--', '–')}" if "pages" in fields else ""
        doi = f", doi:{fields['doi']}" if "doi" in fields else ""
        return f"{self.label}: {fields['title']}. {where}{number}{pages}{doi}"


@functools.cache
def all_works() -> tuple[Work, ...]:
    """Every work that `source` of an observer in the registry names."""
    text = (importlib.resources.files("covariant.workflow") / "references.bib").read_text(encoding="utf-8")
    return tuple(map(Work, text.strip().split("\n\n")))


def works_in(text: str) -> list[Work]:
    """The works that a text, such as `source` of an observer, names by their labels, in the order of the text."""
    named = [(text.find(work.label), work) for work in all_works()]
    return [work for place, work in sorted(named, key=lambda pair: pair[0]) if place >= 0]
