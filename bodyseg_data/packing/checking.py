"""The check of all files of a source before the first view is rendered."""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from concurrent.futures import Executor
from functools import partial

from bodyseg_data.bodies.source import BodyRef
from bodyseg_data.core.system.progress import ProgressCallback
from bodyseg_data.packing.engines.ordered import ordered
from bodyseg_data.packing.options import Packing
from bodyseg_data.packing.skipping import SKIPPABLE


def check_run(packing: Packing, body: BodyRef, plan: str) -> str | None:
    """The reason why a body cannot be packed, in whichever process, as far as its source's check tells; else None."""
    try:
        packing.opened(plan).check(body)
    except SKIPPABLE as error:
        return str(error)
    return None


def find_faults(
    packing: Packing, bodies: Sequence[BodyRef], executor: Executor, workers: int, progress: ProgressCallback
) -> dict[str, str]:
    """Name of a mesh -> the reason why it cannot be packed, of all bodies whose files are at fault.

    Sources that make their bodies and read no files are not checked.
    """
    if packing.path is None:
        return {}
    token = uuid.uuid4().hex  # files may have changed since a worker read them
    jobs = (partial(executor.submit, check_run, packing, body, token) for body in bodies)
    found: dict[str, str] = {}
    for done, (body, reason) in enumerate(zip(bodies, ordered(jobs, workers), strict=True), 1):
        if reason is not None:
            found[body.mesh] = reason
        progress(done, len(bodies))
    return found
