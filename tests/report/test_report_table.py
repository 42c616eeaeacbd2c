"""Markdown tables."""

import math

import numpy as np

from covariant.report import table


def test_table():
    rows = [
        {"observer": "intrinsic", "gain": 12, "RMS [rad/s]": 0.0123, "settles [s]": 1.5},
        {"observer": "a|b\n<b>", "gain": 5.0, "RMS [rad/s]": np.float32(1.5), "settles [s]": math.nan},
        {"observer": "EKF", "RMS [rad/s]": math.inf},
    ]
    assert table(rows) == (
        "| observer    | gain | RMS [rad/s] | settles [s] |\n"
        "| ----------- | ---: | ----------: | ----------: |\n"
        "| intrinsic   |   12 |      0.0123 |         1.5 |\n"
        "| a\\|b &lt;b> |    5 |      1.5000 |           — |\n"
        "| EKF         |    — |           ∞ |           — |\n"
    )


def test_numbers_of_unlike_size_keep_their_own_digits():
    lines = table([{"x": 1.23456e-9, "k": 1_234_567}, {"x": 98765.4, "k": 1}, {"x": -2.0, "k": 0}]).splitlines()[2:]
    assert [line.split() for line in lines] == [
        ["|", "1.235e-09", "|", "1234567", "|"],
        ["|", "9.877e+04", "|", "1", "|"],
        ["|", "-2", "|", "0", "|"],
    ]


def test_text_and_truth_go_left():
    assert table([{"verdict": True}, {"verdict": "holds"}]).splitlines()[1:] == [
        "| ------- |",
        "| yes     |",
        "| holds   |",
    ]


def test_no_rows():
    assert table([]) == ""
