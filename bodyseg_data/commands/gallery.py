"""`bodyseg gallery`: many views of one or several sets in one picture."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from bodyseg_data.artifacts import Scene
from bodyseg_data.commands.options import WHERE_HELP, option
from bodyseg_data.commands.records import check_target
from bodyseg_data.core import BadConfig
from bodyseg_data.drawing import check_picture, choose_views, draw_gallery, save_picture
from bodyseg_data.loading import RangeImages

EXAMPLE = "bodyseg gallery shards hard-shards --views 48 --out gallery.png"

_VIEWS: Final = 48

MOST_VIEWS: Final = 1200
"""A picture of a hundred lines of views takes gigabytes while it is drawn."""


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    folders: tuple[str, ...] = option(
        "folders or addresses of sets of shards, all of one rig", positional=True, address=True
    )
    out: Path = option("write the picture to this PNG file")
    views: int | None = option("number of views, evenly over the sets' subjects and meshes (default: 48, or all)", None)
    where: tuple[str, ...] = option(WHERE_HELP, ())


def run(options: Options) -> int:
    """Draw and write the picture."""
    check_picture(options.out)
    check_target(options.out, "--out")
    if options.views is not None and not 1 <= options.views <= MOST_VIEWS:
        raise BadConfig(f"--views must be 1 to {MOST_VIEWS}, found {options.views}")
    sets = [RangeImages(folder, "none", where=options.where) for folder in options.folders]
    camera = sets[0].manifest.rig.camera
    for images in sets:
        differing = images.label_map.difference(sets[0].label_map)
        if differing is not None:
            raise BadConfig(f"a gallery shows sets of the same classes, found {differing}")
        if images.manifest.rig.camera != camera:
            raise BadConfig(f"a gallery shows sets of one rig, found another in {images.path} than in {sets[0].path}")
    views = [(images, index) for images in sets for index in range(len(images))]
    count = min(_VIEWS, len(views)) if options.views is None else options.views
    chosen = choose_views([key for images in sets for key in images.keys], count)
    picked = [(images, images.clean(index)) for images, index in (views[number] for number in chosen)]
    scenes = [Scene(sample, images.manifest.rig_of(sample)) for images, sample in picked]
    title = f"{len(scenes)} of {len(views)} views, rig {sets[0].manifest.rig.name}"
    save_picture(draw_gallery(scenes, title, sets[0].label_map), options.out)
    sys.stderr.write(f"wrote {options.out}\n")
    return 0
