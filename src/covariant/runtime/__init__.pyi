from ._log import FEWEST_ROWS as FEWEST_ROWS, run_log as run_log
from ._stream import Health as Health, Stream as Stream
