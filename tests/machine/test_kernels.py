"""Compiled loops: which form is chosen, and that no machine code but that of the present source is ever run."""

from __future__ import annotations

import importlib.util
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numba
import pytest
import warm
from kernel_forms import computed_by
from numba.core.caching import FunctionCache
from numba.core.registry import cpu_target

from bodyseg_data import RangeImages, example_set
from bodyseg_data.artifacts import fused_loops
from bodyseg_data.core import BadConfig, MissingLibrary
from bodyseg_data.labels import label_loops
from bodyseg_data.machine import kernels
from bodyseg_data.shards.codecs import bodyseg_loops

LOOPS = """
import limits
from limits import LIMIT
from inner import inner
from bodyseg_data.machine.kernels import compiled

def _outer(count):
    total = 0
    for number in range(count):
        total += inner(number) * LIMIT
    return total + 1000

outer = compiled(_outer, "a test")
"""
INNER = """from bodyseg_data.machine.kernels import compiled
def _inner(x):
    return x + 3
inner = compiled(_inner, 'a test')
"""
LIMITS = "LIMIT = 2\n"
TYPES = ("3", "numpy.int32(3)")


@pytest.fixture
def sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Loops in three files: the outermost, one it calls, and a constant."""
    folder = tmp_path / "sources"
    folder.mkdir()
    for name, text in (("outer", LOOPS), ("inner", INNER), ("limits", LIMITS)):
        (folder / f"{name}.py").write_text(text)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    return folder


def answer(folder: Path) -> int:
    """What the loops answer for 3 to a process that loads them anew."""

    def load(name: str) -> ModuleType:
        spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
        assert spec is not None and spec.loader is not None
        sys.modules[name] = module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    try:
        for name in ("limits", "inner"):
            load(name)
        return int(load("outer").outer(3))
    finally:
        for name in ("limits", "inner", "outer"):
            sys.modules.pop(name, None)


def kept(tmp_path: Path) -> set[Path]:
    return set((tmp_path / "cache").rglob("*.nbc"))


def test_machine_code_is_kept_and_found_again(sources: Path, tmp_path: Path) -> None:
    assert answer(sources) == 1000 + 2 * (3 + 4 + 5)
    files = kept(tmp_path)
    assert files and all(file.is_relative_to(tmp_path / "cache" / "bodyseg" / "kernels") for file in files)
    stamps = {file: file.stat().st_mtime_ns for file in files}
    assert answer(sources) == 1024
    assert {file: file.stat().st_mtime_ns for file in kept(tmp_path)} == stamps
    assert not list(sources.rglob("*.nbi")), "nothing is written beside the source"
    assert numba.config.CACHE_DIR == ""


class _OtherNames(FunctionCache):  # type: ignore[misc]  # numba has no types
    """As a later numba may be: `load_overload` is public, what it calls is not."""

    @property
    def _load_overload(self) -> None:
        raise AttributeError

    def load_overload(self, *given: Any) -> Any:
        return FunctionCache._load_overload(self, *given)


def test_a_numba_whose_own_names_have_changed_is_no_error(
    sources: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("numba.core.caching.FunctionCache", _OtherNames)
    monkeypatch.delattr("numba.core.runtime.rtsys")
    assert [answer(sources), answer(sources)] == [1024, 1024] and kept(tmp_path)
    monkeypatch.delattr("numba.core.caching.FunctionCache")
    assert answer(sources) == 1024, "compiled by every process"


@pytest.mark.parametrize("kind", ["nbc", "nbi"])
def test_files_that_are_cut_short_are_made_anew(kind: str, sources: Path, tmp_path: Path) -> None:
    for _ in range(2):
        assert answer(sources) == 1024
        for file in (tmp_path / "cache").rglob(f"*.{kind}"):
            assert file.stat().st_size > 20
            os.truncate(file, 20)


@pytest.mark.parametrize(
    ("name", "old", "new", "expected"),
    [
        ("outer", "1000", "2000", 2024),
        ("inner", "x + 3", "x + 4", 1030),
        ("limits", "LIMIT = 2", "LIMIT = 3", 1036),
    ],
)
def test_changed_source_is_never_answered_by_old_code(
    sources: Path, name: str, old: str, new: str, expected: int
) -> None:
    """Of the same length and date, too, as reproducible installations make files."""
    assert answer(sources) == 1024
    file = sources / f"{name}.py"
    before = file.stat()
    file.write_text(file.read_text().replace(old, new))
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert file.stat().st_size == before.st_size
    assert answer(sources) == expected


def test_numba_alone_would_have_answered_with_old_code(sources: Path) -> None:
    """Why `kernels` keeps a folder for every state of the source."""
    plain = "import numba\ndef compiled(loops, feature):\n    return numba.njit(loops, cache=True)\n"
    (sources / "plain.py").write_text(plain)
    for name in ("outer", "inner"):
        file = sources / f"{name}.py"
        file.write_text(file.read_text().replace("bodyseg_data.machine.kernels", "plain"))
    assert answer(sources) == 1024
    (sources / "limits.py").write_text("LIMIT = 3\n")
    assert answer(sources) == 1024, "this version of numba sees it: `kernels` may become simpler"


def test_another_processor_or_setting_has_other_code(monkeypatch: pytest.MonkeyPatch) -> None:
    def loops(x: int) -> int:
        return x

    digests = {kernels._digest(loops, numba)}
    monkeypatch.setenv("NUMBA_OPT", "1")
    digests.add(kernels._digest(loops, numba))
    monkeypatch.setattr("llvmlite.binding.get_host_cpu_name", lambda: "another")
    digests.add(kernels._digest(loops, numba))
    monkeypatch.setattr(numba, "__version__", "another")
    digests.add(kernels._digest(loops, numba))
    assert len(digests) == 4


@pytest.mark.parametrize("where", ["a file", "no home", "no room for a file", "no room for its bytes"])
def test_without_a_folder_that_can_be_written_loops_still_run(
    where: str, sources: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    kernels._of_process.cache_clear()
    if where == "a file":
        (tmp_path / "cache").write_text("")
    elif where == "no home":
        monkeypatch.delenv("XDG_CACHE_HOME")
        monkeypatch.setattr(Path, "expanduser", _no_home)
    elif where == "no room for a file":
        monkeypatch.setattr(kernels.tempfile, "TemporaryFile", _no_room)
    else:
        resource.setrlimit(resource.RLIMIT_FSIZE, (512, before[1]))
    try:
        with pytest.warns(RuntimeWarning, match="compiled loops cannot be kept in .*kernels|a home") as told:
            assert answer(sources) == 1024
        assert len(told) == 1 and not kept(tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_the_folder_of_a_process_goes_with_it_and_with_those_that_compile_into_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler = subprocess.Popen(["sleep", "100"])
    monkeypatch.setattr(kernels, "_processes", [compiler])
    monkeypatch.setattr(kernels.tempfile, "mkdtemp", lambda prefix: str(tmp_path / "own"))
    ends: list[Any] = []
    monkeypatch.setattr(kernels.atexit, "register", lambda *job, **options: ends.append(partial(*job, **options)))
    with pytest.warns(RuntimeWarning, match="compiled loops cannot be kept"):
        (kernels._of_process.__wrapped__(None) / "code").mkdir(parents=True)
    ends[0]()
    try:
        assert compiler.poll() == -signal.SIGKILL and not (tmp_path / "own").exists()
    finally:
        compiler.kill()
        compiler.wait()


def test_a_user_without_a_home_may_name_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "expanduser", _no_home)
    assert kernels._folder(str(tmp_path / "named"), "digest") == tmp_path / "named" / "digest"


def _no_home(path: Path) -> Path:
    raise RuntimeError("Could not determine home directory.")


def _no_room(**where: Any) -> None:
    raise OSError(28, "No space left on device")


def test_a_disk_that_fills_while_code_is_written_takes_nothing_but_the_cache(
    sources: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*given: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("numba.core.caching.IndexDataCacheFile.save", full)
    assert answer(sources) == 1024
    assert not kept(tmp_path)


def test_a_folder_may_be_named(sources: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "named"))
    assert answer(sources) == 1024
    assert list((tmp_path / "named").rglob("*.nbc")) and not kept(tmp_path)
    assert str(tmp_path / "named") == numba.config.CACHE_DIR


def test_an_interrupt_while_a_loop_is_compiled_comes_when_it_is_kept(
    sources: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where C calls Python, as here, it would be lost."""
    engine, came = cpu_target.target_context.codegen()._engine._ee, list[Any]()
    notify = engine._object_cache_notify

    def interrupted(module: Any, code: bytes) -> None:
        if module.name == "_inner" and not came:
            came.append(module)
            signal.raise_signal(signal.SIGINT)
        notify(module, code)

    monkeypatch.setattr(engine, "_object_cache_notify", interrupted)
    # SIGINT is ignored where tests run in the background; commands have a handler for SIGTERM.
    before = {number: signal.signal(number, signal.default_int_handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with pytest.raises(KeyboardInterrupt):
            answer(sources)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert came and kept(tmp_path)


def test_a_loop_that_cannot_be_compiled_leaves_the_handlers_of_signals(sources: Path) -> None:
    (sources / "inner.py").write_text(INNER.replace("x + 3", "unknown(x)"))
    terminated = signal.signal(signal.SIGTERM, signal.default_int_handler)
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    try:
        with pytest.raises(numba.errors.TypingError):
            answer(sources)
        assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before
    finally:
        signal.signal(signal.SIGTERM, terminated)


@pytest.mark.parametrize("told", [None, signal.SIG_DFL])
def test_handlers_of_c_stay(told: Any, sources: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of a program that embeds Python, which are None to Python, and of rclpy, of which Python knows nothing."""
    monkeypatch.setattr(signal, "getsignal", {signal.SIGINT: told, signal.SIGTERM: told}.get)
    monkeypatch.setattr(signal, "signal", None)
    assert answer(sources) == 1024


def test_processes_that_start_at_once_agree(sources: Path, tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(sources)}
    # Each of two types is first in one of them: numba alone may keep one's code as the other's.
    begin = "import numba, numpy; numba.config.CACHE_DIR = ''; from outer import outer; "
    codes = [f"{begin}print(outer({a}), outer({b}))" for a, b in (TYPES, TYPES[::-1])]
    with ExitStack() as stack:
        running = [stack.enter_context(warm.Program(["-c", code], env=environment)) for code in codes]
        assert [process.communicate(timeout=100)[0].strip() for process in running] == ["1024 1024"] * 2
    files = kept(tmp_path)
    assert sorted(len(list(folder.glob("*.nbc"))) for folder in {file.parent for file in files}) == [2, 2]
    assert not list((tmp_path / "cache").rglob("*.tmp.*"))
    assert answer(sources) == 1024


@pytest.fixture
def outer(sources: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The loops, in the way users have them."""
    for name in ("limits", "inner", "outer"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setenv(kernels.VARIABLE, "auto")
    monkeypatch.setattr(kernels, "_failed", [])
    monkeypatch.setattr(kernels, "_processes", [])
    return importlib.import_module("outer").outer


def tried(outer: Any) -> int | None:
    with kernels.if_ready:
        return int(outer(3))
    return None


def test_another_process_compiles_and_the_plain_form_serves_until_it_has(outer: Any, tmp_path: Path) -> None:
    assert tried(outer) is None and tried(outer) is None
    (process,) = kernels._processes
    assert process.wait(100) == 0
    assert kept(tmp_path) and tried(outer) == 1024
    assert len(kernels._processes) == 1


@pytest.mark.parametrize("how", ["cannot be started", "fails"])
def test_a_loop_that_no_other_process_compiles_is_compiled_here(
    how: str, outer: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_process(*given: Any) -> Any:
        if how == "fails":
            return SimpleNamespace(poll=lambda: 1, returncode=1)
        raise OSError(12, "Cannot allocate memory")

    monkeypatch.setattr(kernels, "_send", no_process)
    assert [tried(outer), tried(outer)] == ([None, 1024] if how == "fails" else [1024, 1024])


def test_no_more_processes_compile_than_there_are_processors(outer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernels, "_processes", [SimpleNamespace(poll=lambda: None)] * kernels.processors())
    monkeypatch.setattr(kernels, "_send", None)
    assert tried(outer) is None


def test_a_loop_that_another_process_compiles_is_waited_for_where_it_has_no_plain_form(
    outer: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernels, "_send", None)
    _, folder = outer._cache.files
    code = f"""
import fcntl, sys
file = open({str(folder / "compiling")!r}, "ab")
fcntl.lockf(file, fcntl.LOCK_EX)
print(flush=True)
sys.stdin.read()
"""
    other = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    with other, ThreadPoolExecutor(1) as threads:
        assert other.stdout is not None
        other.stdout.readline()
        assert tried(outer) is None
        answer = threads.submit(outer, 3)
        assert wait([answer], 0.2).not_done
        other.communicate()
        assert answer.result(100) == 1024


@pytest.mark.parametrize(
    ("loop", "variant"),
    [("apply", "all"), ("apply", "occ"), ("fill_camera", "all"), ("fill_projector", "all"), ("join_runs", "all")],
)
def test_whichever_loops_are_not_ready_yet_bits_are_the_same(
    loop: str, variant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def made() -> list[Any]:
        images = RangeImages(example_set(), variant, labels="limbs14")
        arrays = [(images.image(index).range, images.image(index).labels) for index in range(2)]
        return [each.tobytes() for pair in arrays for each in pair]

    def not_yet(*given: Any) -> None:
        raise kernels.NotYet

    with computed_by("compiled"):
        expected = made()
        for module in (fused_loops, bodyseg_loops, label_loops):
            if hasattr(module, loop):
                monkeypatch.setattr(module, loop, not_yet)
        assert made() == expected


@pytest.fixture
def asked_anew() -> Iterator[None]:
    kernels.use_compiled.cache_clear()
    yield
    kernels.use_compiled.cache_clear()


@pytest.mark.usefixtures("asked_anew")
@pytest.mark.parametrize(("choice", "expected"), [(None, True), ("auto", True), ("compiled", True), ("numpy", False)])
def test_the_environment_chooses(choice: str | None, expected: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(kernels.VARIABLE, raising=False)
    if choice is not None:
        monkeypatch.setenv(kernels.VARIABLE, choice)
    assert kernels.use_compiled() is expected


@pytest.mark.usefixtures("asked_anew")
def test_where_numba_is_told_to_compile_nothing_the_plain_form_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """NUMBA_DISABLE_JIT, as for a debugger: some loops call what only machine code has."""
    monkeypatch.setattr("numba.config.DISABLE_JIT", 1)
    assert kernels.use_compiled() is False


@pytest.mark.usefixtures("asked_anew")
def test_an_unknown_choice_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(kernels.VARIABLE, "fast")
    with pytest.raises(BadConfig, match="BODYSEG_KERNELS .*found 'fast'"):
        kernels.use_compiled()


@pytest.mark.usefixtures("asked_anew")
def test_without_numba_the_plain_form_runs_unless_the_compiled_one_is_demanded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(kernels.VARIABLE, raising=False)
    monkeypatch.setitem(sys.modules, "numba", None)  # as one that is there and cannot be imported
    assert kernels.use_compiled() is False
    kernels.use_compiled.cache_clear()
    monkeypatch.setenv(kernels.VARIABLE, "compiled")
    with pytest.raises(MissingLibrary, match=r"^BODYSEG_KERNELS=compiled needs the package 'numba'"):
        kernels.use_compiled()
    with pytest.raises(MissingLibrary, match="the raster renderer needs the package 'numba'"):
        kernels.compiled(lambda x: x, "the raster renderer")


@pytest.mark.usefixtures("asked_anew")
def test_a_process_without_numba_makes_the_same_images_and_loads_no_compiler(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code = """
import sys
sys.modules["numba"] = None
import numpy as np
from bodyseg_data.rigs.rig import load_rig
from bodyseg_data.samples.sample import Sample
from bodyseg_data.artifacts.variants import VARIANTS, Augmentation
shape = load_rig().camera.rows, load_rig().camera.columns
wall = np.full(shape, 25_000, np.uint16)
sample = Sample("k", wall, wall, np.zeros(shape, np.uint8), wall > 0, None)
for name in VARIANTS:
    augmentation = Augmentation(load_rig(), name)
    print(int(augmentation(sample).range.astype(np.int64).sum()))
assert "llvmlite" not in sys.modules
"""
    monkeypatch.delenv(kernels.VARIABLE, raising=False)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    exec("\n".join(line for line in code.split("\n") if not line.startswith(("sys.m", "assert"))), {})
    assert kernels.use_compiled() and done.stdout == capsys.readouterr().out
