"""What takes long of `test_c_intervals.py`."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from scalargraph.intervals._c_intervals import Library

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")


@pytest.mark.skipif(
    " fma " not in "".join(p.read_text() for p in [Path("/proc/cpuinfo")] if p.exists()),
    reason="no known instruction rounds a product and a sum together",
)
def test_a_compiler_that_contracts_is_refused(monkeypatch):
    """A product and a sum that are rounded together."""
    monkeypatch.setenv("COVARIANT_CACHE", "off")
    fast = ("-std=gnu99", "-O2", "-march=native", "-ffp-contract=fast", "-fPIC", "-shared")
    monkeypatch.setattr("scalargraph.intervals._c_intervals.EXACT", fast)
    with pytest.raises(OSError, match="in another way than NumPy"):
        Library()


@pytest.mark.exhaustive
def test_a_process_without_subnormal_numbers_is_found_out():
    """A library linked with -ffast-math switches them off for all that the process does, NumPy included."""
    script = """
import scalargraph.intervals._c_intervals as c
c.EXACT = ("-std=c99", "-O0", "-ffast-math", "-fno-finite-math-only", "-fPIC", "-shared")
try:
    c.Library()
except OSError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert "in another way than NumPy" in done.stdout or "count as zero in this process" in done.stdout
