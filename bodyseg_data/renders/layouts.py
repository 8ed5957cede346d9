"""Layouts of folders of renders: their registry, and which of them a folder has."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final, Literal, get_args

from bodyseg_data.core import BadConfig
from bodyseg_data.renders.blenderproc import ENDINGS, BlenderProcRenders
from bodyseg_data.renders.isaac import AXIS, RAY, IsaacRenders, frames
from bodyseg_data.renders.plain import PlainRenders
from bodyseg_data.renders.set_file import SetFile, read_set
from bodyseg_data.renders.source import RANGE, RenderSource

LayoutName = Literal["plain", "blenderproc", "isaac"]
LAYOUTS: Final[dict[LayoutName, Callable[[Path, SetFile], RenderSource]]] = {
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
    chosen = layout or content.layout or _told(folder, content)
    if chosen not in get_args(LayoutName):
        raise BadConfig(f"{folder}: the layout must be one of {', '.join(LAYOUTS)}, found {chosen!r}")
    return LAYOUTS[chosen](folder, content)


def _told(folder: Path, content: SetFile) -> LayoutName:
    """The layout of a folder by its files. Raises BadConfig unless it is exactly one."""
    camera = folder / content.camera
    signs: dict[LayoutName, bool] = {
        "plain": (folder / RANGE).is_dir(),
        "blenderproc": camera.is_dir() and any(each.suffix in ENDINGS for each in camera.iterdir()),
        "isaac": bool(frames(camera, AXIS, ".npy") or frames(camera, RAY, ".npy")),
    }
    found = [name for name, there in signs.items() if there]
    if len(found) != 1:
        signs_of = f"a folder {RANGE}/ (plain), *{ENDINGS[0]} (blenderproc) or {AXIS}_*.npy (isaac)"
        raise BadConfig(
            f"{folder}: its layout cannot be told, found signs of {' and '.join(found) or 'none'}: {signs_of}; "
            "--layout, or 'layout' in set.toml, says which it is"
        )
    return found[0]
