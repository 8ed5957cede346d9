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
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

from bodyseg_data.bodies import BodyRef
from bodyseg_data.core import BadConfig, BodysegError, check_int
from bodyseg_data.machine import required
from bodyseg_data.packing.jobs import Engine
from bodyseg_data.packing.options import PACKING_VERSION, Packing, evenly_sampled, forget_sources
from bodyseg_data.packing.skipping import SKIPPABLE
from bodyseg_data.samples import SHADOW_THRESHOLDS

_SHAPE_BYTES: Final = (
    "bodyseg", "anny", "embreex", "llvmlite", "numba", "numpy", "pillow", "pygeodesic", "pymeshlab", "pyrender",
    "rtree", "scipy", "torch", "trimesh", "zstandard",
)  # fmt: skip
"""The packages that a sample's bytes can depend on."""

_BODIES, _BUILT = "bodies", "the first body as built"
_ADVICE: Final = {
    _BODIES: "share one folder with the workers, or install the same source on both",
    _BUILT: "use workers with the same kind of processor",
}
_SEEN_BODIES: Final = 8

# Threads of a process share the body model, torch's number of threads and OpenGL, so one job runs at a time.
_one_at_a_time = threading.RLock()

CONNECT_TIMEOUT_S: Final = 5.0
"""The time that a scheduler may take to answer, and a first worker to appear."""
_ASK_S: Final = 10.0  # interval at which a wait for a result checks that the scheduler is there; it may take longer


@dataclass(frozen=True)
class Expected:
    """Facts that a worker must share with the process that packs, so that it gives the same bytes.

    token: tells this packing from earlier ones of the same options, whose files may differ. facts: of that process.
    """

    packing: Packing
    token: str
    facts: Mapping[str, str]


def expected(packing: Packing) -> Expected:
    """The facts of this process. Raises BodysegError as opening the source and building a body do."""
    token = uuid.uuid4().hex
    with _one_at_a_time:
        return Expected(packing, token, facts(packing, token))


def installed() -> dict[str, str]:
    """Name -> version of everything in this process that a sample's bytes can depend on."""
    found = {
        "packing version": str(PACKING_VERSION),
        "shadow thresholds": str(SHADOW_THRESHOLDS),
        "processor": platform.machine(),
        "python": ".".join(platform.python_version_tuple()[:2]),
    }
    for name in _SHAPE_BYTES:
        with suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name).partition("+")[0]  # any build of torch will do
    return found


@lru_cache(maxsize=64)
def facts(packing: Packing, token: str) -> dict[str, str]:
    """Versions installed, and digests of the source's bodies as this process reads them and as its processor computes
    the first: of all names and the files of a few, which tells another folder and is quickly read. Raises BodysegError.
    """
    forget_sources()
    bodies = packing.bodies()
    few = evenly_sampled(bodies, min(_SEEN_BODIES, len(bodies)))
    seen = repr((bodies, [_fingerprint(packing, body) for body in few])).encode()
    digests = (hashlib.sha256(each).hexdigest()[:16] for each in (seen, _built(packing, bodies)))
    return installed() | dict(zip((_BODIES, _BUILT), digests, strict=True))


def _fingerprint(packing: Packing, body: BodyRef) -> str:
    with suppress(*SKIPPABLE):  # packing reports it with all other faults
        return packing.opened().fingerprint([body])
    return "at fault"


def _built(packing: Packing, bodies: list[BodyRef]) -> bytes:
    """Bytes of the first body that can be built: its last bits differ with the instructions that libraries choose."""
    for ref in bodies:
        with suppress(*SKIPPABLE):
            body = packing.opened().build(ref)
            return b"".join(each.tobytes() for each in (body.mesh.vertices, body.mesh.faces, body.landmarks))
    return b""


def fault(wanted: Expected) -> str | None:
    """The reason why this worker would not give the same bytes, or None."""
    with _one_at_a_time:
        try:
            here = facts(wanted.packing, wanted.token)
        except BodysegError as error:
            return str(error)
    for name in {**wanted.facts, **here}:
        own, other = here.get(name, "none"), wanted.facts.get(name, "none")
        if own != other:
            advice = _ADVICE.get(name, "install the same versions on both")
            return f"has {name} {own}, this machine has {other}: {advice}"
    return None


async def check(wanted: Expected) -> str | None:
    """`fault` in a thread, so that the worker answers its scheduler meanwhile."""
    return await asyncio.to_thread(fault, wanted)


def job(wanted: Expected, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """Call `function` on a worker; a BodysegError is returned, not raised, so that no log holds a traceback."""
    with _one_at_a_time:
        problem = fault(wanted)  # remembered, unless this worker came late
        if problem is not None:
            return BadConfig(f"worker {socket.gethostname()} {problem}")
        try:
            return function(*arguments)
        except BodysegError as error:
            return error


@contextmanager
def cluster(address: tuple[str, int], workers: int | None, packing: Packing) -> Iterator[Engine]:
    """The cluster of the scheduler at (host, port); see `open_engine`. Leaving it drops what is queued there."""
    distributed = required("distributed", "packing on a Dask cluster", "cluster")
    with _quiet():
        wanted = expected(packing)
        client = _connect(distributed, *address)
        try:
            scheduler = f"{address[0]}:{address[1]}"
            found = _checked_workers(client, wanted, scheduler)
            executor = _Cluster(client, wanted, scheduler)
            yield Engine(executor, found if workers is None else check_int("workers", workers, 1))
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


def _connect(distributed: Any, host: str, port: int) -> Any:
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


def _checked_workers(client: Any, wanted: Expected, scheduler: str) -> int:
    """Number of workers of the cluster. Raises BadConfig if there is none, or if one would give other bytes."""
    try:
        client.wait_for_workers(1, timeout=CONNECT_TIMEOUT_S)
    except Exception as error:
        start = f"start some with: dask worker {scheduler} --nthreads 1"
        raise BadConfig(f"the scheduler at {scheduler} has no workers; {start}") from error
    cannot = "cannot load bodyseg of this version: install the same versions on both"
    try:
        client.run_on_scheduler(installed)  # jobs pass through it
        answers = client.run(check, wanted, on_error="return")
    except Exception as error:
        raise BadConfig(f"the scheduler at {scheduler} was lost, or {cannot} ({error})") from error
    for worker, answer in sorted(answers.items()):
        if answer is not None:
            problem = f"{cannot} ({answer})" if isinstance(answer, Exception) else answer
            raise BadConfig(f"worker {worker} {problem}")
    return len(answers)


class _Cluster(Executor):
    """Dask's client as an executor."""

    def __init__(self, client: Any, wanted: Expected, scheduler: str) -> None:
        self.client, self.scheduler, self._wanted = client, scheduler, wanted

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.check_scheduler()
        body = next((argument.mesh for argument in args if isinstance(argument, BodyRef)), "?")
        return _Answer(self, self.client.submit(job, self._wanted, fn, args, **kwargs, pure=False), body)

    def check_scheduler(self, running: bool = True) -> None:
        """Raise BadConfig if the scheduler is gone. running: False if that is known."""
        if not running or self.client.status != "running":
            again = "the same command carries on, there or with other workers"
            raise BadConfig(f"the scheduler at {self.scheduler} was lost: {again}")


class _Answer(Future[Any]):
    """A result, whose errors are one line. It alone holds Dask's future: the cluster forgets a result with that."""

    def __init__(self, cluster: _Cluster, inner: Any, body: str) -> None:
        super().__init__()
        self._cluster, self._inner, self._body = cluster, inner, body

    def cancel(self) -> bool:
        self._inner.cancel()
        return True

    def result(self, timeout: float | None = None) -> Any:
        from distributed import KilledWorker

        while True:
            try:
                found = self._inner.result(_ASK_S)
                break
            except TimeoutError:
                # If the scheduler goes while a result is on its way, Dask lets its reader wait for ever.
                self._cluster.check_scheduler()
            except CancelledError:
                self._cluster.check_scheduler(running=False)
            except KilledWorker as error:
                killed = "every worker that rendered it was killed (out of memory?)"
                raise BadConfig(f"mesh {self._body}: {killed}") from error
            except OSError as error:
                where = f"the cluster at {self._cluster.scheduler}"
                raise BadConfig(f"{where} could not give mesh {self._body}: {error}") from error
        if isinstance(found, BodysegError):
            raise found
        return found
