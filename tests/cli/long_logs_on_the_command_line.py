"""What takes long of `test_logs_on_the_command_line.py`."""

from pathlib import Path

import numpy as np
import pytest
from commands import command, refused
from test_logs_on_the_command_line import folder

from covariant import logs

ANGLE = ("estimate", "model/arm.toml")


@pytest.mark.exhaustive
def test_commands_chain_in_the_units_and_formats_of_the_model_file(folder):
    """What `simulate` writes `estimate` reads, though the log has no column of the optional velocities."""
    short = ("--duration", "2", "--rate", "100", "--noise", "1e-4", "--amplitude", "1")
    command("simulate", "model/arm.toml", "-o", "log.csv", *short)
    rows = np.loadtxt("log.csv", delimiter=",", skiprows=1)
    assert Path("log.csv").read_text().splitlines()[0] == "time,angle,torque,true_angle,true_v1"
    assert rows[1, 0] == 10.0
    assert np.max(np.abs(rows[:, 2])) == pytest.approx(1000.0, rel=1e-2)
    # The positions of the model, in degrees.
    assert np.sqrt(np.mean((rows[:, 1] - rows[:, 3]) ** 2)) == pytest.approx(np.degrees(1e-4), rel=0.3)
    plain = command(*ANGLE, "log.csv", "-o", "v.csv", "--truth", "true_v1")
    assert plain["velocity_rmse"][0] < 0.05
    assert "logged_velocity_rmse" not in plain
    stretch = command(*ANGLE, "log.csv", "-o", "v.mcap", "--v", "", "--from", "0.5", "--until", "1.5")
    assert stretch["rows"] == 101
    read = logs.read("v.mcap", logs.Columns(q=("angle",), v=("angle/velocity",))).record
    np.testing.assert_allclose(read.t, np.arange(101) / 100 + 0.5, rtol=0, atol=1e-9)
    dated = "time;angle;torque\n" + "".join(
        f"2024-05-01T12:00:{t / 1000:06.3f}Z;{q};{u}\n".replace(".", ",") for t, q, u, *_ in rows
    )
    Path("dated.txt").write_text(dated)
    dates = command(*ANGLE, "dated.txt", "-o", "d.mcap", "--set", 'units={q="deg", u="-1 mN m"}')
    assert dates["t_counts_from"] == "2024-05-01T12:00:00.000000000Z"
    assert logs.read("d.mcap", logs.Columns(q=("angle",))).origin_ns == 1_714_564_800_000_000_000
    first, again = (logs.read(f, logs.Columns(q=("q1",), v=("v1",))).v for f in ("v.csv", "v.csv"))
    np.testing.assert_array_equal(first, again)
    failed(folder)


def failed(folder):
    """Runs that fail leave an output as it was, and none where there was none."""
    before = Path("v.csv").read_bytes()
    there = sorted(path.name for path in folder.iterdir())
    gap = Path("log.csv").read_text().replace("\n10,", "\n,", 1)
    Path("gap.txt").write_text(gap)
    for arguments, words in (
        ((*ANGLE, "gap.txt", "-o", "v.csv"), "column 'time' [ms], row 2: found an empty cell"),
        ((*ANGLE, "gap.txt", "-o", "new.mcap", "--report", "new.html"), "found an empty cell"),
        ((*ANGLE, "log.csv", "-o", "new.csv", "--v", "speed"), "no column 'speed'"),
        ((*ANGLE, "log.csv", "-o", "new.csv", "--from", "5"), "from=5 keep 0 of 201 rows"),
        ((*ANGLE, "log.csv", "-o", "new.csv", "--set", 'units.q="mm"'), "'mm' is no unit of what is measured in rad"),
        ((*ANGLE, "log.csv", "-o", "new.csv", "--set", 'units.q="smoot"'), "units.q: unit 'smoot' is not understood"),
        ((*ANGLE, "log.csv", "-o", "new.csv", "--set", 'units.q=["deg", "deg"]'), "lists 2 units; give 1"),
        ((*ANGLE, "log.csv", "-o", "new.csv", "--set", 'units.matrix="m"'), "unknown key of [units] 'matrix'"),
        (("compare", *ANGLE[1:], "gap.txt", "-o", "new.csv"), "found an empty cell"),
        (("simulate", *ANGLE[1:], "-o", "model.mcap", "--rate", "-1"), "rate"),
    ):
        refused(*arguments, named=[words])
    assert Path("v.csv").read_bytes() == before
    assert sorted(path.name for path in folder.iterdir()) == sorted([*there, "gap.txt"])
