"""What takes long of `test_logs.py`."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from test_logs import csv

from covariant import logs
from covariant.logs import Columns

MEASURED = st.floats(allow_nan=True, allow_infinity=False)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@pytest.mark.parametrize("ending", ["csv", "parquet", "CSV"])
@given(sampled=st.data())
def test_what_is_written_is_read_back(tmp_path, ending, sampled):
    rows = sampled.draw(st.integers(2, 20))
    y = sampled.draw(hnp.arrays(float, (rows, 2), elements=MEASURED))
    y[0] = np.nan_to_num(y[0])
    u = sampled.draw(hnp.arrays(float, rows, elements=st.floats(allow_nan=False, allow_infinity=False)))
    stamps = st.lists(st.floats(-1e7, 1e7), min_size=rows, max_size=rows, unique=True)
    t = np.sort(np.array(sampled.draw(stamps)))
    path = tmp_path / f"log.{ending}"
    logs.write(path, {"t": t, "q, first": y[:, 0], "q2": y[:, 1], "u": u})
    record = logs.read(path, Columns("t", ("q, first", "q2"), ("u",))).record
    np.testing.assert_array_equal(record.t, t)
    np.testing.assert_array_equal(record.y, y)
    np.testing.assert_array_equal(record.u[:, 0], u)
