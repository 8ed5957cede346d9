"""A running Dask cluster as the executor of a packing's jobs.

Only jobs and results cross Dask's connections: a job is a packing, a body's name and views; a result is encoded
samples. Dask runs a job again when its worker dies, and jobs give the same bytes wherever they run, so a set is the
same whichever workers there were. Before its jobs, a worker is checked: it must give the same bytes as this machine.
"""

import asyncio
import hashlib
import importlib.metadata
import logging
import platform
import socket
import threading
import uuid
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future, InvalidStateError, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

from bodyseg_data.bodies import BodyRef
from bodyseg_data.core import BadConfig, BodysegError
from bodyseg_data.machine import missing_library
from bodyseg_data.packing.jobs import Engine
from bodyseg_data.packing.options import PACKING_VERSION, Packing, evenly_sampled, forget_sources
from bodyseg_data.packing.skipping import SKIPPABLE
from bodyseg_data.samples import SHADOW_THRESHOLDS

_SHAPE_BYTES: Final = (
    "bodyseg", "anny", "embreex", "llvmlite", "numba", "numpy", "pillow", "pygeodesic", "pymeshlab", "pyrender",
    "rtree", "scipy", "torch", "trimesh", "zstandard",
)  # fmt: skip
"""The packages that a sample's bytes can depend on."""

_SEEN_BODIES: Final = 8

# A body model, torch's number of threads and OpenGL are a process's, not a thread's.
_one_at_a_time = threading.RLock()

CONNECT_TIMEOUT_S: Final = 5.0
"""The time that a scheduler may take to answer, and a first worker to appear."""


@dataclass(frozen=True)
class Expected:
    """Facts that a worker must share with the process that packs, so that it gives the same bytes.

    installed: (name, version) pairs. seen: digest of the source's bodies as that process reads them. built: digest of
    the first of them as its processor computes it. token: tells this packing from an earlier one with the same options,
    whose files may have changed since.
    """

    packing: Packing
    installed: tuple[tuple[str, str], ...]
    seen: str
    built: str
    token: str


def expected(packing: Packing) -> Expected:
    """The facts of this process. Raises BodysegError as opening the source and building a body do."""
    with _one_at_a_time:
        forget_sources()
        return Expected(packing, installed(), _seen(packing), _built(packing), uuid.uuid4().hex)


@lru_cache(maxsize=1)
def installed() -> tuple[tuple[str, str], ...]:
    """(name, version or "none") of everything in this process that a sample's bytes can depend on."""
    found = [
        ("packing version", str(PACKING_VERSION)),
        ("shadow thresholds", str(SHADOW_THRESHOLDS)),
        ("processor", platform.machine()),
        ("python", ".".join(platform.python_version_tuple()[:2])),
    ]
    for name in _SHAPE_BYTES:
        try:
            version = importlib.metadata.version(name).partition("+")[0]  # which build of torch makes no difference
        except importlib.metadata.PackageNotFoundError:
            version = "none"
        found.append((name, version))
    return tuple(found)


def _seen(packing: Packing) -> str:
    """Digest of all bodies' names and of the files of a few: enough to tell another folder, and quickly read."""
    bodies = packing.bodies()
    few = evenly_sampled(bodies, min(_SEEN_BODIES, len(bodies)))
    return hashlib.sha256(repr((bodies, [_fingerprint(packing, body) for body in few])).encode()).hexdigest()


def _fingerprint(packing: Packing, body: BodyRef) -> str:
    try:
        return packing.opened().fingerprint([body])
    except SKIPPABLE:
        return "at fault"  # packing reports it, with all others


def _built(packing: Packing) -> str:
    """Digest of the first body that can be built, as built: libraries choose instructions by processor, and last bits
    differ with them.
    """
    for ref in packing.bodies():
        try:
            body = packing.opened().build(ref)
        except SKIPPABLE:
            continue
        arrays = (body.mesh.vertices, body.mesh.faces, body.landmarks)
        return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()
    return "no body can be built"


def fault(wanted: Expected) -> str | None:
    """The reason why this worker would not give the same bytes, or None."""
    with _one_at_a_time:
        return _fault(wanted)


@lru_cache(maxsize=64)
def _fault(wanted: Expected) -> str | None:
    for (name, there), (_, here) in zip(wanted.installed, installed(), strict=True):
        if there != here:
            return f"has {name} {here}, this machine has {there}: install the same versions on both"
    forget_sources()
    packing = wanted.packing
    try:
        if _seen(packing) != wanted.seen:
            if packing.path is None:
                return f"sees other bodies of the source {packing.source} than this machine: install the same on both"
            return f"sees other bodies in {packing.path} than this machine: share one folder with the workers"
        if _built(packing) != wanted.built:
            return (
                "builds the first body with other bits than this machine: use workers with the same kind of processor"
            )
    except BodysegError as error:
        return str(error)
    return None


async def check(wanted: Expected) -> str | None:
    """`fault` in a thread, so that the worker answers its scheduler meanwhile."""
    return await asyncio.to_thread(fault, wanted)


def job(wanted: Expected, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """Call `function` on a worker; a BodysegError is returned, not raised, so that no log holds a traceback."""
    with _one_at_a_time:
        problem = fault(wanted)  # known already, unless this worker came late
        if problem is not None:
            return BadConfig(f"worker {socket.gethostname()} {problem}")
        try:
            return function(*arguments)
        except BodysegError as error:
            return error


@contextmanager
def cluster(address: tuple[str, int], workers: int | None, packing: Packing) -> Iterator[Engine]:
    """The cluster of the scheduler at (host, port); see `open_engine`. Leaving it drops what is queued there."""
    try:
        import distributed
    except ImportError as error:
        raise missing_library("packing on a Dask cluster", error, extra="cluster") from error
    scheduler = f"{address[0]}:{address[1]}"
    with _quiet():
        wanted = expected(packing)
        client = _connect(distributed, address)
        try:
            threads = _workers(client, scheduler)
            _check_workers(client, wanted, scheduler, list(threads))
            executor = _Cluster(client, wanted, scheduler)
            try:
                yield Engine(executor, workers or len(threads), _note(threads))
            finally:
                executor.shutdown(cancel_futures=True)
        finally:
            with suppress(Exception):  # a scheduler that is gone cannot be told that this client goes
                client.close(CONNECT_TIMEOUT_S)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the logs of Dask and asyncio: this module reports the same faults in one line."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=r"distributed|tornado|asyncio")
            yield
    finally:
        logging.disable(before)


def _connect(distributed: Any, address: tuple[str, int]) -> Any:
    host, port = address
    try:
        # Dask tries for as long as it may, whatever the reason; a plain connection says it at once.
        socket.create_connection((host.strip("[]"), port), CONNECT_TIMEOUT_S).close()
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise BadConfig(f"no Dask scheduler at {host}:{port}: {reason}; start one with: dask scheduler") from error
    try:
        with ThreadPoolExecutor(1) as thread:  # in this one a loop may run already, as in a notebook
            kind = thread.submit(asyncio.run, _identify(distributed, f"tcp://{host}:{port}")).result()
        if kind == "Scheduler":
            return distributed.Client(f"tcp://{host}:{port}", timeout=CONNECT_TIMEOUT_S, set_as_default=False)
    except Exception as error:  # whatever the other side's bytes lead to
        kind = type(error).__name__
    raise BadConfig(f"what answers at {host}:{port} is no Dask scheduler ({kind})")


async def _identify(distributed: Any, address: str) -> str:
    """The kind of Dask server at an address. A client itself would wait without end for one that does not answer."""
    async with distributed.rpc(address, timeout=CONNECT_TIMEOUT_S) as server:
        identity = await asyncio.wait_for(server.identity(), CONNECT_TIMEOUT_S)
    return str(identity["type"])


def _workers(client: Any, scheduler: str) -> dict[str, int]:
    """Address -> threads, of every worker of the cluster."""
    try:
        client.wait_for_workers(1, timeout=CONNECT_TIMEOUT_S)
        threads: dict[str, int] = client.nthreads()
    except Exception as error:
        raise BadConfig(
            f"the scheduler at {scheduler} has no workers; start some with: dask worker {scheduler} --nthreads 1"
        ) from error
    return threads


def _check_workers(client: Any, wanted: Expected, scheduler: str, workers: list[str]) -> None:
    try:
        client.run_on_scheduler(installed)
    except Exception as error:
        raise BadConfig(
            f"the scheduler at {scheduler} cannot load bodyseg of this version, which jobs pass through: "
            f"install it there, too ({error})"
        ) from error
    # A source may fill a cache on first use, which the workers of one machine, or of one shared folder, would all do.
    machines = {worker.rpartition(":")[0]: worker for worker in workers}
    for group in (workers[:1], list(machines.values()), workers):
        try:
            answers = client.run(check, wanted, workers=group, on_error="return")
        except Exception as error:
            raise _lost(scheduler) from error
        for worker, answer in sorted(answers.items()):
            if isinstance(answer, Exception):
                answer = f"cannot load bodyseg of this version: install the same versions on both ({answer})"
            if answer is not None:
                raise BadConfig(f"worker {worker} {answer}")


def _note(threads: dict[str, int]) -> str | None:
    many = sorted(worker for worker, count in threads.items() if count > 1)
    if not many:
        return None
    return (
        f"{len(many)} of {len(threads)} workers have several threads and use one of them "
        f"({many[0]} has {threads[many[0]]}): start one worker a core, with --nthreads 1"
    )


def _lost(scheduler: str) -> BadConfig:
    return BadConfig(f"the scheduler at {scheduler} was lost: the same command carries on, there or with other workers")


class _Cluster(Executor):
    """Dask's executor, whose futures also end when the scheduler is lost, and whose errors are one line."""

    def __init__(self, client: Any, wanted: Expected, scheduler: str) -> None:
        self._client, self._wanted, self._scheduler = client, wanted, scheduler
        self._inner = client.get_executor(pure=False)
        self._waiting: set[Future[Any]] = set()
        self._over = threading.Event()
        self._watch = threading.Thread(target=self._watch_scheduler, daemon=True)
        self._watch.start()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        if self._over.is_set():
            raise RuntimeError("cannot schedule new futures after shutdown")
        if self._client.status != "running":
            raise _lost(self._scheduler)
        body = next((argument.mesh for argument in args if isinstance(argument, BodyRef)), "?")
        # Dask's future ends with the one here, and so do the worker's memory and this one's: nothing else holds it.
        answer: Future[Any] = Future()
        answer.set_running_or_notify_cancel()
        self._waiting.add(answer)
        inner = self._inner.submit(job, self._wanted, fn, args, **kwargs)
        inner.add_done_callback(lambda done: self._answer(answer, done, body))
        return answer

    def _answer(self, answer: Future[Any], done: Future[Any], body: str) -> None:
        try:
            result = done.result()
        except BaseException as error:
            result = self._as_one_line(error, body)
        self._waiting.discard(answer)
        with suppress(InvalidStateError):  # the scheduler was lost before
            if isinstance(result, BaseException):
                answer.set_exception(result)
            else:
                answer.set_result(result)

    def _as_one_line(self, error: BaseException, body: str) -> BaseException:
        from distributed import KilledWorker

        if isinstance(error, KilledWorker):
            return BadConfig(f"mesh {body}: every worker that rendered it was killed (out of memory?)")
        if isinstance(error, CancelledError):
            return _lost(self._scheduler)
        if isinstance(error, OSError):
            return BadConfig(f"the cluster at {self._scheduler} could not give mesh {body}: {error}")
        return error

    def _watch_scheduler(self) -> None:
        # Dask forgets whoever waits for a result that is on its way when the scheduler goes.
        while not self._over.wait(0.5):
            if self._client.status != "running":
                for answer in self._waiting.copy():
                    self._waiting.discard(answer)
                    with suppress(InvalidStateError):
                        answer.set_exception(_lost(self._scheduler))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._over.set()
        self._watch.join()
        self._inner.shutdown(wait=wait and not cancel_futures)
