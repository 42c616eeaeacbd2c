from ._choice import EngineName as EngineName, choose as choose
from ._in_jax import compiled as compiled
from ._log import run_log as run_log, run_logs as run_logs
from ._stream import Stream as Stream

__all__ = ["Stream", "compiled", "run_log", "run_logs"]
