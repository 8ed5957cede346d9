"""Progress moves while a command says nothing."""

from __future__ import annotations

import threading
import time

import pytest

from bodyseg_data.commands import Progress, rate_text


def lines_within(capsys: pytest.CaptureFixture[str], count: int) -> list[str]:
    """Lines on standard error, as soon as there are `count`."""
    lines: list[str] = []
    deadline = time.monotonic() + 20
    while len(lines) < count:
        assert time.monotonic() < deadline
        lines += capsys.readouterr().err.splitlines()
        time.sleep(0.005)
    return lines


def test_lines_come_while_no_update_does(capsys: pytest.CaptureFixture[str]) -> None:
    with Progress("packing", "views", interval_s=0.02) as progress:
        assert lines_within(capsys, 2)[0].startswith("packing: starting, ")
        progress.update(3, 9)
        assert "packing: 3 of 9 views, 0 s" in lines_within(capsys, 3)
    assert "progress" not in [thread.name for thread in threading.enumerate()]


def test_a_quick_command_says_only_that_it_is_done(capsys: pytest.CaptureFixture[str]) -> None:
    with Progress("packing", "views", interval_s=100) as progress:
        progress.update(0, 2)
        progress.update(1, 2)
        for _ in range(3):  # as of files smaller than the unit
            progress.update(2, 2, "all there")
    assert capsys.readouterr().err.splitlines() == [
        "packing: 0 of 2 views, 0 s",
        "packing: 2 of 2 views, 0 s: all there",
    ]


@pytest.mark.parametrize(
    ("rate", "text"),
    [
        (1234.5, "1234"),
        (10, "10"),
        (9.96, "10"),
        (9.94, "9.9"),
        (1.38, "1.4"),
        (1, "1.0"),
        (0.996, "1.0"),
        (0.994, "0.99"),
        (0.035, "0.035"),
        (0, "0"),
    ],
)
def test_a_slow_rate_keeps_two_digits(rate: float, text: str) -> None:
    assert rate_text(rate, "images") == f"{text} images/s"


def test_other_work_begins_its_own_lines(capsys: pytest.CaptureFixture[str]) -> None:
    with Progress("packing", "views", interval_s=100) as progress:
        progress.begin("checking", "meshes")
        progress.update(1, 3)
        progress.begin("checking", "meshes")
        progress.update(2, 3)
        progress.begin("packing", "views")
        progress.update(5, 9)
    assert capsys.readouterr().err.splitlines() == ["checking: 1 of 3 meshes, 0 s", "packing: 5 of 9 views, 0 s"]
