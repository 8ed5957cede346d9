"""All bodies of the paper: PATH with the sub-folders scape, mit and caesar, each as its own source reads it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from bodyseg_data.bodies.mesh_options import DEFAULTS, MeshOptions
from bodyseg_data.bodies.source import Body, BodyRef, BodySource, ListedBodies
from bodyseg_data.bodies.sources.caesar import MESHES as CAESAR_MESHES
from bodyseg_data.bodies.sources.caesar import CaesarBodies
from bodyseg_data.bodies.sources.mit import MESHES as MIT_MESHES
from bodyseg_data.bodies.sources.mit import MitBodies
from bodyseg_data.bodies.sources.scape import MESHES as SCAPE_MESHES
from bodyseg_data.bodies.sources.scape import ScapeBodies
from bodyseg_data.core.errors import BadConfig

_Opened = Callable[[Path, Path | None, MeshOptions], BodySource]

_PARTS: Final[dict[str, tuple[_Opened, tuple[str, ...]]]] = {
    "scape": (ScapeBodies, SCAPE_MESHES),
    "mit": (MitBodies, MIT_MESHES),
    "caesar": (CaesarBodies, CAESAR_MESHES),
}


class PaperBodies(ListedBodies[BodySource]):
    """Subsets A, B, C and people, in this order: 2329 bodies if all are there.

    landmarks: a folder with sub-folders scape, mit and caesar, in which to look for landmark files instead of in
    `path`. Raises BadConfig if none of the sub-folders is there, or one holds nothing of its source.
    """

    name = "paper"

    def __init__(self, path: Path, landmarks: Path | None = None, options: MeshOptions = DEFAULTS) -> None:
        if landmarks is not None and not landmarks.is_dir():
            raise BadConfig(f"the landmarks of the source 'paper' are a folder like its own, found {landmarks}")
        if landmarks is not None and not any(_sub_folder(landmarks, name) for name in _PARTS):
            raise BadConfig(
                f"--landmarks must hold one of the sub-folders {', '.join(_PARTS)}: found none in {landmarks}"
            )
        sources: dict[BodyRef, BodySource] = {}
        all_missing: list[str] = []
        for name, (opened, complete) in _PARTS.items():
            folder = _sub_folder(path, name)
            missing: Sequence[str] = complete
            if folder is not None:
                source = opened(folder, _sub_folder(landmarks, name) if landmarks else None, options)
                missing = source.missing()
                for body in source.bodies():
                    sources[body] = source
            all_missing += [f"{name}/{each}" for each in missing]
        if not sources:
            raise BadConfig(f"the source 'paper' needs the sub-folders {', '.join(_PARTS)}: found none in {path}")
        if len({body.mesh for body in sources}) < len(sources):
            raise BadConfig(f"meshes must have different names, found a subject of {path}/caesar called like another")
        super().__init__(sources, all_missing)

    def fingerprint(self, bodies: Sequence[BodyRef]) -> str:
        """Return a digest of the three sources' fingerprints. Raises the errors that they raise."""
        digest = hashlib.sha256()
        for source in dict.fromkeys(map(self.entry, bodies)):
            digest.update(source.fingerprint([body for body in bodies if self.entry(body) is source]).encode())
        return digest.hexdigest()

    def check(self, body: BodyRef) -> None:
        """Check one body's files by its own source. Raises that source's errors."""
        self.entry(body).check(body)

    def build(self, body: BodyRef) -> Body:
        """Build one body by its own source. Raises that source's errors, and BadConfig for a body of none of them."""
        return self.entry(body).build(body)


def _sub_folder(path: Path, name: str) -> Path | None:
    """Return the sub-folder of this name in upper or lower case, or None."""
    found = sorted(folder for folder in path.iterdir() if folder.name.lower() == name and folder.is_dir())
    if len(found) > 1:
        raise BadConfig(f"{path} must hold one folder {name}, found {found[0].name} and {found[1].name}")
    return found[0] if found else None
