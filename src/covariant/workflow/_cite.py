"""`cite`: the works behind an observer and the numbers of a model, for a paper that uses them."""

from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax

from covariant import models
from covariant._files import write_atomically
from covariant.calibration import estimators
from covariant.models import Overrides, Parameter
from covariant.observers import REGISTRY
from covariant.workflow._outputs import check_output
from covariant.workflow._references import Work, works_in
from covariant.workflow._result import AbstractResult


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
        raise ValueError(f"observer {observer} does not fit {name}; these do: {', '.join(fitting)}")
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
    works: tuple[Work, ...]
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

    def save(self, path: str | Path, overwrite: bool = True) -> Path:
        """Write the BibTeX entries to a file, whole or not at all.

        Args:
            path: The file to write (.bib).
            overwrite: Whether a file that exists may be replaced.

        Returns:
            The path.

        Raises:
            ValueError: For another suffix, or a folder that does not exist.
        """
        path = Path(path)
        check_output(path, ".bib", overwrite=overwrite)
        return write_atomically(path, lambda file: file.write(f"{self.bibtex}\n".encode()))
