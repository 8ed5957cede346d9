"""`bodyseg landmarks`: draw the 33 parts of a source's body from four sides, to look at before packing."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from bodyseg_data.bodies import SourceName, open_source
from bodyseg_data.errors import BadConfig
from bodyseg_data.options import option
from bodyseg_data.partition import partition
from bodyseg_data.pictures import check_picture, save_picture
from bodyseg_data.portrait import draw_portraits

EXAMPLE = "bodyseg landmarks --source open --out landmarks.png"


@dataclass(frozen=True)
class Options:
    """What the command takes."""

    source: SourceName = option("where bodies come from")
    out: Path = option("write the picture to this PNG file")
    path: Path | None = option("folder of the source's meshes, for sources that read one", None)
    meshes: tuple[str, ...] = option("names of the meshes to draw (default: the source's first)", ())
    height: int = option("height of a body in the picture, pixels", 600)


def run(options: Options) -> int:
    """Draw and write the picture."""
    check_picture(options.out)
    source = open_source(options.source, options.path)
    bodies = {body.mesh: body for body in source.bodies()}
    names = options.meshes or (next(iter(bodies)),)
    portraits = []
    for name in names:
        if name not in bodies:
            raise BadConfig(f"the source {source.name} has no mesh {name!r}; the first is {next(iter(bodies))!r}")
        built = source.build(bodies[name])
        parts = partition(built.mesh, built.landmarks)
        portraits.append((f"{bodies[name].subject}, {bodies[name].pose}", built.mesh, parts, built.landmarks))
    save_picture(draw_portraits(portraits, [options.height] * len(portraits)), options.out)
    sys.stderr.write(f"wrote {options.out}\n")
    return 0
