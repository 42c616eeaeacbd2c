"""What takes long of `test_messages.py`."""

import subprocess
import sys

import numpy as np
import pandas
import pytest
from rosbags.rosbag2 import StoragePlugin
from test_messages import bag, joint_state, with_imu

import covariant

MEASURE = """
import resource, sys
from covariant import logs
def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
columns = logs.Columns(q=("shoulder", "elbow"))
logs.read(sys.argv[1], columns)
before = peak()
rows = len(logs.read(sys.argv[2], columns).record.t)
print(rows, peak() - before)
"""


@pytest.mark.exhaustive
def test_memory_grows_by_what_is_kept(tmp_path):
    """30 000 messages, 1.2 MB of stamps and numbers: less than what the messages themselves would take."""
    few, many = tmp_path / "few", tmp_path / "many"
    for path, count in ((few, 100), (many, 30_000)):
        messages = [(k + 1, joint_state(k + 1, position=[0.1, 0.2])) for k in range(count)]
        bag(path, ("/a", messages), storage=StoragePlugin.MCAP)
    done = subprocess.run([sys.executable, "-c", MEASURE, few, many], capture_output=True, text=True, check=True)
    rows, grown = done.stdout.split()
    assert int(rows) == 30_000
    assert float(grown) < 12.0


@pytest.mark.exhaustive
def test_an_estimate_from_messages_of_a_sensor_is_that_from_the_table_of_them(tmp_path):
    t, fast = np.arange(0.0, 2.0, 0.02), np.arange(0.0, 2.0, 0.005) + 0.001
    q = 0.4 * np.cos(4.4 * t)
    path = with_imu(tmp_path / "bag", t, q, fast, -0.4 * 4.4 * np.sin(4.4 * fast))
    stamps = np.union1d(np.rint(t * 1e9), np.rint(fast * 1e9)).astype(int)
    table = {
        "t": stamps * 1e-9,
        "arm/effort": np.zeros(len(stamps)),
        "arm": np.full(len(stamps), np.nan),
        "/imu/wy": np.full(len(stamps), np.nan),
    }
    table["arm"][np.searchsorted(stamps, np.rint(t * 1e9))] = q
    table["/imu/wy"][np.searchsorted(stamps, np.rint(fast * 1e9))] = -0.4 * 4.4 * np.sin(4.4 * fast)
    (tmp_path / "arm.toml").write_text(
        'system = "pendulum_chain"\n[parameters]\nmass = [1.0]\nlength = [0.5]\n'
        '[columns]\nq = ["arm"]\nu = ["arm/effort"]\n'
        "[measurement]\nstd = 1e-3\n[uncertainty]\nacceleration = 1.0\n"
        '[sensors.gyro]\nkind = "tachometer"\nof = ["arm"]\ncolumns = ["/imu/wy"]\nstd = 0.01\n'
    )
    by_bag, by_table = (
        covariant.estimate(tmp_path / "arm.toml", log, observer="intrinsic-kalman", anyway=True)
        for log in (path, pandas.DataFrame(table))
    )
    assert by_bag.sensors["gyro"].readings == len(fast)
    np.testing.assert_allclose(by_bag.t, by_table.t, rtol=0, atol=1e-9)
    np.testing.assert_allclose(by_bag.outcome.velocity, by_table.outcome.velocity, rtol=0, atol=1e-6)
