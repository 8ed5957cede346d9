"""Pymeshlab in one thread that stays: what damages the heap without it, in processes whose malloc checks itself."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from folders import HELPERS, ROOT
from shapes import ball

from bodyseg_data.core import BadMesh
from bodyseg_data.meshes import repairing as pymeshlab_thread
from bodyseg_data.meshes import with_pymeshlab
from bodyseg_data.shards import read_manifest

pytestmark = pytest.mark.usefixtures("pymeshlab")

_CHECKED_MALLOC = {"LD_PRELOAD": "libc_malloc_debug.so.0", "GLIBC_TUNABLES": "glibc.malloc.check=3"}
_SCRIPT = """
import os, sys, threading, time
sys.path[:0] = {paths!r}
import numpy as np
from shapes import ball
from bodyseg_data.meshes import repairing as pymeshlab_thread
from bodyseg_data.meshes import repair

def ended(*works):
    threads = [threading.Thread(target=work) for work in works]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    # Python is done with them; C may still be ending them, and a fork then copies locks (of OpenSSL, of the malloc that
    # checks) which nobody in the child opens.
    while any(os.path.exists(f"/proc/self/task/{{thread.native_id}}") for thread in threads):
        time.sleep(0.001)

def repaired():
    whole = ball(subdivisions=3)
    repair("ball", whole.vertices, whole.faces)

{lines}
print("held", flush=True)
"""
_WITHOUT_REMEDY = "pymeshlab_thread._worker.call = lambda job: job()\n"
_IN_THREADS = """
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from fakes import Figures
from small_rig import SMALL
from bodyseg_data.bodies.sources import SOURCES
from bodyseg_data.samples import ViewGrid
from bodyseg_data.packing.mesh_reduction import edges_collapsed
from bodyseg_data.packing.options import Packing
from bodyseg_data.packing import pack

SOURCES["open"] = Figures
wanted = Packing("open", meshes=2, views=ViewGrid(count=1), rig=SMALL, tolerance_mm=1.0)
with ThreadPoolExecutor(2) as threads:
    pack(wanted, Path({out!r}), threads, 2)

whole = ball(subdivisions=3)
def collapsed():
    coarse, _ = edges_collapsed(whole, np.arange(33), len(whole.faces) // 4)
    return coarse.vertices.tobytes(), coarse.faces.tobytes()
alone, found = collapsed(), []
ended(*[lambda: found.extend(collapsed() for _ in range(3))] * 2)
assert found == [alone] * 6
"""


def _alone(lines: str, **environment: str) -> subprocess.CompletedProcess[str]:
    script = _SCRIPT.format(paths=[str(HELPERS), str(ROOT)], lines=lines)
    command = [sys.executable, "-c", script]
    return subprocess.run(
        command, capture_output=True, text=True, env=os.environ | environment, timeout=120, check=False
    )


@pytest.fixture(scope="module")
def checked_malloc() -> dict[str, str]:
    """The environment that shows damage: without the remedy, a repair in a thread that ends is death in every second
    process, as its memory happens to lie."""
    for _ in range(10):
        done = _alone(f"{_WITHOUT_REMEDY}ended(repaired)", **_CHECKED_MALLOC)
        if "libc_malloc_debug" in done.stderr:
            pytest.skip("glibc's libc_malloc_debug.so.0 is not installed")
        if done.returncode != 0:
            return _CHECKED_MALLOC
    pytest.skip("this pymeshlab survives the end of its thread without a remedy, so that nothing can be shown")


def test_a_thread_that_ends_leaves_the_heap_whole_also_in_a_forked_process(checked_malloc: dict[str, str]) -> None:
    lines = """
ended(repaired)
child = os.fork()
if child:
    assert os.waitpid(child, 0)[1] == 0
else:
    ended(repaired)
"""
    done = _alone(lines, **checked_malloc)
    assert (done.returncode, done.stdout) == (0, "held\n" * 2), done.stderr


def test_packing_and_reducing_in_threads_leave_the_heap_whole(checked_malloc: dict[str, str], tmp_path: Path) -> None:
    done = _alone(_IN_THREADS.format(out=str(tmp_path / "out")), **checked_malloc)
    assert (done.returncode, done.stdout) == (0, "held\n"), done.stderr
    notes = read_manifest(tmp_path / "out").notes()
    assert len(notes) == 2 and all("reduced from 6400 to" in note for note in notes)


def _torch_library() -> Path:
    found = importlib.util.find_spec("torch")
    assert found is not None and found.origin is not None
    return Path(found.origin).with_name("lib") / "libtorch_cpu.so"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc is Linux's")
def test_libraries_that_others_bring_too_stay_theirs() -> None:
    """Without the remedy PyTorch, OpenVINO and ssl, loaded after pymeshlab, use those that it brings.

    PyTorch's library is what finds them: its Python takes ten times as long to import.
    """
    if importlib.util.find_spec("openvino") is None:
        pytest.skip("openvino is not installed")
    lines = f"""
repaired()
import ctypes, openvino, ssl
ctypes.CDLL({str(_torch_library())!r})
openvino.Core()
for line in open("/proc/self/maps"):
    if ".so" in line:
        print(line.split()[-1])
"""
    done = _alone(lines)
    assert done.returncode == 0, done.stderr
    loaded: dict[str, set[str]] = {"libgomp": set(), "libtbb": set(), "libcrypto": set()}
    for path in map(Path, done.stdout.splitlines()):
        loaded.get(path.name.partition(".")[0], set()).add(str(path))
    assert all(loaded.values())
    assert not [path for paths in loaded.values() for path in paths if "pymeshlab" in path]


def test_all_work_is_done_in_one_thread_that_stays() -> None:
    def here(_: Any) -> threading.Thread:
        return threading.current_thread()

    with ThreadPoolExecutor(2) as pool:
        seen = {with_pymeshlab("a test", here), *pool.map(lambda _: with_pymeshlab("a test", here), range(4))}
    (thread,) = seen
    assert thread.daemon and thread.is_alive() and thread is not threading.current_thread()


def test_what_work_raises_is_raised_and_what_it_held_ends_in_the_thread() -> None:
    ended_in = list[threading.Thread]()

    def fail(_: Any) -> None:
        held = ball(subdivisions=0)
        weakref.finalize(held, lambda: ended_in.append(threading.current_thread()))
        try:
            raise KeyError("inner")
        except KeyError as error:
            raise BadMesh("outer") from error

    with pytest.raises(BadMesh, match="outer") as caught:
        with_pymeshlab("a test", fail)
    assert isinstance(caught.value.__cause__, KeyError)
    assert [thread.name for thread in ended_in] == ["pymeshlab"]
    assert with_pymeshlab("a test", lambda _: "goes on") == "goes on"


def test_a_package_without_such_a_library_is_no_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "stub_of_a_test", ModuleType("stub_of_a_test"))  # has no __spec__
    for package in ("torch", "not_installed", "stub_of_a_test"):
        monkeypatch.setattr(pymeshlab_thread, "_SHARED_LIBRARIES", ((package, "lib/none.so"),))
        pymeshlab_thread._load_shared_libraries()
