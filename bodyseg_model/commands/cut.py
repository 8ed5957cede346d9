"""`bodyseg cut`: people of whole frames, as `bodyseg segment` shows them to its network, as a set to train on."""

import hashlib
import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bodyseg_data import loading
from bodyseg_data.artifacts import PAPER_SENSOR, VariantName
from bodyseg_data.commands import WHERE_HELP, Progress, option
from bodyseg_data.core import BadConfig
from bodyseg_data.packing import ShardWriter
from bodyseg_data.rigs import load_rig
from bodyseg_data.samples import Split, metres
from bodyseg_data.shards import RIG_FIELD
from bodyseg_model import networks, runtimes, segmentation, training

EXAMPLE = "bodyseg cut --data rooms --sensor kinect_v1 --out people"


@dataclass(frozen=True)
class Options:
    data: str = option("set of whole frames, as `shard --source rooms` packs them: folder or address", address=True)
    out: Path = option("folder for the set of people; an interrupted run carries on there")
    variant: VariantName = option("artifacts that the frames have", "all")
    sensor: str = option("sensor model with the artifacts: the name of one that ships, or a TOML file", PAPER_SENSOR)
    seed: int = option("seed of the artifacts", 0)
    split: Split = option("split of the frames", "train")
    where: tuple[str, ...] = option(WHERE_HELP, ())
    rig: str = option("rig of the network to train, whose camera's images are written: a name or a .toml file", "paper")
    larger: tuple[int, ...] = option(
        "rows and columns of images of those people alone who are larger than the rig's images, as whoever lies", ()
    )
    finder: Path | None = option("network that finds people, a training's folder (default: the one that ships)", None)
    threads: int | None = option(runtimes.THREADS_HELP, None)


def run(options: Options) -> int:
    """Write what a network would see of everybody who is found, with true labels."""
    training.use_threads(options.threads)
    sensor, where = options.sensor, options.where
    wanted = options.data, options.variant, options.split, options.seed
    frames = loading.RangeImages(*wanted, sensor=sensor, where=where, unlabelled=True)
    trained = networks.load_network(options.finder or networks.FINDER)
    finder, rig = None if options.finder is None else trained.network, load_rig(options.rig)
    images, size = rig, None
    if options.larger:
        if len(options.larger) != 2:
            raise BadConfig(f"--larger needs two numbers, rows and columns, found {len(options.larger)}")
        rows, columns = size = options.larger[0], options.larger[1]  # the optical axis in their middle
        images = replace(rig, camera=replace(rig.camera, rows=rows, columns=columns, centre_px=(columns / 2, rows / 2)))
    # Of all that the people depend on, so that no set is carried on with other frames, artifacts or another finder.
    of = json.dumps([frames.identity(), trained.card[networks.CardWords.WEIGHTS_SHA256]], sort_keys=True)
    source = f"cut from {frames.manifest.source}, with digest {hashlib.sha256(of.encode()).hexdigest()[:12]}"
    # The frames' shadows are in what is cut: a projector that sees nothing casts no others.
    lit = np.zeros((sum(each.rows for each in rig.projectors), rig.projector.columns), np.float32)
    found, camera = 0, frames.manifest.rig.camera
    empty = np.zeros((camera.rows, camera.columns), np.float32)
    segmentation.find_bodies(empty, camera, segmentation.Background(), finder)  # what is no finder is refused now
    with (
        ShardWriter(options.out, rig=images, classes=frames.manifest.classes, source=source) as out,
        Progress("cutting", "frames") as progress,
    ):
        for number in range(len(frames)):
            frame, facts = frames.image(number), frames.describe(number)
            camera = frames.manifest.rigs[facts.get(RIG_FIELD, 0)].camera
            range_m = metres(frame.range, frames.step_m)
            people = segmentation.cut_people(range_m, frame.labels, camera, rig, finder, size)
            for person, (seen_m, labels) in enumerate(people):
                out.write(
                    key=f"{frame.key}-{person}",
                    range_m=seen_m,
                    labels=labels,
                    projector_range_m=lit,
                    split=facts["split"],
                    fields={"frame": frame.key},
                )
                found += 1
            progress.update(number + 1, len(frames))
    sys.stdout.write(f"{options.out}: {found} images of people in {len(frames)} frames\n")
    return 0
