"""Engines of a packing: processes of this machine, or a running Dask cluster. The bytes are the same."""

import re
from contextlib import AbstractContextManager
from typing import Final

from bodyseg_data.core import BadConfig
from bodyseg_data.packing.jobs import Engine, processes
from bodyseg_data.packing.options import Packing

PROCESSES: Final = "processes"
_DASK: Final = re.compile(r"dask://(\[[0-9A-Fa-f:.]+\]|[^\s:/@\[\]]+):(\d{1,5})")


def open_engine(name: str, workers: int | None, packing: Packing) -> AbstractContextManager[Engine]:
    """An engine for `packing`, open as long as the context; leaving it with an error drops the jobs under way.

    name: "processes", or "dask://HOST:PORT" of a running scheduler. workers: how many processes to start (default:
    one a processor), or how many of the cluster's workers to keep busy (default: those there now).

    Raises BadConfig for another name, for no worker, for a scheduler that does not answer, and for workers that would
    not give the same bytes; MissingLibrary without `distributed`.
    """
    if (address := check_engine(name)) is None:
        return processes(workers)
    from bodyseg_data.packing.cluster import cluster

    return cluster(address, workers, packing)


def check_engine(name: str) -> tuple[str, int] | None:
    """Host and port of the scheduler that an engine's name holds; None for processes. Raises BadConfig."""
    if name == PROCESSES:
        return None
    match = _DASK.fullmatch(name)
    if match is None or not 0 < int(match[2]) < 1 << 16:
        raise BadConfig(f"the engine must be {PROCESSES} or dask://HOST:PORT, found {name!r}")
    return match[1], int(match[2])
