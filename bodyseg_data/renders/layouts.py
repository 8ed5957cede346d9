"""Layouts of folders of renders: the plain one, the registry of all, and which of them a folder has.

Plain is a folder a kind of image, in it one file a sample, named by its key:

    set.toml  [samples.jsonl | samples.csv]  range/  labels/  [projector/  facing/  normals/  planes/NAME/]
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final, Literal

import numpy as np

from bodyseg_data.core import BadConfig, check_choice
from bodyseg_data.files import entries_of, natural_key
from bodyseg_data.renders.blenderproc import ENDINGS, BlenderProcRenders
from bodyseg_data.renders.images import SUFFIXES, read_array
from bodyseg_data.renders.isaac import AXIS, RAY, IsaacRenders, frames
from bodyseg_data.renders.set_file import SetFile, read_rows, read_set
from bodyseg_data.renders.source import FACING, LABELS, NORMALS, PROJECTOR, RANGE, RenderSource, Stored, by_key

_PLANES = "planes"


class PlainRenders(RenderSource):
    """Renders in folders of images. Raises BadConfig for a folder, key or partner that is missing or unknown."""

    def __init__(self, folder: Path, content: SetFile) -> None:
        optional = [kind for kind in (PROJECTOR, FACING, NORMALS) if (folder / kind).is_dir()]
        home = folder / _PLANES
        planes = [each.name for each in home.iterdir() if each.is_dir()] if home.is_dir() else []
        planes.sort(key=natural_key)
        folders = {kind: folder / kind for kind in (RANGE, LABELS, *optional)} | {name: home / name for name in planes}
        super().__init__(content, read_rows(folder, content), {kind: _images(each) for kind, each in folders.items()})
        first = {name: read_array(self._files[name][self._keys[0]]) for name in planes}
        self.planes = {name: "uint8" if image.dtype == np.uint8 else "uint16" for name, image in first.items()}

    def read(self, key: str) -> Mapping[str, Stored]:
        ray, coloured = self._content.along == "ray", {LABELS} if self._content.table.colours else ()
        found = {kind: files[key] for kind, files in self._files.items()}
        images = {kind: read_array(path, kind in coloured, kind == LABELS) for kind, path in found.items()}
        return {kind: Stored(image, str(found[kind]), ray) for kind, image in images.items()}


def _images(folder: Path) -> dict[str, Path]:
    """The images of a folder by key. Raises BadConfig for a file of another kind, or none."""
    if not folder.is_dir():
        raise BadConfig(f"{folder}: a set of renders needs this folder, with one image a sample")
    paths = entries_of(folder)
    for path in paths:
        if path.suffix.lower() not in SUFFIXES or path.is_dir():
            raise BadConfig(f"{path}: an image must end in {', '.join(SUFFIXES)}, which keep numbers as they are")
    if not paths:
        raise BadConfig(f"{folder}: a set of renders has images here, found none")
    return by_key((path.stem, path) for path in paths)


LayoutName = Literal["plain", "blenderproc", "isaac"]
LAYOUTS: Final[dict[str, Callable[[Path, SetFile], RenderSource]]] = {
    "plain": PlainRenders,
    "blenderproc": BlenderProcRenders,
    "isaac": IsaacRenders,
}


def open_renders(folder: Path, layout: str | None = None) -> RenderSource:
    """Open a folder of renders. layout: its kind; None: as set.toml says, else by what lies in the folder.

    Raises BadConfig, naming file or folder, for one that cannot be told, is not complete, or has wrong descriptions.
    """
    if not folder.is_dir():
        raise BadConfig(f"no folder {folder} there")
    content = read_set(folder)
    chosen = check_choice(f"{folder}: the layout", layout or content.layout or _told(folder, content), LAYOUTS)
    return LAYOUTS[chosen](folder, content)


def _told(folder: Path, content: SetFile) -> str:
    """The layout of a folder by its files. Raises BadConfig unless it is exactly one."""
    camera = folder / content.camera
    signs = {
        "plain": (folder / RANGE).is_dir(),
        "blenderproc": camera.is_dir() and any(each.suffix in ENDINGS for each in camera.iterdir()),
        "isaac": bool(frames(camera, AXIS, ".npy") or frames(camera, RAY, ".npy")),
    }
    found = [name for name, there in signs.items() if there]
    if len(found) != 1:
        signs_of = f"a folder {RANGE}/ (plain), *{ENDINGS[0]} (blenderproc) or {AXIS}_*.npy (isaac)"
        raise BadConfig(
            f"{folder}: its layout cannot be told, found signs of {' and '.join(found) or 'none'}: {signs_of}; "
            "set.toml says which it is by 'layout', as does --layout, and by 'camera' and 'projector' in which folders"
        )
    return found[0]
