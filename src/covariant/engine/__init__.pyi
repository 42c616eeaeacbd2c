from ._in_jax import compiled as compiled
from ._log import FEWEST_ROWS as FEWEST_ROWS, EngineName as EngineName, run_log as run_log, run_logs as run_logs
from ._stream import Health as Health, Stream as Stream
