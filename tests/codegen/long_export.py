"""What takes long of `test_export.py`."""

import json
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_export import FLAGS, NOISE, ROOT, STATES, case, command, commands_of_the_page, exported, needs_compiler, ran

import covariant
from covariant import metrics, models
from covariant.cli import main
from covariant.codegen import ROWS, fmu, program
from scalargraph.graph import _places


@needs_compiler
@pytest.mark.parametrize("name", ["pendulum", "top"])
def test_sanitizers_find_nothing(name, exported):
    folder = exported(name).folder
    checks = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    ran(["cc", *FLAGS, *checks, "-I.", f"{name}.c", f"test/{name}_test.c", "-lm", "-o", "sanitized"], folder)
    ran(["./sanitized"], folder)


@needs_compiler
def test_a_wrong_sign_fails_the_self_test(exported, tmp_path):
    """The other half of the law: what it allows is rounding and no more."""
    folder = exported("pendulum").folder
    text = (folder / "pendulum.c").read_text()
    wrong = text.replace("9.81 /* gravity */", "9.810000000001 /* gravity */")
    wrong = wrong if wrong != text else text.replace("{0.3, 0.25} /* length */", "{0.3000000000001, 0.25} /* length */")
    assert wrong != text
    (tmp_path / "pendulum.c").write_text(wrong)
    ran(["cc", f"-I{folder}", "pendulum.c", folder / "test" / "pendulum_test.c", "-lm", "-o", "spoiled"], tmp_path)
    done = subprocess.run([str(tmp_path / "spoiled")], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "WRONG" in done.stdout


@pytest.mark.exhaustive("sensors", "smoothed", "top")
@pytest.mark.parametrize("name", ["pendulum", "smoothed", "sensors", "top"])
def test_its_vectors_are_what_the_observer_does_in_jax(name, exported):
    graphs, expected = exported(name).program, exported(name).vectors
    chosen = exported(name).case
    observer = chosen.recipe.make({key: jnp.asarray(value) for key, value in chosen.recipe.numbers.items()})
    start = jnp.asarray(expected.start).reshape(graphs.y)
    y = jnp.where(expected.missing, jnp.nan, expected.y).reshape(-1, *graphs.y)

    @eqx.filter_jit
    def followed(observer, start, u, y, dt):
        def step(state, row):
            state, info = observer.step(state, *row)
            return state, (observer.estimate(state), info.result)

        return jax.lax.scan(step, observer.init(start), (u, y, dt))[1]

    x, result = followed(observer, start, jnp.asarray(expected.u), y, jnp.asarray(expected.dt))
    flat = np.concatenate([np.asarray(leaf).reshape(ROWS, -1) for leaf in jax.tree.leaves(x)], axis=1)
    of_x = np.s_[:, : flat.shape[1]]  # standard deviations follow
    assert (np.abs(flat - expected.expected[of_x]) <= expected.allowed[of_x]).all()
    assert set(expected.result) >= {0, 1, 2, 3, 16}, "the faults of the run are told"
    np.testing.assert_array_equal(result, expected.result)


@pytest.mark.exhaustive
def test_the_header_says_what_a_measurement_holds(exported):
    header = (exported("sensors").folder / "sensors.h").read_text(encoding="utf-8")
    assert (
        "#define SENSORS_MEASUREMENTS 3 /* numbers of a measurement: 2 of the configuration, then 1 of speed */"
        in header
    )
    assert "where the configuration in y is not all\n * finite" in header


ALONE = """#include "sensors.h"

#include <math.h>
#include <stdio.h>

int main(void)
{
    const double start[3] = {0.3, 0.1, (double)NAN}, u[1] = {0.2};
    const unsigned char only_q[3] = {0, 0, 1}, only_speed[3] = {1, 1, 0};
    sensors_state whole, alone;
    sensors_output expected, found;
    double worst = 0.0;
    int k, outcomes = 0;
    sensors_init(&whole, &sensors_default, start, 0.0);
    sensors_init(&alone, &sensors_default, start, 0.0);
    for (k = 1; k < 200; ++k) {
        const double y[3] = {0.3 + 0.05 * sin(0.1 * k), k == 77 ? (double)NAN : 0.1,
                             0.05 * cos(0.1 * k) + (k % 50 == 9)};
        const int of_q = k % 5 == 0;
        const int a = sensors_step(&whole, &sensors_default, u, y, of_q ? only_q : only_speed, 0.004);
        const int b = of_q ? sensors_step_configuration(&alone, &sensors_default, u, y, 0.004)
                           : sensors_step_speed(&alone, &sensors_default, u, y + 2, 0.004);
        outcomes += a != b;
        sensors_estimate(&whole, &sensors_default, &expected);
        sensors_estimate(&alone, &sensors_default, &found);
        worst = fmax(worst, fabs(expected.v[0] - found.v[0]) + fabs(expected.slow[0] - found.slow[0]));
    }
    printf("%d %.3g %.3g", outcomes, worst, found.v[0]);
    return 0;
}
"""


@pytest.mark.exhaustive
@needs_compiler
def test_a_step_by_one_sensor_alone_is_the_whole_step_without_the_rest(exported, tmp_path):
    folder = exported("sensors").folder
    (tmp_path / "main.c").write_text(ALONE)
    ran(["cc", *FLAGS, f"-I{folder}", folder / "sensors.c", "main.c", "-lm", "-o", "alone"], tmp_path)
    outcomes, worst, v = map(float, ran(["./alone"], tmp_path).split())
    assert outcomes == 0
    assert worst < 1e-12
    assert abs(v) > 0
    sheet = (folder / "DATASHEET.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (all|configuration alone|speed alone) \| (\d+) \|$", sheet, re.MULTILINE)
    work = {what: int(count) for what, count in rows}
    assert work["speed alone"] < work["configuration alone"] < work["all"]


@pytest.mark.exhaustive
def test_steps_by_sensor_are_written_only_where_they_are_asked_for_and_there_are_some(tmp_path):
    assert not program(case("sensors").recipe, case("sensors").measured[0], 1).alone
    with pytest.raises(ValueError, match="step_per_sensor is for a filter with sensors; intrinsic of oscillator has"):
        covariant.export("oscillator", tmp_path / "c", rate=100.0, alpha=9.0, beta=20.0, step_per_sensor=True)
    with pytest.raises(ValueError, match="for C, and a unit has one step"):
        covariant.export("oscillator", tmp_path / "a.fmu", rate=100.0, alpha=9.0, beta=20.0, step_per_sensor=True)


@pytest.mark.exhaustive
def test_an_export_with_a_lag_is_the_smoother_of_its_observer(tmp_path):
    made = {"rate": 100.0, "overrides": NOISE, "observer": "intrinsic-kalman"}
    late = covariant.export("oscillator", tmp_path / "late", lag=0.05, **made)
    assert "Estimates are 0.05 s late." in late.about
    buffers = {leaf.name: leaf.shape for leaf in late.program.state}
    assert (5, 1) in buffers.values()
    now = covariant.export("oscillator", tmp_path / "now", **made)
    assert not any(leaf.shape[:1] == (5,) for leaf in now.program.state)


@pytest.mark.exhaustive
@needs_compiler
def test_the_command_of_the_page_writes_what_passes_its_test(tmp_path, monkeypatch, capsys):
    line, *_ = commands_of_the_page()
    options, out = shlex.split(line), tmp_path / "arm"
    (tmp_path / "examples").mkdir()
    shutil.copy(ROOT / options[0], tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    code, told, _ = command(monkeypatch, capsys, *options, "--json")
    assert code == 0
    assert {"alpha", "mass", "coulomb"} <= set(json.loads(told)["numbers"])
    ran(["cc", *FLAGS, "-I.", "arm.c", "test/arm_test.c", "-lm", "-o", "self_test"], out)
    ran(["./self_test"], out)
    sheet = (out / "DATASHEET.md").read_text()
    assert "| calls of sin |" in sheet
    assert "500 Hz" in sheet
    assert command(monkeypatch, capsys, *options)[0] == 2, "the folder is not empty"


@pytest.mark.exhaustive
def test_what_is_proved_is_told(tmp_path, monkeypatch, capsys):
    """The data sheet quotes a certificate of this observer only."""
    proved = ROOT / "examples" / "certificates" / "ball_and_beam.json"
    gains = ("--alpha", "1.4142135623730951", "--beta", 0.5, "--rate", 100, "--certificate", proved)
    assert command(monkeypatch, capsys, "ball_and_beam", *gains, "-o", tmp_path / "out")[0] == 0
    sheet = (tmp_path / "out" / "DATASHEET.md").read_text()
    assert "holds (proved): estimates within 0.009042 of a solution" in sheet
    code, _, told = command(monkeypatch, capsys, "ball_and_beam", *gains, "--beta", 0.6, "-o", tmp_path / "other")
    assert code == 2
    assert "is for alpha = 1.4142135623730951, beta = 0.5" in told


def stored_metric(folder: Path, points: int) -> tuple:
    """Words that export an observer with its metric in a table, which is computed first."""
    grid = metrics.Grid(["x1", "x2", "x3"], ["m", "m/s", "1/s^2"], (0, 1, 0.5), (1, 1.5, 1.5), (points,) * 3)
    metrics.metric_on_grid(models.unknown_frequency(), metrics.Equation(rate=8.0), grid, folder / "m.zarr")
    return "unknown_frequency", "--rate", "200", "--observer", "riccati", "--metric", folder / "m.zarr"


@pytest.mark.exhaustive
@needs_compiler
def test_observers_of_state_space_models_are_written_too(tmp_path, monkeypatch, capsys):
    for name, options in (("filter", STATES), ("table", stored_metric(tmp_path, 4))):
        code, _, fault = command(monkeypatch, capsys, *options, "--name", "f", "-o", tmp_path / name)
        assert code == 0, fault
        ran(["cc", *FLAGS, "-I.", "f.c", "test/f_test.c", "-lm", "-o", "self_test"], tmp_path / name)
        ran(["./self_test"], tmp_path / name)
    assert "x_std" not in (tmp_path / "table" / "f.h").read_text()
    assert "state_std[3]" in (tmp_path / "filter" / "f.h").read_text()
    assert "look-ups in tables | 384" in (tmp_path / "table" / "DATASHEET.md").read_text()


@pytest.mark.exhaustive
@needs_compiler
def test_a_metric_on_a_fine_grid_is_a_table_of_its_numbers(tmp_path, monkeypatch, capsys):
    """The page on metrics exports a grid of 33³ points, whose table is eight times as long."""
    words = stored_metric(tmp_path, 17)
    code, _, fault = command(monkeypatch, capsys, *words, "--name", "f", "-o", tmp_path / "c")
    assert code == 0, fault
    text = (tmp_path / "c" / "f.c").read_text()
    assert f"_table1[{19**3 * 6}]" in text  # with a border, and six factors at a point
    assert len(text) < 1.2e6
    ran(["cc", *FLAGS, "-I.", "f.c", "test/f_test.c", "-lm", "-o", "self_test"], tmp_path / "c")
    ran(["./self_test"], tmp_path / "c")


@pytest.mark.exhaustive
def test_a_table_that_no_program_should_hold_is_refused_by_its_size(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(_places, "MOST_ENTRIES", 1000)
    code, _, fault = command(monkeypatch, capsys, *stored_metric(tmp_path, 5), "-o", tmp_path / "c")
    assert code == 2
    assert f"a table of {7**3 * 6} numbers, and code holds at most 1000" in fault
    assert "fewer points" in fault
