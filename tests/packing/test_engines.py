"""Packing on a real scheduler with real workers, processes of their own, and what can go wrong with them."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import importlib
import multiprocessing
import os
import re
import signal
import socket
import sys
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from fakes import Figures
from folders import HELPERS, ROOT
from people_on_disk import PERSON, VERTICES, turn, write_lnd, write_mesh
from servers import free_port
from small_rig import SMALL, SMALL_FILE
from warm import Program

from bodyseg_data.bodies import SOURCES, Body, BodyRef
from bodyseg_data.commands import main
from bodyseg_data.core import BadConfig, BadMesh, MissingLibrary
from bodyseg_data.meshes import Mesh
from bodyseg_data.packing import Packing, check_engine, cluster, open_engine, pack
from bodyseg_data.packing import cluster as workers
from bodyseg_data.packing.jobs import Engine, processes
from bodyseg_data.packing.options import forget_sources
from bodyseg_data.packing.writing import STATE_NAME
from bodyseg_data.samples import ViewGrid

PACKING = Packing("open", rig=SMALL, views=ViewGrid(span_deg=360, count=4), shard_samples=5)  # as figures_set


def contents(folder: Path) -> dict[str, str]:
    """Name -> hash of every file of a set."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir() if path.is_file()}


WITHIN_S: Final = 100
"""How long what takes a moment may take on a busy machine."""


def test_a_machine_without_shared_memory_is_told_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def lock(*arguments: object) -> None:
        raise PermissionError(13, "Permission denied")  # as the system where /dev/shm cannot be written

    monkeypatch.setattr("multiprocessing.synchronize._multiprocessing.SemLock", lock)
    with pytest.raises(BadConfig, match="^processes need locks, .* in /dev/shm: Permission denied"), processes(1):
        pass


@pytest.mark.parametrize("place", ["synchronize._multiprocessing.SemLock", "context.SpawnProcess._Popen"])
def test_a_limit_of_processes_is_no_fault_of_folders(
    place: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def fork(*arguments: object) -> None:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(f"multiprocessing.{place}", fork)
    refused = pytest.raises(BadConfig, match="^no process can be started: ulimit -u or the container allows no more")
    with refused, processes(1) as engine:
        pack(PACKING, tmp_path / "set", engine.executor, 1)


def until(true: Callable[[], Any], what: str) -> None:
    deadline = time.monotonic() + WITHIN_S
    while not true():
        assert time.monotonic() < deadline, what
        time.sleep(0.02)


def answers(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
        return True
    return False


_QUIET: Final = {
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "1s",
    "DASK_DISTRIBUTED__ADMIN__SYSTEM_MONITOR__INTERVAL": "5s",
}
"""Settings of Dask with which nodes that wait take next to no processor time."""


NODE: Final = """
import os, sys
log = os.open(sys.argv.pop(1), os.O_WRONLY | os.O_CREAT)
for stream in (1, 2):
    os.dup2(log, stream)
import dask
dask.config.refresh()  # it was imported before this environment was there
from distributed.cli.dask_{kind} import main
main()
"""
"""What a node runs: `dask scheduler` or `dask worker`, its settings those of its own environment."""


@dataclass
class Nodes:
    """A scheduler and its workers, each in a process group of its own."""

    folder: Path
    port: int = 0
    scheduler: Program | None = None
    workers: list[Program] = field(default_factory=list)
    started: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)

    @property
    def engine(self) -> str:
        return f"dask://127.0.0.1:{self.port}"

    def start(self, *module: str, **environment: str) -> Program:
        log = self.folder / f"{module[0]}-{len(self.workers)}.log"
        paths = os.pathsep.join([str(HELPERS), str(ROOT)])
        settings = {
            "BODYSEG_TROUBLE": str(self.folder),
            "PYTHONPATH": paths,
            "OMP_NUM_THREADS": "1",
            **_QUIET,
            **environment,
        }
        words = ["-c", NODE.format(kind=module[0]), str(log), *module[1:]]
        program = Program(words, start_new_session=True, cwd=self.folder, env=os.environ | settings)
        return self.started.enter_context(program)

    def start_scheduler(self, **environment: str) -> None:
        self.port = free_port()
        words = ("--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard", "--no-show")
        self.scheduler = self.start("scheduler", *words, **environment)
        until(lambda: answers(self.port), "the scheduler does not start")

    def start_worker(self, *words: str) -> Program:
        address = f"tcp://127.0.0.1:{self.port}"
        more = ("--no-dashboard", "--preload", str(HELPERS / "figure_worker.py"), "--local-directory", str(self.folder))
        self.workers.append(self.start("worker", address, "--host", "127.0.0.1", *more, *words))
        return self.workers[-1]

    def wait_for_workers(self, count: int) -> None:
        import distributed

        with distributed.Client(f"tcp://127.0.0.1:{self.port}", timeout=10, set_as_default=False) as client:
            client.wait_for_workers(count, timeout=WITHIN_S)

    def tasks(self) -> int:
        """Number of tasks that the scheduler holds."""
        import distributed

        with distributed.Client(f"tcp://127.0.0.1:{self.port}", timeout=10, set_as_default=False) as client:
            return int(client.run_on_scheduler(lambda dask_scheduler: len(dask_scheduler.tasks)))

    @contextlib.contextmanager
    def trouble(self, kind: str) -> Iterator[None]:
        for old in self.folder.glob("begun-*"):
            old.unlink()
        (self.folder / kind).touch()
        try:
            yield
        finally:
            (self.folder / kind).unlink()

    def begun(self) -> set[int]:
        """Processes that have begun a body."""
        return {int(path.name.removeprefix("begun-")) for path in self.folder.glob("begun-*")}

    def stop(self) -> None:
        for process in [*self.workers, self.scheduler]:
            if process is not None:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
        self.started.close()


@contextlib.contextmanager
def running(folder: Path, *workers: tuple[str, ...], **environment: str) -> Iterator[Nodes]:
    nodes = Nodes(folder)
    try:
        nodes.start_scheduler(**environment)
        for words in workers:
            nodes.start_worker(*words)
        if workers:
            nodes.wait_for_workers(len(workers))
        yield nodes
    finally:
        nodes.stop()


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Nodes]:
    """Two plain processes, one of them with two threads. A worker that Dask's nanny starts is in `frail_nodes`."""
    kinds = [("--no-nanny", "--nthreads", "1"), ("--no-nanny", "--nthreads", "2")]
    with running(tmp_path_factory.mktemp("nodes"), *kinds) as started:
        yield started


@pytest.fixture(autouse=True)
def figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """This process packs figures, too."""
    monkeypatch.setitem(SOURCES, "open", Figures)


def pack_on(nodes: Nodes, out: Path, progress: Callable[[int, int], None] = lambda done, total: None) -> Engine:
    with open_engine(nodes.engine, None, PACKING) as engine:
        pack(PACKING, out, engine.executor, engine.workers, progress)
    return engine


def test_a_cluster_packs_the_same_bytes(nodes: Nodes, tmp_path: Path, figures_set: Path) -> None:
    before = set(threading.enumerate())
    engine = pack_on(nodes, tmp_path / "shards")
    assert contents(tmp_path / "shards") == contents(figures_set)
    assert engine.workers == 2
    assert nodes.tasks() == 0
    assert not [thread for thread in set(threading.enumerate()) - before if not thread.daemon]


def test_results_leave_the_cluster_as_they_are_written(nodes: Nodes, tmp_path: Path) -> None:
    seen: list[int] = []

    def look(done: int, total: int) -> None:
        seen.append(nodes.tasks())

    with open_engine(nodes.engine, 1, PACKING) as engine:
        assert engine.workers == 1
        pack(PACKING, tmp_path / "shards", engine.executor, engine.workers, look)
        # The scheduler is told of a result that is let go a moment later.
        until(lambda: nodes.tasks() == 0, "results stay on the cluster")
    # Figures are cut into 8 runs; the last ones are alone, so nothing that was written is held on to.
    assert max(seen) <= 2 * engine.workers + 1


def test_a_worker_killed_at_work_changes_nothing(nodes: Nodes, tmp_path: Path, figures_set: Path) -> None:
    spare = nodes.start_worker("--no-nanny", "--nthreads", "1")
    nodes.wait_for_workers(3)

    def kill() -> None:
        until(lambda: spare.pid in nodes.begun(), "the spare worker gets nothing to do")
        spare.send_signal(signal.SIGKILL)

    with nodes.trouble("slow"):
        killer = threading.Thread(target=kill)
        killer.start()
        pack_on(nodes, tmp_path / "shards")
        killer.join()
    assert spare.wait() == -signal.SIGKILL
    assert contents(tmp_path / "shards") == contents(figures_set)


def test_a_bad_body_is_one_error_whatever_the_cluster(nodes: Nodes, tmp_path: Path, figures_set: Path) -> None:
    out = tmp_path / "shards"
    with nodes.trouble("bad"), pytest.raises(BadMesh, match="^mesh A-1: faces must point outwards$"):
        pack_on(nodes, out)
    until(lambda: nodes.tasks() == 0, "jobs stay on the cluster")
    pack_on(nodes, out)
    assert contents(out) == contents(figures_set)


def test_workers_that_would_give_other_bytes_are_named(
    nodes: Nodes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = workers.expected

    def older(packing: Packing) -> workers.Expected:
        wanted = found(packing)
        return replace(wanted, facts={**wanted.facts, "embreex": "0.1"})

    with monkeypatch.context() as patch:
        patch.setattr(cluster, "expected", older)
        with (
            pytest.raises(BadConfig, match=r"^worker tcp://127.0.0.1:\d+ has embreex .* has 0\.1: "),
            open_engine(nodes.engine, None, PACKING),
        ):
            pass
    monkeypatch.setattr(Figures, "fingerprint", lambda self, bodies: "other")
    with (
        pytest.raises(BadConfig, match=r"^worker tcp://127.0.0.1:\d+ has bodies \w+, this machine has \w+: share one "),
        open_engine(nodes.engine, None, PACKING),
    ):
        pass

    class Folder(Figures):
        reads = "meshes"

        def __init__(self, *_: object) -> None:
            pass

    monkeypatch.setitem(SOURCES, "folder", Folder)
    here = workers.expected(Packing("folder", tmp_path))
    assert workers.fault(here) is None
    found_here = here.facts["bodies"]
    assert workers.fault(replace(here, facts={**here.facts, "bodies": "other"})) == (
        f"has bodies {found_here}, this machine has other: share one folder with the workers, or install the same "
        "source on both"
    )
    assert workers.fault(replace(here, facts={**here.facts, "shadow thresholds": "other"})) == (
        "has shadow thresholds ShadowThresholds(surface_gap_m=0.006, edge_m=0.02), this machine has other: "
        "install the same versions on both"
    )
    more = {**here.facts, "fresh": "1"}
    assert workers.fault(replace(here, facts=more)) == (
        "has fresh none, this machine has 1: install the same versions on both"
    )


def test_a_worker_with_another_processor_is_named(nodes: Nodes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Here the last bit of one coordinate differs."""
    plain = Figures.build

    def build(self: Figures, body: BodyRef) -> Body:
        built = plain(self, body)
        vertices = built.mesh.vertices.copy()
        vertices[0, 0] = np.nextafter(vertices[0, 0], 1)
        return replace(built, mesh=Mesh(body.mesh, vertices, built.mesh.faces))

    monkeypatch.setattr(Figures, "build", build)
    with (
        pytest.raises(BadConfig, match=r"^worker tcp://127.0.0.1:\d+ has the first body as built \w+, .* of processor"),
        open_engine(nodes.engine, None, PACKING),
    ):
        pass


def test_every_package_that_makes_shards_is_compared() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    names = {re.split(r"[^\w-]", line)[0] for line in (*extras["render"], *extras["pymeshlab"])}
    assert names
    assert names <= set(workers._SHAPE_BYTES)


def test_a_worker_that_comes_late_is_checked_with_its_first_job() -> None:
    wanted = workers.expected(PACKING)
    assert workers.job(wanted, sum, ((1, 2),)) == 3
    error = workers.job(replace(wanted, facts={**wanted.facts, "bodies": "other"}), sum, ((1, 2),))
    assert isinstance(error, BadConfig)
    assert f"worker {socket.gethostname()} has bodies " in str(error)


def test_a_worker_does_one_thing_at_a_time() -> None:
    """Also the check of a second packing, while a job of a first is under way."""
    wanted = workers.expected(PACKING)
    with ThreadPoolExecutor(1) as thread:
        with workers._one_at_a_time:
            checking = thread.submit(workers.fault, wanted)
            with pytest.raises(TimeoutError):
                checking.result(0.2)
        assert checking.result(10) is None


def test_a_notebook_has_a_loop_of_its_own(nodes: Nodes) -> None:
    async def cell() -> int:
        with open_engine(nodes.engine, None, PACKING) as engine:
            return engine.executor.submit(sum, (1, 2)).result(30)

    assert asyncio.run(cell()) == 3


def _landmarked(root: Path, swapped: bool) -> None:
    """One person in a folder, as scanned; two landmarks of the other side each if swapped."""
    turned = PERSON.vertices @ turn("-x", "z") * 1000
    points = PERSON.vertices[list(VERTICES)] @ turn("-x", "z")
    if swapped:
        points[[4, 5]] = points[[5, 4]]
    write_mesh(root / "ann.ply", turned)
    write_lnd(root / "ann.lnd", points)


def test_running_workers_read_changed_landmarks(nodes: Nodes, tmp_path: Path) -> None:
    """On a cluster, on processes of one engine, and in a process that packs again."""
    root = tmp_path / "people"
    wanted = Packing("folder", root, views=ViewGrid(count=1))
    found: dict[bool, list[dict[str, str]]] = {False: [], True: []}

    def keep(swapped: bool, name: str, engine: Engine) -> None:
        out = tmp_path / f"{name}-{swapped}"
        pack(wanted, out, engine.executor, engine.workers)
        found[swapped].append(contents(out))

    with open_engine("processes", 1, wanted) as here, ThreadPoolExecutor(1) as thread:
        for swapped in (False, True):
            _landmarked(root, swapped)
            with open_engine(nodes.engine, None, wanted) as there:
                keep(swapped, "cluster", there)
            keep(swapped, "processes", here)
            keep(swapped, "threads", Engine(thread, 1))
    forget_sources()
    with ThreadPoolExecutor(1) as thread:
        keep(True, "afresh", Engine(thread, 1))
    before, after = found[False][0], found[True][-1]
    assert before["train-00000.tar"] != after["train-00000.tar"]
    assert all(each == before for each in found[False])
    assert all(each == after for each in found[True])


def test_an_error_leaves_the_users_own_children_alone() -> None:
    child = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60,))
    child.start()
    try:
        with pytest.raises(BadMesh), open_engine("processes", 1, PACKING) as engine:
            started = engine.executor.submit(os.getpid)
            assert started.result(60) != child.pid
            raise BadMesh("mesh A-1: faces must point outwards")
        assert child.is_alive()
        assert multiprocessing.active_children() == [child]
    finally:
        child.kill()
        child.join()


def test_nodes_without_bodyseg_are_named(nodes: Nodes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A module that is only here stands for one that an older version, or none, does not have there."""
    (tmp_path / "only_here.py").write_text("def check(wanted): pass\ndef installed(): pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    only_here = importlib.import_module("only_here")
    for name, node in (("check", "worker tcp://.*"), ("installed", "the scheduler at .* was lost, or")):
        with monkeypatch.context() as patch:
            wanted = workers.expected(PACKING)
            patch.setattr(cluster, name, getattr(only_here, name))
            patch.setattr(cluster, "expected", lambda packing, wanted=wanted: wanted)
            with (
                pytest.raises(BadConfig, match=f"^{node} cannot load bodyseg .*No module.*only_here"),
                open_engine(nodes.engine, None, PACKING),
            ):
                pass


@pytest.fixture(scope="module")
def frail_nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Nodes]:
    """A scheduler, without workers yet, that gives a body up with the first worker it kills."""
    with running(tmp_path_factory.mktemp("frail"), DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="0") as started:
        yield started


def test_a_scheduler_without_workers(frail_nodes: Nodes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "CONNECT_TIMEOUT_S", 1.0)
    assert "has no workers; start some with: dask worker 127.0.0.1:" in connecting_to(frail_nodes.port)


def test_a_body_that_kills_its_workers_is_named(frail_nodes: Nodes, tmp_path: Path) -> None:
    frail_nodes.start_worker("--nanny", "--nthreads", "1")
    frail_nodes.wait_for_workers(1)
    with frail_nodes.trouble("deadly"), pytest.raises(BadConfig, match="^mesh A-1: every worker .* was killed"):
        pack_on(frail_nodes, tmp_path / "shards")


def test_a_lost_scheduler_loses_nothing(
    frail_nodes: Nodes, tmp_path: Path, figures_set: Path, pack_figures: Callable[..., Path]
) -> None:
    frail_nodes.wait_for_workers(1)
    out = tmp_path / "shards"

    def kill(done: int, total: int) -> None:
        if done > 8 and frail_nodes.scheduler is not None:
            frail_nodes.scheduler.send_signal(signal.SIGKILL)

    start = time.monotonic()
    with (
        frail_nodes.trouble("slow"),
        pytest.raises(BadConfig, match="^the scheduler at 127.0.0.1:[0-9]+ was lost: the"),
    ):
        pack_on(frail_nodes, out, kill)
    assert time.monotonic() - start < WITHIN_S
    assert (out / STATE_NAME / "train-00000.tar.json").exists()
    pack_figures(out, shard_samples=5)  # without a cluster
    assert contents(out) == contents(figures_set)


COMMAND = "import figure_worker; from bodyseg_data.commands.cli import main; raise SystemExit(main())"


def command_words(nodes: Nodes, out: Path) -> list[str]:
    words = ["shard", "--source", "open", "--views", "4", "--azimuth-span", "360", "--shard-samples", "5"]
    return [*words, "--rig", str(SMALL_FILE), "--engine", nodes.engine, "--out", str(out)]


def command(nodes: Nodes, out: Path) -> Program:
    environment = os.environ | {"PYTHONPATH": str(HELPERS), "BODYSEG_TROUBLE": str(nodes.folder)}
    return Program(["-c", COMMAND, *command_words(nodes, out)], env=environment)


def test_the_command_packs_on_a_cluster(
    nodes: Nodes, tmp_path: Path, figures_set: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(command_words(nodes, tmp_path / "shards")) == 0
    said = capfd.readouterr()
    assert said.out.startswith(f"{tmp_path / 'shards'}: 24 samples in 6 shards")
    assert all(line.startswith("packing: ") for line in said.err.splitlines())
    assert contents(tmp_path / "shards") == contents(figures_set)


@pytest.mark.parametrize(("number", "said", "status"), [(signal.SIGINT, "interrupted", 130)])
def test_a_packing_that_is_stopped_leaves_the_cluster_clean(
    number: signal.Signals, said: str, status: int, nodes: Nodes, tmp_path: Path
) -> None:
    with nodes.trouble("slow"), command(nodes, tmp_path / "shards") as process:
        until(lambda: len(nodes.begun()) == 2, "packing does not begin")
        process.send_signal(number)
        _, printed = process.communicate(timeout=WITHIN_S)
    assert process.returncode == status
    assert [line for line in printed.splitlines() if not line.startswith("packing: ")] == [f"bodyseg shard: {said}"]
    until(lambda: nodes.tasks() == 0, "jobs stay on the cluster")


@pytest.mark.parametrize(
    "name", ["dask", "dask://host", "tcp://host:1", "dask://:8786", "dask://a:0", "dask://a:65536"]
)
def test_an_engine_has_a_name_that_is_known(name: str) -> None:
    with pytest.raises(BadConfig, match=f"engine .*found '{name}'"):
        check_engine(name)


def test_hosts_may_be_names_and_addresses() -> None:
    assert check_engine("processes") is None
    assert check_engine("dask://node-7.example.org:8786") == ("node-7.example.org", 8786)
    assert check_engine("dask://[::1]:1") == ("[::1]", 1)


@pytest.mark.parametrize("count", [0, 1025, 2**31])
def test_an_engine_has_workers_that_a_machine_can_start(count: int) -> None:
    with (
        pytest.raises(BadConfig, match=f"workers must be a whole number from 1 to 1024, found {count}"),
        open_engine("processes", count, PACKING),
    ):
        pass


def connecting_to(port: int) -> str:
    with pytest.raises(BadConfig) as caught, open_engine(f"dask://127.0.0.1:{port}", None, PACKING):
        pass
    return str(caught.value)


def test_nobody_there() -> None:
    port = free_port()
    assert (
        connecting_to(port)
        == f"no Dask scheduler at 127.0.0.1:{port}: Connection refused; start one with: dask scheduler"
    )
    with (
        pytest.raises(BadConfig, match="no Dask scheduler at no.host.invalid:1: "),
        open_engine("dask://no.host.invalid:1", None, PACKING),
    ):
        pass


class _Silent(BaseHTTPRequestHandler):
    def log_message(self, *arguments: Any) -> None:
        pass


def test_somebody_else_there(nodes: Nodes, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(cluster, "CONNECT_TIMEOUT_S", 0.2)
        with socket.create_server(("127.0.0.1", 0)) as silent:
            assert "is no Dask scheduler (TimeoutError)" in connecting_to(silent.getsockname()[1])
        with HTTPServer(("127.0.0.1", 0), _Silent) as server:
            serving = threading.Thread(target=server.serve_forever)
            serving.start()
            assert "is no Dask scheduler (" in connecting_to(server.server_port)
            server.shutdown()
            serving.join()
    import distributed

    with distributed.Client(f"tcp://127.0.0.1:{nodes.port}", set_as_default=False) as client:
        worker = next(iter(client.nthreads()))
    assert "is no Dask scheduler (Worker)" in connecting_to(int(worker.rpartition(":")[2]))


def test_without_dask(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(MissingLibrary, match=r"pip install 'bodyseg\[cluster\]'"),
        open_engine("dask://a:1", None, PACKING),
    ):
        pass
