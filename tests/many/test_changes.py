"""From which log on a number is another: a step is named at its log, and neither noise nor a drift is one."""

from typing import Any

import numpy as np
import pytest

from covariant.signals import Record
from covariant.verbs.base.among_logs import LogRow, find_change, find_drift
from covariant.verbs.base.folder_logs import _Folder
from covariant.verbs.base.own_numbers import find_moved


def drawn(rng, count, scatter=0.0):
    """Values of logs with unequal standard errors, and scatter from log to log beyond these."""
    std = rng.uniform(0.5, 2.0, count)
    return std * rng.normal(size=count) + scatter * rng.normal(size=count), std


@pytest.mark.parametrize("scatter", [0.0, 3.0])
def test_in_noise_there_is_no_change(scatter):
    rng = np.random.default_rng(0)
    found = [find_change(*drawn(rng, int(rng.integers(3, 60)), scatter)) for _ in range(200)]
    assert sum(each is not None for each in found) <= 1


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_step_is_named_at_its_log_with_its_size(sign):
    rng = np.random.default_rng(1)
    off = []
    for _ in range(100):
        count = int(rng.integers(10, 60))
        at = int(rng.integers(3, count - 2))
        value, std = drawn(rng, count)
        found = find_change(value + sign * 20.0 * (np.arange(count) >= at), std)
        assert found is not None
        assert found[0] == at
        off.append((found[1] - sign * 20.0) / found[2])
    assert 0.8 < np.std(off) < 1.2, "its standard error is that of the difference of two means"


def test_a_single_odd_log_is_no_change_and_hides_none():
    rng = np.random.default_rng(4)
    found = []
    for size in (20.0, 100.0, 1000.0):
        for _ in range(50):
            value, std = drawn(rng, 24)
            value[int(rng.integers(24))] += size
            assert find_change(value, std) is None
            found.append(find_change(value + 30.0 * (np.arange(24) >= 12), std))
    assert sum(each is not None and each[0] in (11, 12, 13) for each in found) > 0.95 * len(found)


def test_a_drift_is_no_change_and_a_step_on_a_drift_is_one():
    rng = np.random.default_rng(2)
    for _ in range(100):
        value, std = drawn(rng, 24)
        line = np.linspace(0.0, rng.uniform(-60.0, 60.0), 24)
        assert find_change(value + line, std) is None
        assert (find_drift(value + line, std) is not None) == (abs(line[-1]) > 8.0) or abs(line[-1]) < 16.0
    value, std = drawn(rng, 24)
    found = find_change(value + np.linspace(0.0, 5.0, 24) + 20.0 * (np.arange(24) >= 9), std)
    assert found is not None
    assert found[0] == 9


def test_one_or_two_logs_make_no_change_and_few_logs_tell_none():
    rng = np.random.default_rng(3)
    value, std = drawn(rng, 20)
    for places in ([7], [7, 8], [0], [18, 19]):
        other = value.copy()
        other[places] += 60.0
        found = find_change(other, std)
        assert found is None or found[0] not in (7, 19)
    assert find_change(np.repeat([0.0, 100.0], [4, 3]), np.ones(7)) is None
    found = find_change(np.repeat([0.0, 100.0], [4, 4]), np.ones(8))
    assert found is not None
    assert found[0] == 4


def zeros(values, std=0.001, **more):
    """Rows of logs with a zero of the elbow, None where it was not found."""
    known = [{} if each is None else {"elbow.offset": each, "elbow.offset_std": std} for each in values]
    return [LogRow(f"log#{k}", row | more) for k, row in enumerate(known)]


def test_a_zero_that_changes_parts_the_logs_and_one_that_is_another_in_single_logs_leaves_these_out():
    jump = find_moved(zeros([0.0] * 5 + [0.1] * 11), 0.01)
    assert jump.sentences == ("the zero of elbow changes by +0.1 ± 0.00054 from log#5 on",)
    assert jump.alike == tuple(range(5, 16))
    odd = find_moved(zeros([0.0] * 4 + [0.1] + [0.0] * 7), 0.01)
    assert odd.sentences == ("the zero of elbow is another in log#4: +0.1 ± 0.001",)
    assert odd.alike == (0, 1, 2, 3, *range(5, 12))
    small = find_moved(zeros([0.0] * 5 + [0.006] * 11), 0.01)
    assert small[:2] == ((), tuple(range(16))), "less than the resolution is no change"
    drift = find_moved(zeros(np.linspace(0.0, 0.1, 12).tolist()), 0.01)
    assert drift.sentences == ("the zero of elbow drifts: +0.1 from log#0 to log#11",)
    assert drift.alike == tuple(range(12))


def test_logs_without_a_number_keep_their_places():
    values = [0.0, None, 0.0, 0.0, None, 0.0, 0.0, None, 0.1, 0.1, 0.1, None, 0.1]
    moved = find_moved(zeros(values), 0.01)
    assert moved.sentences[0].endswith("from log#8 on")
    assert moved.alike == tuple(range(8))
    assert find_moved(zeros([None] * 9), 0.01)[:2] == ((), tuple(range(9)))
    assert find_moved(zeros([0.0] * 5 + [0.1] * 5, std=np.nan), 0.01).sentences == ()


def arms(rng, own, count=6, scatter=0.003, std=0.001):
    """Rows of logs of five arms in folders, whose joints' zeros scatter; `own` is added to that of arm and joint."""
    usual = {"pan": 0.0, "lift": 0.5}
    zero = {(arm, joint): usual[joint] + scatter * rng.normal() for arm in "abcde" for joint in usual}
    zero |= {key: zero[key] + size for key, size in own.items()}
    rows = []
    for arm in "abcde":
        for k in range(count):
            row = {f"{joint}.offset": zero[arm, joint] + std * rng.normal() for joint in ("pan", "lift")}
            rows.append(LogRow(f"arm_{arm}/log{k}.csv", row | {f"{name}_std": std for name in row}))
    return rows


def test_an_arm_whose_joint_has_another_zero_is_named_beside_the_others_and_left_out():
    for seed in range(20):
        rng = np.random.default_rng([5, seed])
        size = float(rng.uniform(0.08, 0.3) * rng.choice([-1, 1]))
        moved = find_moved(arms(rng, {("c", "lift"): size}), 0.015)
        (sentence,) = moved.sentences
        assert sentence.startswith("the zero of lift is another on arm_c: ")
        assert float(sentence.split()[8]) == pytest.approx(size, abs=0.02)
        assert moved.alike == (*range(12), *range(18, 30))
        assert moved.odd == {k: ["lift.offset"] for k in range(12, 18)}


def test_arms_of_one_kind_have_no_odd_one_and_a_border_between_them_is_no_change():
    rng = np.random.default_rng(6)
    found = [find_moved(arms(rng, {}, scatter=0.03), 0.015) for _ in range(200)]
    assert sum(bool(each.sentences) for each in found) <= 2
    moved = find_moved([row for row in arms(rng, {}, count=10) if "arm_a" in row.name], 0.015)
    assert moved[:2] == ((), tuple(range(10)))


def test_of_two_arms_the_second_is_compared_with_the_first_and_a_change_on_one_is_its_own():
    rng = np.random.default_rng(7)
    two = [row for row in arms(rng, {("b", "pan"): 0.2}) if row.name[4] in "ab"]
    (sentence,) = find_moved(two, 0.015).sentences
    assert sentence.startswith("the zero of pan is another on arm_b: ")
    assert float(sentence.split()[8]) == pytest.approx(0.2, abs=0.02)
    rows = arms(rng, {}, count=12)
    for row in rows[29:36]:  # the last seven logs of arm c
        row.row["lift.offset"] += 0.1
    moved = find_moved(rows, 0.015)
    assert moved.sentences[0].startswith("the zero of lift changes by +0.0992")
    assert moved.sentences[0].endswith("from arm_c/log5.csv on")
    assert moved.sentences[1].startswith("the zero of lift is another on arm_c: +0.1"), "in most of its logs"
    assert moved.alike == (*range(24), *range(36, 60))


def test_a_late_arm_counts_from_a_row_on_and_a_stiff_one_by_its_factor():
    rows = arms(np.random.default_rng(8), {})
    for k, row in enumerate(rows):
        late = 0.02 + 0.03 * (k // 6 == 4) + 1e-4 * (k % 5)
        row.row.update({"pan.delay": late, "pan.delay_std": 0.001})
        row.row.update({"lift.stiffness": 10.0 * (2.0 if k // 6 == 1 else 1.0) + k / 60, "lift.stiffness_std": 0.1})
        row.row.update({"pan.stiffness": 20.0 + 0.3 * (k // 6), "pan.stiffness_std": 0.1})
    said = find_moved(rows, 0.015, 0.02).sentences
    assert [each.split(":")[0] for each in said] == [
        "delay of pan is another on arm_e",
        "stiffness of lift is another on arm_b",
    ]
    assert "+96% of 10.3" in said[1]
    assert len(find_moved(rows, 0.015, 0.04).sentences) == 1


def test_the_logs_that_judge_tell_as_much_as_those_that_are_fitted():
    rng, t, records = np.random.default_rng(0), np.arange(300) / 50, {}
    for k in range(60):
        command = 0.3 * np.cumsum(rng.normal(size=(300, 2)), axis=0) / 17 * (k % 3 == 0)
        records[k] = Record(t, command, np.roll(command, 4, axis=0) + 1e-3 * rng.normal(size=(300, 2)))
    nothing: Any = None
    folder = _Folder([nothing] * 60, nothing, nothing, records, [])
    used = folder.choose(range(60))
    assert (len(used.logs), used.judges) == (27, 6)
    moving = [k % 3 == 0 for k in used.logs]
    assert np.mean(moving[-6:]) > 0.6 < np.mean(moving[:-6])
    assert "27 that tell most" in used.sentence


def test_of_long_logs_another_one_judges():
    rng, nothing = np.random.default_rng(1), None
    for rows, count in ((9000, 2), (4000, 2), (3000, 4)):
        t = np.arange(rows) / 50
        each = [np.cumsum(rng.normal(size=(rows, 1)), axis=0) / 50 for _ in range(7)]
        records = {k: Record(t, q, np.roll(q, 4, axis=0)) for k, q in enumerate(each)}
        folder = _Folder([nothing] * 7, nothing, nothing, records, [])  # pyright: ignore[reportArgumentType]
        used = folder.choose(range(7))
        assert used.judges == 1
        assert len(set(used.logs)) == len(used.logs) >= count
        assert f"{len(used.logs) - 1} are fitted, and 1 judge" in used.sentence
