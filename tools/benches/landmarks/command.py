"""`tools/landmarks`: draw the 33 parts of a body from four sides, or propose the landmarks of one that has none."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from benches.landmarks.body_views import HEIGHTS_PX, LabelledBody, draw_body_views
from bodyseg_data.bodies import SOURCES, BodyRef, BodySource, Units, UpAxis, metres_a_unit, open_source
from bodyseg_data.commands import check_target, option
from bodyseg_data.core import BadConfig
from bodyseg_data.drawing import check_picture, save_picture
from bodyseg_data.files import write_atomically
from bodyseg_data.labels import LANDMARKS, PARTS
from bodyseg_data.meshes import Mesh, partition, read_mesh

if TYPE_CHECKING:
    from benches.landmarks.proposal import Proposal

EXAMPLE = "tools/landmarks --mesh scan.ply --propose scan.json --out scan.png"

_DOUBTFUL_M: Final = 0.03
_UP: Final = {sign + "xyz"[axis]: (1 if not sign else -1) * np.eye(3)[axis] for sign in ("", "-") for axis in range(3)}


@dataclass(frozen=True)
class Options:
    out: Path = option("write the picture to this PNG file")
    source: str | None = option(f"source of the bodies: {', '.join(SOURCES)}, or one that a package adds", None)
    path: Path | None = option("folder of the source's meshes, for sources that read one", None)
    landmarks: Path | None = option("landmark file, or folder of them (default: beside the meshes)", None)
    mesh: Path | None = option("a mesh file to propose landmarks for, instead of a source", None)
    propose: Path | None = option("lay the open body over the mesh and write its landmarks to this JSON file", None)
    units: Units = option("unit of the mesh files", "auto")
    up: UpAxis = option("their axis that points up; a negative one as --up=-y", "auto")
    pymeshlab: bool = option("repair scans by this package (GPL-3.0)", False)
    meshes: tuple[str, ...] = option("names of the meshes to draw (default: the source's first)", ())
    height: int = option("height of a body in the picture, pixels", 600)


def run(options: Options) -> int:
    """Draw and write the picture, after proposing landmarks if `--propose` is given."""
    check_picture(options.out)
    check_target(options.out, "--out")
    if options.height not in HEIGHTS_PX:
        raise BadConfig(f"--height must be {HEIGHTS_PX.start} to {HEIGHTS_PX.stop - 1} pixels, found {options.height}")
    if (options.mesh is None) == (options.source is None):
        raise BadConfig("give either --source or --mesh")
    if options.mesh is not None and (options.path, options.landmarks, options.meshes) != (None, None, ()):
        raise BadConfig("--path, --landmarks and --meshes belong to --source, not to --mesh")
    if options.mesh is not None and options.propose is None:
        raise BadConfig("--mesh needs --propose; a mesh that has landmarks is drawn by --source folder")
    if options.propose is not None and (options.pymeshlab or options.landmarks is not None):
        raise BadConfig("--propose takes the mesh as it is, without landmarks: leave out --pymeshlab and --landmarks")
    labelled = _listed(options) if options.propose is None else [_proposed(options, options.propose)]
    save_picture(draw_body_views(labelled, options.height), options.out)
    sys.stderr.write(f"wrote {options.out}\n")
    return 0


def _listed(options: Options) -> list[LabelledBody]:
    """List a source's bodies with their own landmarks."""
    source, bodies = _bodies(options)
    labelled = []
    for body in bodies:
        built = source.build(body)
        parts = built.partition()
        labelled.append((f"{body.subject}, {body.pose}", built.mesh, parts, built.landmarks))
    return labelled


def _bodies(options: Options) -> tuple[BodySource, list[BodyRef]]:
    files = options.path, options.landmarks, options.units, options.up, options.pymeshlab
    source = open_source(str(options.source), *files)
    bodies = {body.mesh: body for body in source.bodies()}
    first = next(iter(bodies))
    for name in options.meshes:
        if name not in bodies:
            raise BadConfig(f"the source {source.name} has no mesh {name!r}; the first is {first!r}")
    return source, [bodies[name] for name in options.meshes or (first,)]


def _proposed(options: Options, out: Path) -> LabelledBody:
    """Propose, write and list the landmarks of one mesh."""
    if out.suffix != ".json":
        raise BadConfig(f"--propose must be a .json file, found {out}")
    if out.exists():
        raise BadConfig(f"{out} is there already, perhaps corrected by hand: propose to another file, or delete it")
    check_target(out, "--propose")
    mesh, title, upward = _to_propose(options)
    from benches.landmarks.proposal import propose

    sys.stderr.write(f"laying the open body over {title}: about half a minute of one processor\n")
    proposal = propose(mesh, [_upright(axis).T for axis in upward])
    write_atomically(out, proposal.landmarks.to_json().encode())
    sys.stdout.write(_table(proposal))
    if proposal.poor:
        sys.stderr.write(
            f"a poor fit: parts of the open body are {100 * proposal.gap_m:.0f} cm from the mesh, and a limb may be "
            "in the wrong place: check every landmark\n"
        )
    sys.stderr.write(f"wrote {out}: compare it with the picture before using it\n")
    vertices = proposal.landmarks.for_mesh(mesh)
    facing = _facing_front(mesh, vertices, upward)
    return f"{title}, proposed", facing, partition(facing, vertices), vertices


def _to_propose(options: Options) -> tuple[Mesh, str, list[NDArray[np.float64]]]:
    """Return the mesh in metres and its file's axes, its name, and its possible up axes; no landmarks are read."""
    upward = [_UP[options.up]] if options.up != "auto" else list(_UP.values())
    if options.mesh is not None:
        return _read(options.mesh, options), options.mesh.name, upward
    source, bodies = _bodies(options)
    if len(bodies) != 1:
        raise BadConfig(f"--propose takes one mesh at a time, found {len(bodies)} in --meshes")
    from bodyseg_data.bodies import MeshBodies

    if isinstance(source, MeshBodies):
        return _read(source.entry(bodies[0]).path, options), bodies[0].mesh, upward
    return source.build(bodies[0]).mesh, bodies[0].mesh, [_UP["y"]]


def _read(path: Path, options: Options) -> Mesh:
    vertices, faces = read_mesh(path)
    return Mesh(path.name, vertices * metres_a_unit(vertices[np.unique(faces)], options.units, str(path)), faces)


def _upright(up: NDArray[np.float64], left: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """Return the rotation [3, 3] that takes `up` to y and `left`, made perpendicular, to x; by default any axis."""
    leftward = np.roll(up, 1) if left is None else left - up * (left @ up)
    leftward = leftward / np.linalg.norm(leftward)
    return np.stack([leftward, up, np.cross(leftward, up)])


def _facing_front(mesh: Mesh, vertices: NDArray[np.int64], upward: list[NDArray[np.float64]]) -> Mesh:
    """Rotate the mesh upright, by the axis of `upward` nearest to the trunk, and to the front by its shoulders."""
    points = dict(zip(LANDMARKS, mesh.vertices[vertices], strict=True))
    trunk = points["Cervicale"] - (points["Rt. PSIS"] + points["Lt. PSIS"]) / 2
    up = max(upward, key=lambda axis: float(axis @ trunk))
    rotation = _upright(up, points["Lt. Acromion"] - points["Rt. Acromion"])
    return Mesh(mesh.name, mesh.vertices @ rotation.T, mesh.faces)


def _table(proposal: Proposal) -> str:
    """Format every landmark and its distance from the fitted open body's."""
    lines = ["     landmark                      from the open body, cm"]
    for part, distance in zip(PARTS, proposal.distance_m, strict=True):
        mark = "   look closely" if distance > _DOUBTFUL_M else ""
        lines.append(f"{part.label:4d} {part.landmark:29s} {100 * distance:6.1f}{mark}")
    return "\n".join([*lines, ""])
