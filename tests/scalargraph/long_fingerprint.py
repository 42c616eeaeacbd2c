"""What takes long of `test_fingerprint.py`."""

import subprocess
import sys
from pathlib import Path

import pytest
from test_fingerprint import DIFFERENT, key

PROCESS = """
import sys
sys.path.insert(0, {folder!r})
from test_fingerprint import DIFFERENT, key
print([key(function) for functions in DIFFERENT.values() for function in functions])
"""


@pytest.mark.exhaustive
def test_keys_are_those_of_another_process():
    script = PROCESS.format(folder=str(Path(__file__).parent))
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str([key(function) for functions in DIFFERENT.values() for function in functions])
