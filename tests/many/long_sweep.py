"""What takes long of `test_sweep.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_sweep import HEAD, SET, run

from covariant import many, models
from covariant.metrics import open_grid
from covariant.verbs.base.design import design


@pytest.mark.exhaustive
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


@pytest.mark.exhaustive
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


@pytest.mark.exhaustive
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


@pytest.mark.exhaustive
def test_another_limit_needs_no_new_run_and_time_is_left(tmp_path):
    told = []
    axes = '[axes]\n"start.v1" = {low = 0.0, high = 2.0, count = 5000}\n'
    head = HEAD.replace(', "intrinsic-kalman"', "").replace("2.0", "0.2") + "rate = 50.0\n"
    for below, converged in (("1e-12", False), ("100.0", True)):
        (tmp_path / "study.toml").write_text(head.replace("0.05", below) + SET + axes)
        result = many.sweep(
            tmp_path / "study.toml",
            tmp_path / "study.zarr",
            workers=1,
            progress=lambda text, done=None: told.append(text),
        )
        assert (result.columns["converged"][0] == 1) == converged
    assert told[0] == "study.toml: 5000 cases, 5e+04 steps of observers; designing them"
    assert [text.partition(" cases")[0] for text in told[1:3]] == [f"study.toml: {n} of 5000" for n in (0, 2500)]
    assert told[2].endswith(" s left")
    assert told[-1] == "study.toml: 5000 of 5000 cases"  # the first report of the second run, and its only one


@pytest.mark.exhaustive
def test_a_model_file_that_has_changed_is_read_anew(tmp_path):
    """In the same process, as in a notebook."""
    errors = []
    for name, stiffness in (("first", 1.0), ("second", 30.0)):
        (tmp_path / "spring.toml").write_text(f'system = "oscillator"\n[parameters]\nstiffness = {stiffness}\n')
        head = HEAD.replace("oscillator", "spring.toml").replace(', "intrinsic-kalman"', "") + "rate = 50.0\n"
        (tmp_path / "study.toml").write_text(f'{head}{SET}[axes]\n"start.v1" = [1.0, 2.0]\n')
        result = many.sweep(tmp_path / "study.toml", tmp_path / f"{name}.zarr", workers=1)
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
