from ._progress import Progress as Progress
from ._result import AbstractResult as AbstractResult
