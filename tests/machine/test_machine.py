"""The line that describes a machine beside its results."""

from __future__ import annotations

import pytest

from bodyseg_data.machine import computes_bfloat16, hardware
from bodyseg_data.machine import host as machine


@pytest.mark.parametrize(
    ("name", "flags", "shown"),
    [
        ("Intel(R) Xeon(R) Processor", "fpu amx_bf16 amx_tile avx512f", "Intel Xeon Processor with AMX"),
        ("Intel(R) Core(TM) i7-8650U CPU @ 1.90GHz", "fpu avx2", "Intel Core i7-8650U CPU @ 1.90GHz"),
        ("AMD EPYC", "fpu avx2 avx512f avx512_vnni", "AMD EPYC with AVX-512"),
        ("AMD EPYC", "fpu avx2", "AMD EPYC"),
    ],
)
def test_a_processor_is_named_without_trade_marks_and_with_its_widest_instructions(
    name: str, flags: str, shown: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    about = [f"model name\t: {name}", f"flags\t\t: {flags}"]
    files = {"/proc/cpuinfo": about + about, "/proc/meminfo": ["MemTotal:       25165824 kB"]}
    monkeypatch.setattr(machine, "_lines", lambda path: files[path])
    monkeypatch.setattr(machine, "processors", lambda: 2)
    monkeypatch.setattr(machine.platform, "machine", lambda: "x86_64")
    assert hardware() == f"2 cores of {shown} (x86_64), 24 GiB"


@pytest.mark.parametrize(
    ("share", "expected"),
    [("", 8), ("max 100000", 8), ("-1 100000", 8), ("200000 100000", 2), ("50000 100000", 1), ("1600000 100000", 8)],
)
@pytest.mark.parametrize("version", [1, 2])
def test_a_containers_share_of_time_counts_as_so_many_processors(
    version: int, share: str, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ["cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us"] if version == 1 else ["cpu.max"]
    lines = share.split() if version == 1 else [share]
    files = {f"/sys/fs/cgroup/{name}": [line] for name, line in zip(names, lines, strict=False) if line}
    monkeypatch.setattr(machine.os, "sched_getaffinity", lambda _: range(8), raising=False)
    monkeypatch.setattr(machine, "_lines", lambda path: files.get(path, []))
    assert machine.processors() == expected


@pytest.mark.parametrize(
    ("board", "processor", "shown"),
    [
        (["Raspberry Pi 5 Model B Rev 1.0\0"], "", "Raspberry Pi 5 Model B Rev 1.0"),
        ([], "aarch64", "aarch64"),
        ([], "", "unknown"),  # Debian in a virtual machine
    ],
)
def test_an_arm_processor_is_named_by_its_board(
    board: list[str], processor: str, shown: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = {"/proc/cpuinfo": ["processor\t: 0", "Features\t: fp asimd", "CPU part\t: 0xd0b"], "/proc/meminfo": []}
    monkeypatch.setattr(machine, "_lines", lambda path: {**files, "/proc/device-tree/model": board}[path])
    monkeypatch.setattr(machine, "processors", lambda: 4)
    monkeypatch.setattr(machine.platform, "machine", lambda: "aarch64")
    monkeypatch.setattr(machine.platform, "processor", lambda: processor)
    assert hardware() == f"4 cores of {shown} (aarch64)"


@pytest.mark.parametrize(
    ("flags", "expected"), [("fpu amx_bf16", True), ("fpu avx512_bf16 avx512_vnni", True), ("fpu avx512_vnni", False)]
)
def test_bfloat16_is_known_by_flags(flags: str, expected: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "_lines", lambda path: ["processor\t: 0", f"flags\t\t: {flags}"])
    assert computes_bfloat16() is expected
    monkeypatch.setattr(machine, "_lines", lambda path: [])
    assert computes_bfloat16() is False
