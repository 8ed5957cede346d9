"""From bodies to shards, over any `concurrent.futures.Executor`; restartable; the same bytes however it is run.

Work goes out mesh by mesh and comes back as encoded samples; one process writes all shards in their fixed order. So
the bytes depend neither on the number of workers nor on a restart, and workers need no shared disk. While a packing
runs, `OUT/.packing/` holds its plan, a lock, the shard being written and a record of every finished one. The manifest
is written last; then the folder goes. Meshes that are left out (`skipping`) are left out of the cut into shards, so the
samples are those of a source without them.
"""

import shutil
from collections.abc import Sequence
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bodyseg_data.bodies import BodyRef, collapsed, load_template
from bodyseg_data.core import BadConfig, BodysegError, ProgressCallback, silent
from bodyseg_data.labels import PART_CLASSES, TEMPLATE
from bodyseg_data.packing.mesh_reduction import reduced_body
from bodyseg_data.packing.options import PACKING_VERSION, Packing, classes_from, forget_sources
from bodyseg_data.packing.sampler import Sampler
from bodyseg_data.packing.skipping import STOP, OnFaults, SkipList, find_faults
from bodyseg_data.packing.writing import (
    Rendered,
    check_folder,
    claimed,
    cut,
    cut_again,
    digest_of,
    files_of,
    forget_shard,
    record_skips,
    stored_skips,
    write_shards,
    writing_into,
)
from bodyseg_data.rendering import open_renderer
from bodyseg_data.samples import SHADOW_THRESHOLDS, SPLITS, View
from bodyseg_data.shards import (
    MANIFEST_FORMAT,
    MANIFEST_NAME,
    Fields,
    Manifest,
    column_tar,
    encode_sample,
    read_manifest,
    write_column_manifest,
    write_manifest,
)


def plan(packing: Packing) -> dict[str, Any]:
    """Count the bodies and samples of a packing by subset and split, as plain JSON; no mesh is read or rendered.

    "missing" is there if the source lacks bodies that a complete one has: their names, with runs of names in one.
    """
    bodies = packing.bodies()
    subsets: dict[str, dict[str, int]] = {}
    for body in bodies:
        subset = subsets.setdefault(body.subset, {"meshes": 0, "views": 0, **dict.fromkeys(SPLITS, 0)})
        subset["meshes"] += 1
        subset["views"] += len(packing.views)
        subset[body.split] += len(packing.views)
    totals = {name: sum(subset[name] for subset in subsets.values()) for name in ("meshes", "views", *SPLITS)}
    counts = {"source": packing.source, **totals, "views_per_mesh": len(packing.views), "subsets": subsets}
    missing = collapsed(packing.opened().missing())
    return {**counts, "missing": missing} if missing else counts


def _describe(packing: Packing, bodies: Sequence[BodyRef], faulty: Sequence[str]) -> dict[str, Any]:
    """Everything that shapes the bytes, as plain JSON; a restart compares it. faulty: meshes that the check found."""
    return {
        "format": MANIFEST_FORMAT,
        "version": PACKING_VERSION,
        "source": packing.source,
        "meshes": [asdict(body) for body in bodies],
        "fingerprint": packing.opened().fingerprint(bodies),
        "units": packing.units,
        "up": packing.up,
        "geodesics": packing.geodesics,
        "tolerance_mm": packing.tolerance_mm,
        "pymeshlab": packing.pymeshlab,
        "views": packing.views.described(),
        "rig": packing.rig.to_json(),
        "shadow_thresholds": asdict(SHADOW_THRESHOLDS),
        "renderer": packing.renderer,
        "codec": packing.codec,
        **({} if (classes := classes_from(packing.opened())) is PART_CLASSES else {"classes": classes.to_json()}),
        "shards": [shard.name for shard in cut(packing, bodies)],
        "shard_samples": packing.shard_samples,
        **({"skipped": list(faulty)} if faulty else {}),
        **({} if packing.things == "none" else {"things": packing.things}),
    }


def _unchanged(packing: Packing, bodies: Sequence[BodyRef], out: Path) -> dict[str, Any] | None:
    """The description of a packing if `out` holds its whole set, made of the files as they are now; else None.

    The files were then found without fault when the set was packed, and need no second check. A set that lacks some
    meshes is checked again.
    """
    if packing.path is None or not (out / MANIFEST_NAME).exists():
        return None
    try:
        manifest = read_manifest(out)
        description = None if manifest.skipped else _describe(packing, bodies, ())
    except BodysegError:
        return None  # what follows says what is wrong
    return description if description is not None and manifest.plan == digest_of(description) else None


def render_run(packing: Packing, body: BodyRef, views: tuple[View, ...], plan: str = "") -> Rendered:
    """One unit of work, in whichever process: one body, rendered, labelled and encoded from some views.

    plan: digest of what is packed, files included: a process that outlives a packing reads changed files again.
    """
    source = packing.opened(plan)
    seen_from = packing.rig, min(packing.views.distances_cm), packing.views.pitches_deg
    with BadConfig.named(f"the source {packing.source!r}, body {body.mesh!r}"):
        built = source.build(body)
    built = reduced_body(built, packing.tolerance_mm, *seen_from, packing.pymeshlab)
    parts = built.surface_labels(packing.geodesics)
    with closing(open_renderer(packing.renderer, built.mesh)) as renderer:
        places = built.template() if packing.template and built.template is not None else None
        options = packing.things, len(classes_from(source)), places
        sampler = Sampler(renderer, packing.rig, built.mesh, parts, source.name, body, *options)
        samples = (sampler.take(view) for view in views)
        notes = (*built.notes, *(() if (note := getattr(parts, "note", None)) is None else (note,)))
        lowest, highest = built.mesh.vertices.min(axis=0), built.mesh.vertices.max(axis=0)
        cameras = (packing.rig.placed(built.mesh.centre, view)[0].position for view in views)
        if any(((lowest < at) & (at < highest)).all() for at in cameras):
            notes += ("the camera stands within its bounding box: are --units and --distances right?",)
        return Rendered([(sample.key, encode_sample(sample, packing.codec)) for sample in samples], notes)


def pack(
    packing: Packing,
    out: Path | str,
    executor: Executor,
    workers: int,
    progress: ProgressCallback = silent,
    on_faults: OnFaults = STOP,
) -> Manifest:
    """Pack into the folder `out` and return its manifest; carries on where an interrupted packing stopped.

    executor: runs `check_run` and `render_run`. workers: how many of its workers to keep busy.
    on_faults: treatment of meshes that cannot be packed.
    Raises BadConfig if `out` holds something else or another packing is at work there; FaultyMeshes for meshes that
    cannot be packed, all that the check before rendering finds, or for more of them than may be left out; BadMesh,
    BadLandmarks or BadSample for one that fails later. After an error finished shards stay, and the same call carries
    on from them; the caller cancels the jobs that the executor has not begun. In a finished set, shards that are
    missing or altered are made again; its meshes are not checked again while their files are unchanged.
    """
    forget_sources()
    out = Path(out)
    check_folder(out)
    bodies = packing.bodies()
    skips = SkipList(on_faults, len(bodies), packing.path)
    try:
        description = _unchanged(packing, bodies, out)
        if description is None:
            skips.add(find_faults(packing, bodies, executor, workers, on_faults.progress))
        faulty = list(skips.reasons)
        if description is None:
            description = _describe(packing, [body for body in bodies if body.mesh not in faulty], faulty)
        digest = digest_of(description)

        def render(body: BodyRef, views: tuple[View, ...]) -> Future[Rendered]:
            return executor.submit(render_run, packing, body, views, digest)

        with writing_into(out), claimed(out, description, digest) as state:
            skips.add(stored_skips(out, state, faulty))
            while True:
                record_skips(state, {mesh: why for mesh, why in skips.reasons.items() if mesh not in faulty})
                shards = cut(packing, [body for body in bodies if body.mesh not in skips.reasons])
                found, records = write_shards(packing, shards, (out, state), render, workers, progress)
                if found is None:
                    break
                body, error = found
                if skips.strict:
                    raise error
                skips.add({body.mesh: str(error)})
                for shard in cut_again(shards, body):
                    forget_shard(out, state, files_of(packing, shard.name))
            manifest = Manifest(
                rigs=(packing.rig,),
                codec=packing.codec,
                classes=classes_from(packing.opened()),
                source=packing.source,
                renderer=packing.renderer,
                plan=digest,
                shards=tuple(records[shard.name] for shard in shards),
                skipped=skips.reasons,
            )
            manifest = read_manifest(out) if (out / MANIFEST_NAME).exists() else write_manifest(manifest, out)
            if packing.template:
                tars = [records[column_tar(shard.name, TEMPLATE)] for shard in shards]
                planes, name = {TEMPLATE: "uint16"}, load_template().name
                write_column_manifest(out, manifest, TEMPLATE, tars, planes, Fields(()), name)
            shutil.rmtree(state)
    except BrokenExecutor as error:
        killed = f"a worker process was killed (out of memory?) while packing {out}"
        raise BadConfig(f"{killed}: the same command carries on") from error
    return manifest
