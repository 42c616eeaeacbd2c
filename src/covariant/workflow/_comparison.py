"""What comparisons of estimators on a log have in common: how their table is written."""

from dataclasses import dataclass
from pathlib import Path

from covariant.workflow._inputs import Job, Loaded
from covariant.workflow._outputs import check_output, write_table
from covariant.workflow._result import AbstractTable


@dataclass(frozen=True, repr=False)
class AbstractComparison(AbstractTable):
    """Several estimators on one log.

    Attributes:
        job: The model and the log, and which part of it was read.
        loaded: Both as they were read.
    """

    job: Job
    loaded: Loaded

    def save(self, path: str | Path, overwrite: bool = True) -> Path:
        """Write the table; a number that an estimator does not have is left empty.

        Args:
            path: The table to write (.csv).
            overwrite: Whether a file that exists may be replaced, other than the log that was read.

        Returns:
            The path.

        Raises:
            ValueError: For another suffix, a folder that does not exist, or the path of the log that was read.
        """
        path = Path(path)
        check_output(path, ".csv", log=self.job.log, overwrite=overwrite)
        return write_table(path, self.columns)
