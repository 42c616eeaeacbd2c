from ._each import check as check, estimate as estimate, smooth as smooth
from ._over_logs import over_logs as over_logs
from ._sweep import sweep as sweep

__all__ = ["over_logs"]
