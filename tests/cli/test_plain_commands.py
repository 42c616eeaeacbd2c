"""Any verb with any machine and any log gives a result or a refusal.

The core suite has each verb once, the long suite each verb with each log, and the exhaustive one all.
"""

import pytest
from plain_commands import (
    FROM_LOGS,
    LOGS,
    MACHINES,
    NO_LOG,
    WITHOUT_LOGS,
    cover,
    every_case,
    few_cases,
    run_case,
    write_machines,
)

FEW = few_cases()
OTHERWISE = {"compare": ("tank:two_levels", "noisy"), "tune": ("dfki_simple_pendulum.toml", "zero inputs")}
"""What takes a third of the time of a noisy pendulum."""
ONCE = [
    *(
        (verb, *OTHERWISE.get(verb, ("dfki_simple_pendulum.toml", "noisy")))
        for verb in FROM_LOGS
        if verb not in ("kalman", "forces")
    ),
    *((verb, "dfki_simple_pendulum.toml", NO_LOG) for verb in WITHOUT_LOGS),
]


def suite(case) -> tuple:
    """The mark of a case: none for the core suite."""
    return () if case in ONCE else (pytest.mark.long,) if case in FEW else (pytest.mark.exhaustive,)


@pytest.fixture(scope="module")
def machines(tmp_path_factory):
    folder = tmp_path_factory.mktemp("machines")
    write_machines(folder)
    return folder


@pytest.mark.parametrize(
    ("verb", "machine", "log"),
    [pytest.param(*case, marks=suite(case)) for case in every_case()],
)
def test_a_plain_command_ends_in_a_result_or_a_refusal(machines, monkeypatch, verb, machine, log):
    monkeypatch.chdir(machines)
    monkeypatch.syspath_prepend(machines)
    ended = run_case(verb, machine, log)
    assert not ended.fault, ended.fault


def test_each_verb_meets_each_log_and_each_machine_is_used():
    assert {(verb, log) for verb, _, log in FEW if log in LOGS} == {(verb, log) for verb in FROM_LOGS for log in LOGS}
    assert {machine for _, machine, _ in FEW} == {*MACHINES}
    assert {verb for verb, _, _ in FEW} == {*FROM_LOGS, *WITHOUT_LOGS}
    assert len(set(FEW)) == len(FEW) <= 130
    assert cover("ab", "xyz", lambda verb: "mn") == cover("ab", "xyz", lambda verb: "mn")
