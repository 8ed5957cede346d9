"""Costs of each effect of `bench ablation`, with and without it, measured side by side in one process.

Times are of the processor, all threads together, so that other work on the machine does not count; each is measured
once a round, in an order that rotates.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np
import torch

from benches.measuring import evenly_spaced
from benches.model.ablation.conditions import stepped, steps_of
from benches.model.ablation.rows import BASE, ROW_OF_BASE, ROWS, AblationRow, Tree
from benches.model.networks.network_times import Cell, summary, time_cell
from bodyseg_data.bodies import BodyRef
from bodyseg_data.bodies.sources.open_bodies import MadeBodies, OpenBodies
from bodyseg_data.core import MissingLibrary
from bodyseg_data.loading import RangeImages
from bodyseg_data.machine.kernels import VARIABLE
from bodyseg_data.packing import Sampler
from bodyseg_data.packing.options import evenly_sampled
from bodyseg_data.rendering import open_renderer
from bodyseg_data.rigs import Rig
from bodyseg_data.samples import ViewGrid, metres
from bodyseg_data.shards.codecs.bodyseg_images import encode_images
from bodyseg_model.networks import build

ROUNDS: Final = 7
SAMPLES: Final = 60
FRAMES: Final = 12
BODIES: Final = 4
_VIEWS_A_BODY: Final = 18
_NETWORK_S: Final = 15.0


def processor_ms(jobs: Mapping[str, Callable[[], Any]], each: int, rounds: int) -> Tree:
    """Milliseconds of processor of a job, divided by `each`, its number of items: median over rounds."""
    names = list(jobs)
    found: dict[str, list[float]] = {name: [] for name in names}
    for number in range(rounds + 1):
        for turn in range(len(names)):
            name = names[(number + turn) % len(names)]
            start = time.process_time()
            jobs[name]()
            if number:  # the first round fills caches
                found[name].append(1e3 * (time.process_time() - start) / each)
    return {name: {"ms": round(statistics.median(values), 4)} for name, values in found.items()}


def loader_costs(data: str) -> Tree:
    """Time of a sample in the loader, from shard to image: the base, no artifact, and each row that differs in them."""
    known = [ROW_OF_BASE, replace(ROW_OF_BASE, name="none", variant="none")]
    known += [row for row in ROWS if row.group in ("artifacts", "sub-kinds")]
    return loading_ms({each.name: RangeImages(data, each.variant, "train", sensor=each.sensor) for each in known})


def loading_ms(images: Mapping[str, RangeImages]) -> Tree:
    """Time of a sample in the loader, from shard to image, of one set opened in several ways."""
    os.environ.setdefault(VARIABLE, "compiled")  # no round times NumPy's forms while another process compiles
    one = next(iter(images.values()))
    camera = one.manifest.rig.camera
    indices = evenly_spaced(range(len(one)), SAMPLES)
    image, labels = (np.empty((camera.rows, camera.columns), kind) for kind in (np.uint16, np.uint8))

    def read(chosen: RangeImages) -> None:
        for index in indices:
            chosen.write(index, 0, image, labels)

    return processor_ms({name: partial(read, chosen) for name, chosen in images.items()}, len(indices), ROUNDS)


def byte_costs(data: str) -> Tree:
    """Mean bytes of a sample's images: as stored, without the projector's, and with coarser steps of range."""
    images = RangeImages(data, BASE, "train")
    sizes: dict[str, list[int]] = {}
    for index in evenly_spaced(range(len(images)), SAMPLES):
        sample = images.clean(index)
        facing, occluder = sample.faces_projector.view(np.uint8), sample.occluder_range()
        made = {BASE: encode_images(sample.range, sample.labels, facing, occluder)}
        made["no_occlusion"] = encode_images(sample.range, sample.labels, np.zeros_like(facing), None)
        for row in ROWS:
            if row.step_mm is not None:
                coarse = stepped(sample.range, steps_of(row.step_mm, images.step_m))
                made[row.name] = encode_images(coarse, sample.labels, facing, occluder)
        for name, encoded in made.items():
            sizes.setdefault(name, []).append(len(encoded))
    return {name: round(float(np.mean(values))) for name, values in sizes.items()}


def network_costs(data: str, settings: Mapping[str, Any]) -> Tree:
    """Milliseconds from a test image to labels and confidences, all threads. settings: of the base's network."""
    networks = {BASE: build("compact", settings, seed=0).eval()}
    for row in ROWS:
        if row.settings:
            networks[row.name] = build("compact", {**settings, **row.settings}, seed=0).eval()
    images = RangeImages(data, BASE, "test")
    frames = [metres(images.image(index).range, images.step_m) for index in evenly_spaced(range(len(images)), FRAMES)]
    cell = Cell("typical", "labels", "cpu", torch.get_num_threads(), "float32")
    batches = [torch.from_numpy(frame)[None, None] for frame in frames]
    return summary(time_cell(cell, networks, batches, 2 * FRAMES, _NETWORK_S), BASE)


def rendering_costs(rig: Rig) -> Tree | None:
    """Time of a sample of a dressed body, from its parameters to images and labels, and of the same bodies undressed.

    None without Anny.
    """
    dressed = OpenBodies()
    bodies = evenly_sampled([body for body in dressed.bodies() if body.subset in ("B", "C")], BODIES)
    bare = MadeBodies("open", {body: partial(replace, dressed.figure(body), outfit=None) for body in bodies})
    sources = {"dressed": dressed, "bare": bare}
    jobs = {name: partial(_render, source, bodies, rig) for name, source in sources.items()}
    try:
        return processor_ms(jobs, BODIES * _VIEWS_A_BODY, rounds=1)
    except MissingLibrary:
        return None


def _render(source: MadeBodies, bodies: Sequence[BodyRef], rig: Rig) -> None:
    for body in bodies:
        built = source.build(body)
        renderer = open_renderer("raster", built.mesh)
        sampler = Sampler(renderer, rig, built.mesh, built.partition(), source.name, body)
        for view in ViewGrid(count=_VIEWS_A_BODY):
            sampler.take(view)
        renderer.close()


def costs_of(row: AblationRow, costs: Tree, samples: int, base_samples: int, bytes_a_sample: float) -> list[Tree]:
    """Costs of a row's effect, one entry a kind: what, with, without. samples: trained on, in the row and its base."""
    found = []

    def add(what: str, have: float, lack: float) -> None:
        found.append({"what": what, "with": lack if row.added else have, "without": have if row.added else lack})

    if row.group in ("artifacts", "sub-kinds"):
        add("ms a sample in the loader", *(costs["loader"][name]["ms"] for name in (BASE, row.name)))
    if row.name in costs["bytes"]:
        add("bytes a sample", *(costs["bytes"][name] for name in (BASE, row.name)))
    if samples < base_samples:
        add("training samples", base_samples, samples)
        add("MB of them", *(round(count * bytes_a_sample / 1e6, 1) for count in (base_samples, samples)))
    if row.name == "no_clothes" and costs["rendering"] is not None:
        add("ms to render a sample", *(costs["rendering"][name]["ms"] for name in ("dressed", "bare")))
    if row.settings:
        add("ms from image to labels", *(costs["network"][name]["ms"] for name in (BASE, row.name)))
    return found
