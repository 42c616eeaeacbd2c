"""Sweeps: a study in a small file, run over all its cases; errors follow noise, gains, rates and starts."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models, workflow
from covariant.metrics import open_grid
from covariant.workflow._design import design
from covariant.workflow._study import designed_with, read_study

STUDIES = Path(__file__).parents[2] / "benchmarks/studies"
HEAD = 'model = "oscillator"\nobservers = ["intrinsic", "intrinsic-kalman"]\nduration = 2.0\nbelow = 0.05\n'
SET = '[set]\n"measurement.std" = 1e-3\n"uncertainty.acceleration" = 1.0\n'


def run(folder, axes, head=HEAD + "rate = 50.0\n", name="study"):
    (folder / f"{name}.toml").write_text(f"{head}{SET}[axes]\n{axes}\n")
    return workflow.sweep(folder / f"{name}.toml", folder / f"{name}.zarr", workers=1)


@pytest.mark.long
def test_each_axis_is_what_it_says(tmp_path):
    axes = 'noise = [1e-3, 1e-2]\n"parameters.stiffness" = [1.0, 3.0]\nrate = [20.0, 100.0]\ndraw = 40'
    result = run(tmp_path, axes, HEAD.replace("below = 0.05", "rate = 50.0") + "[start]\nq1 = 1.0\n")
    table = result.columns
    assert len(table["observer"]) == 2 * 2 * 2 * 2
    assert result.runs == 2 * 8 * 40
    known = {key: table[key] for key in ("noise", "parameters.stiffness", "rate")}
    kalman = table["observer"] == "intrinsic-kalman"

    def error(noise, stiffness, rate, rows=kalman):
        (place,) = np.flatnonzero(
            rows & (known["noise"] == noise) & (known["parameters.stiffness"] == stiffness) & (known["rate"] == rate)
        )
        return table["median error"][place], table["NEES"][place]

    assert error(1e-2, 1.0, 100.0)[0] > 2 * error(1e-3, 1.0, 100.0)[0]
    assert error(1e-3, 3.0, 100.0)[0] > 2 * error(1e-3, 1.0, 100.0)[0]
    assert error(1e-3, 1.0, 20.0)[0] > 1.2 * error(1e-3, 1.0, 100.0)[0]
    assert 0.02 < error(1e-3, 1.0, 100.0)[1] < 1.5
    assert error(1e-2, 1.0, 100.0)[1] > 20 * error(1e-3, 1.0, 100.0)[1]


@pytest.mark.long
def test_a_run_is_that_of_the_observer_in_python(tmp_path):
    """A start, without noise: the same steps as by hand."""
    result = run(tmp_path, '"start.v1" = [0.0, 2.0]')
    file = models.load("oscillator", {"measurement.std": 1e-3, "uncertainty.acceleration": 1.0})
    model = file.need_mechanical("oscillator", "a test")
    observer = design(file, "intrinsic", rate=50.0).observer
    motion, h, off = models.Motion(jnp.zeros(1), jnp.array([2.0])), 1 / 50, []
    state, step = observer.init(motion.q), jax.jit(observer.step)
    advance = jax.jit(lambda motion: models.advance(model, 0.0, motion, jnp.zeros(1), h, 4))
    for _ in range(100):
        motion = advance(motion)
        state, _info = step(state, jnp.zeros(1), motion.q, h)
        off.append(float(file.model.sought.of(observer.estimate(state))[0] - motion.v[0]))
    stored = open_grid(result.store).intrinsic_error.values
    assert stored[0] < 1e-12
    assert stored[1] == pytest.approx(np.sqrt(np.mean(np.square(off[80:]))), rel=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("durations = 1\n", "unknown key"),
        ("", "rate is missing"),
        ("rate = 50.0\n[start]\nq2 = 1.0\n", "unknown state"),
        ("rate = -50.0\n", "rate must be samples a second"),
        ('rate = 50.0\ngate = "no"\n', "gate must be true or false"),
        ("rate = 50.0\npush = [1.0, 2.0]\n", "push needs 1 finite numbers, for v1"),
        ('rate = 50.0\nfeedback = "math:pi"\n', "module 'math' is not in the folder of the file"),
        ("rate = 50.0\nstart = 3\n", "start must be a table"),
        ("rate = 50.0\nfeedback = {function = 'math:pi'}\n", "feedback must be"),
        ("rate = 1e12\n", r"a run of 2 s at 1e\+12 Hz has 2e\+12 samples; it needs 5 to 1000000"),
        ("rate = 1.0\n", "has 2 samples; it needs 5"),
        ("rate = 50.0\n[spread]\nv1 = -1.0\n", "spread.v1 must be a standard deviation"),
        ("rate = 50.0\n[start]\nv9 = 1.0\n", r"study.toml: start.v9: unknown state 'v9'"),
    ],
)
def test_a_study_that_makes_no_sense_is_refused(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        run(tmp_path, "noise = [0.1, 0.2]", HEAD + text)
    with pytest.raises(ValueError, match="needs a list of two values"):
        run(tmp_path, "noise = [0.1]", HEAD + "rate = 50.0\n")


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ("error = [1.0, 2.0]", "multiplies the first error, which is missing"),
        ("noise = [0.1, nan]", "noise must be a standard deviation"),
        ("noise = [0.1, 0.2]\n[[axes.case]]\nnoise = 0.1\n[[axes.case]]\nnoise = 0.2", "in two axes"),
        ('"start.q1" = {low = 0.0, high = 1.0, count = 2.5}', "must be a whole number"),
        ('"start.q1" = {low = 0.0, high = 1.0, count = 1e9}', "whole number from 2 to 1000000; got 1000000000.0"),
        (
            '"start.q1" = {low = 0.0, high = 1.0, count = nan}',
            "count of axes.start.q1 must be a finite number; got nan",
        ),
        ('"start.q1" = {low = 0.0, high = inf, count = 3}', "high of axes.start.q1 must be a finite number; got inf"),
        ('"start.q1" = {low = 0.0, high = 1.0, count = 3, log = true}', "axes.start.q1: unknown key 'log'"),
        ('"start.q1" = {low = 1.0, high = 1.0, count = 3}', "low and high of axes.start.q1 are both 1.0"),
        ('"start.q1" = [1.0, 2, 1]', "axes.start.q1 has 1 twice"),
        ("[axes.case]\nname = ['a', 'b']\nnoise = [0.1, 0.1]", "axes.case has {'noise': 0.1} twice"),
        ("draw = 1000001", "axes.draw has 1000001 values; 1000000 are the most"),
        (
            "".join(f"{key} = {{low = 0.1, high = 0.2, count = 200}}\n" for key in ("noise", "acceleration"))
            + "draw = 40000",
            "1600000000 cases are more than 1000000000",
        ),
        ('"parameters.stiffness" = {low = 0.1, high = 0.2, count = 10001}', "10001 designs of an observer are more"),
        (
            '"star.v1" = [1.0, 2.0]',
            r"study.toml: axes.star.v1: Did you mean 'start'\? oscillator: unknown table or key",
        ),
        ("[[axes.case]]\nnois = 0.1\n[[axes.case]]\nnoise = 0.2", "unknown table or key 'nois'"),
        ("[axes.case]\nnoise = [0.1, 0.2]\nrate = [50.0]", "need one length; got noise 2, rate 1"),
        ("[axes.case]\nnoise = [0.1]", "needs a list of two values"),
        ("[axes.case]\nnoise = [0.1, 0.2]\nrate = 50.0", "or lists by key"),
        ("draw = 2.5", "must be a number of draws"),
        ("draw = [1, 5]", "must be a number of draws"),
        ("[[axes.error]]\nnoise = 0.1\n[[axes.error]]\nnoise = 0.2", "it is taken"),
        ("[[axes.case]]\nerror = 1.0\n[[axes.case]]\nerror = 2.0", "as an axis alone"),
        ("[[axes.observer]]\nnoise = 0.1\n[[axes.observer]]\nnoise = 0.2", "it is taken"),
        ('"measurement.delay" = [0.0, 0.01]', "a sweep has no delays"),
    ],
)
def test_an_axis_that_makes_no_sense_is_refused(tmp_path, axes, message):
    with pytest.raises(ValueError, match=message):
        run(tmp_path, axes)


@pytest.mark.long
def test_a_filter_is_as_accurate_as_it_says_of_a_truth_that_is_drawn_as_it_believes(tmp_path):
    """And says too little of what it is not told of: NEES follows random motion, pushes and speeds, one by one."""
    axes = 'draw = 200\n[[axes.case]]\nname = "as believed"\n[[axes.case]]\nname = "moved"\nacceleration = 10.0\n'
    axes += '[[axes.case]]\nname = "pushed"\npush = [4.0]\n'
    head = HEAD.replace("below = 0.05", "rate = 50.0\nnoise = 1e-3\nacceleration = 1.0\n[spread]\nv1 = 1.0\n")
    table = run(tmp_path, axes, head).columns
    kalman = table["observer"] == "intrinsic-kalman"
    assert list(table["case"][kalman]) == ["as believed", "moved", "pushed"]
    # It learns how large the unknown is, and is a little too careful.
    believed, moved, pushed = table["NEES"][kalman]
    assert 0.8 < believed < 1.1
    assert moved > 1.5 * believed
    assert pushed > 1.5 * believed
    assert 0.93 < table["in band"][kalman][0] < 0.98
    assert 0.9 < table["NIS"][kalman][0] < 1.1


def test_the_basin_is_the_largest_multiple_up_to_which_all_runs_converge(tmp_path):
    """Of a linear observer every multiple converges alike, so that `below` decides which."""
    text = (
        HEAD.replace(', "intrinsic-kalman"', "").replace("duration = 2.0", "duration = 1.0")
        + "rate = 50.0\ngate = false\n"
    )
    result = run(tmp_path, "error = [0.0, 1.0, 10.0, 1e6]", text + "[error]\nq1 = 0.1\n")
    (basin,), (beyond,) = result.columns["basin"], result.columns["beyond it"]
    error = open_grid(result.store).intrinsic_error.values
    assert error[0] < 1e-12
    np.testing.assert_allclose(error[1:] / error[1], [1.0, 10.0, 1e6], rtol=1e-6)
    assert basin == [0.0, 1.0, 10.0, 1e6][int(np.flatnonzero(error < 0.05)[-1])]
    assert beyond == 0


def test_another_limit_needs_no_new_run_and_time_is_left(tmp_path):
    told = []
    axes = '[axes]\n"start.v1" = {low = 0.0, high = 2.0, count = 5000}\n'
    head = HEAD.replace(', "intrinsic-kalman"', "").replace("2.0", "0.2") + "rate = 50.0\n"
    for below, converged in (("1e-12", False), ("100.0", True)):
        (tmp_path / "study.toml").write_text(head.replace("0.05", below) + SET + axes)
        result = workflow.sweep(
            tmp_path / "study.toml",
            tmp_path / "study.zarr",
            workers=1,
            progress=lambda text, done=None: told.append(text),
        )
        assert (result.columns["converged"][0] == 1) == converged
    assert told[0] == "study.toml: 5000 cases, 5e+04 steps of observers; designing them"
    assert [text.partition(" cases")[0] for text in told[1:]][:2] == [
        "study.toml: 0 of 5000",
        "study.toml: 2500 of 5000",
    ]
    assert told[2].endswith(" s left")
    assert told[-1] == "study.toml: 5000 of 5000 cases"  # the first report of the second run, and its only one


def test_an_observer_twice_is_refused(tmp_path):
    with pytest.raises(ValueError, match="observers has 'intrinsic' twice"):
        run(tmp_path, "noise = [0.1, 0.2]", HEAD.replace("intrinsic-kalman", "intrinsic") + "rate = 50.0\n")


def test_multiples_that_do_not_grow_are_refused(tmp_path):
    with pytest.raises(ValueError, match="multiples that grow"):
        run(tmp_path, "error = [4.0, 2.0]", HEAD + "rate = 50.0\n[error]\nq1 = 0.1\n")


def test_an_observer_without_a_velocity_in_its_state_has_no_first_error(tmp_path):
    with pytest.raises(ValueError, match="has no velocity to start with"):
        run(
            tmp_path,
            '"error.v1" = [0.0, 1.0]',
            HEAD.replace('"intrinsic", "intrinsic-kalman"', '"pll"') + "rate = 50.0\n",
        )


def test_a_model_file_that_has_changed_is_read_anew(tmp_path):
    """In the same process, as in a notebook."""
    errors = []
    for name, stiffness in (("first", 1.0), ("second", 30.0)):
        (tmp_path / "spring.toml").write_text(f'system = "oscillator"\n[parameters]\nstiffness = {stiffness}\n')
        head = HEAD.replace("oscillator", "spring.toml").replace(', "intrinsic-kalman"', "") + "rate = 50.0\n"
        (tmp_path / "study.toml").write_text(f'{head}{SET}[axes]\n"start.v1" = [1.0, 2.0]\n')
        result = workflow.sweep(tmp_path / "study.toml", tmp_path / f"{name}.zarr", workers=1)
        errors.append(open_grid(result.store).intrinsic_error.values)
    assert not np.allclose(*errors)


@pytest.mark.parametrize(
    "sizes",
    [
        '[axes.size]\nname = ["small", "large"]\nnoise = [1e-3, 1e-1]',
        '[[axes.size]]\nname = "small"\nnoise = 1e-3\n[[axes.size]]\nname = "large"\nnoise = 1e-1\n',
    ],
)
def test_noise_of_tables_and_rates_are_crossed(tmp_path, sizes):
    axes = f"rate = [25.0, 100.0]\ndraw = 20\n{sizes}"
    table = run(tmp_path, axes, HEAD.replace(', "intrinsic-kalman"', "")).columns
    assert list(zip(table["rate"], table["size"], strict=True)) == [
        (rate, size) for rate in (25.0, 100.0) for size in ("small", "large")
    ]
    small, large = table["median error"].reshape(2, 2).T
    assert (large > 20 * small).all()


def test_observers_start_with_the_velocity_of_the_machine_and_their_own_error(tmp_path):
    """A feedback of a module acts on both, so that without an error nothing differs."""
    (tmp_path / "spring.py").write_text("def pull(t, x):\n    return -3.0 * x[:1]\n")
    text = (
        HEAD.replace(', "intrinsic-kalman"', "").replace("duration = 2.0", "duration = 0.2")
        + 'rate = 50.0\nfeedback = "spring:pull"\n[start]\nq1 = 1.0\nv1 = 2.0\n'
    )
    stored = open_grid(run(tmp_path, '"error.v1" = [0.0, 1.0]', text).store).intrinsic_error.values
    assert stored[0] < 1e-9
    assert stored[1] > 1e-3


@pytest.mark.parametrize("path", sorted(STUDIES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_study_of_the_benchmarks_names_what_there_is(path):
    plan = read_study(path)
    for each in plan.designs:
        models.load(plan.model, plan.content.get("set", {}) | designed_with(each))
    assert plan.grid.size > 1
