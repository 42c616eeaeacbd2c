from ._clock import displaced_rows as displaced_rows, odd_clock as odd_clock
from ._columns import (
    ATTITUDES as ATTITUDES,
    ClockError as ClockError,
    Columns as Columns,
    Log as Log,
    LogError as LogError,
    check_log as check_log,
)
from ._configuration import bodies as bodies, coordinates as coordinates, matrices as matrices, to_columns as to_columns
from ._data_set import survey as survey
from ._endings import MESSAGES as MESSAGES, WRITTEN as WRITTEN
from ._episodes import episodes as episodes, episodes_fault as episodes_fault, part_of as part_of
from ._read import OPTIONAL as OPTIONAL, read as read, record as record
from ._register import Register as Register
from ._tables import source_name as source_name
from ._unit_in_name import (
    KNOWN as KNOWN,
    MEANT as MEANT,
    is_unit_of as is_unit_of,
    unit_in_name as unit_in_name,
    unknown_unit as unknown_unit,
    unknown_unit_fault as unknown_unit_fault,
    without_unit as without_unit,
    words_of as words_of,
)
from ._units import check_unit as check_unit, unit_factor as unit_factor
from ._write import write as write

__all__ = ["Columns", "LogError", "read", "write"]
