"""The body model Anny, evaluated for one body at a time: surfaces of figures, and people to be posed in NumPy.

A person's surface and skeleton are posed by linear skinning in a few milliseconds. Anny keeps its parsed data in a
cache, whose faults are one clear line here.
"""

from __future__ import annotations

import fcntl
import gzip
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.anny_people import Person
from bodyseg_data.bodies.outfits import Outfit
from bodyseg_data.bodies.skeleton import Floats, Pose, bone_rotations
from bodyseg_data.bodies.template import load_template
from bodyseg_data.core import BadConfig, reported
from bodyseg_data.machine import required, torch_threads

if TYPE_CHECKING:
    import torch

    from bodyseg_data.bodies.wardrobe import Refinement, Wardrobe


BODY_FROM_ANNY: Final = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""From Anny's axes (x left, -y front, z up) to the body frame."""

_DECIMALS: Final = 6
_CROWN_M: Final = 0.06  # from the ends, within which the highest and lowest vertex of any person lie, generously


def load_anny() -> Any:
    """Load Anny's model: about a second; some ten the first time on a machine, when its text files are parsed.

    Raises MissingLibrary, or BadConfig for its cache or a user without a home.
    """
    _import_rotations()
    with reported("anny needs a home, also beside ANNY_CACHE_DIR: set HOME", BadConfig, RuntimeError):
        anny = required("anny", "making bodies")
    with torch_threads(1), _cache(), _fast_parsing():
        # The compact basis would halve the time a body takes, but comes from a decomposition whose bits depend on the
        # machine and on its threads. Plain "lbs" skinning needs nothing compiled.
        return anny.Anny(phenotypes="all", phenotype_blendshapes="original", skinning_method="lbs")


def _import_rotations() -> None:
    """Import roma, which Anny imports, without PyTorch's compiler, which takes two seconds: roma wants it only to
    except two functions from compiling. A roma that wants more of it is left to Anny's own import.
    """
    if "torch._dynamo" not in sys.modules:
        torch = vars(import_module("torch"))
        torch["_dynamo"] = SimpleNamespace(disable=lambda function: function)
        with suppress(Exception):
            import_module("roma")
        del torch["_dynamo"]  # the compiler, where one was imported after all, is found again when it is asked for


@contextmanager
def _fast_parsing() -> Iterator[None]:
    """Parse Anny's text files by NumPy while the context lasts: Anny itself makes a tensor of every line.

    The same bits in a ninth of the time (`tests/bodies/test_anny_library.py`). An Anny without the function that is
    replaced here parses in its own way.
    """
    import torch
    from anny.models import full_model

    own = getattr(full_model, "load_blend_shape", None)
    if own is None:
        yield
        return

    def parse(filename: Any, vertices_count: int, world_transformation: Any, dtype: Any) -> Any:
        return world_transformation.apply(torch.as_tensor(parse_target(Path(filename), vertices_count), dtype=dtype))

    full_model.load_blend_shape = parse
    try:
        yield
    finally:
        full_model.load_blend_shape = own


def parse_target(path: Path, vertices: int) -> NDArray[np.float64]:
    """Read the vertices' offsets from a gzipped MakeHuman target file, [vertices, 3], decimetres; 0 if not listed.

    A line is a vertex's index and its offset. Raises ValueError for other content.
    """
    with gzip.open(path, "rb") as file:
        numbers = np.array(file.read().split(), np.float64).reshape(-1, 4)
    indices = numbers[:, 0].astype(np.intp)
    if (indices != numbers[:, 0]).any() or (len(indices) and not 0 <= indices.min() <= indices.max() < vertices):
        raise ValueError(f"{path}: vertices must be whole numbers from 0 to {vertices - 1}")
    offsets = np.zeros((vertices, 3))
    offsets[indices] = numbers[:, 1:]
    return offsets


@contextmanager
def _cache() -> Iterator[None]:
    """Lock Anny's cache, which it writes in place: one process fills it while others wait. Its errors are BadConfig."""
    from anny.paths import get_anny_cache_path
    from safetensors import SafetensorError

    folder = get_anny_cache_path()
    unwritten = reported(f"anny cannot write to {folder}, set ANNY_CACHE_DIR", BadConfig, OSError)
    damaged = reported(f"anny's cache {folder} is damaged, delete it", BadConfig, SafetensorError)
    with unwritten, damaged, ExitStack() as held:
        with suppress(OSError):  # no lock for a cache that cannot be written: it is complete, or Anny will fail
            folder.mkdir(parents=True, exist_ok=True)
            fcntl.flock(held.enter_context((folder / "bodyseg.lock").open("w")), fcntl.LOCK_EX)
        yield


@dataclass(frozen=True)
class Posable:
    """A person's skeleton in its reference pose, and the surface as it was modelled; metres, body frame.

    bones: names, parents before children. parents: int [B], -1 for the root. heads: float64 [B, 3], where bones begin
    in the reference pose; modelled_heads: the same of the modelled surface. reference: float64 [B, 3, 3], the turn of
    each bone from there to the reference pose. modelled: float64 [V, 3]. faces: int32 [F, 3]. skin: int [V, K], the
    bones that move each vertex. weights: float64 [V, K], which sum to 1.
    """

    bones: tuple[str, ...]
    parents: NDArray[np.int64]
    heads: Floats
    modelled_heads: Floats
    reference: Floats
    modelled: Floats
    faces: NDArray[np.int32]
    skin: NDArray[np.int64]
    weights: Floats

    @cached_property
    def numbers(self) -> dict[str, int]:
        """Index of each bone by its name."""
        return {bone: index for index, bone in enumerate(self.bones)}

    @cached_property
    def owner(self) -> NDArray[np.int64]:
        """The bone that moves each vertex most, int [V]."""
        strongest = self.weights.argmax(axis=1)
        return np.asarray(self.skin[np.arange(len(self.skin)), strongest], np.int64)

    def placed(self, rotations: Mapping[str, Floats]) -> tuple[Floats, Floats]:
        """Return every bone's turn [B, 3, 3] in the body frame and its head [B, 3], the root's head at its rest.

        rotations: [3, 3] by bone name, each in its parent's frame; other bones keep the reference pose.
        """
        turns, heads = np.empty((len(self.bones), 3, 3)), np.empty((len(self.bones), 3))
        for index, (bone, parent) in enumerate(zip(self.bones, self.parents, strict=True)):
            own = rotations.get(bone)
            if parent < 0:
                turns[index], heads[index] = np.eye(3) if own is None else own, self.heads[index]
                continue
            turns[index] = turns[parent] if own is None else turns[parent] @ own
            heads[index] = heads[parent] + turns[parent] @ (self.heads[index] - self.heads[parent])
        return turns, heads

    def vertices(self, turns: Floats, heads: Floats) -> Floats:
        """Return the surface [V, 3] for bones as `placed` returns them."""
        whole = turns @ self.reference
        shifts = heads - np.einsum("bij,bj->bi", whole, self.modelled_heads)
        blended = np.einsum("vk,vkij->vij", self.weights, whole[self.skin])
        moved: Floats = np.einsum("vij,vj->vi", blended, self.modelled)
        moved += np.einsum("vk,vki->vi", self.weights, shifts[self.skin])
        return moved


@dataclass(frozen=True)
class Figure:
    """Complete description of one body. height_m: of its lowest point above the floor. outfit: None for no clothes."""

    who: Person
    pose: Pose
    height_m: float = 0.0
    outfit: Outfit | None = None


class AnnyModel:
    """The body model Anny, evaluated for one body at a time."""

    def __init__(self) -> None:
        self._anny = load_anny()
        import torch

        self._torch = torch
        self._faces: NDArray[np.int32] = self._anny.faces.numpy().astype(np.int32)
        # Heights [N] of vertices that may be the highest or lowest, and each shape's shift of them [shapes, N].
        heights = self._anny.template_vertices[:, 2]
        extreme = (heights > heights.max() - _CROWN_M) | (heights < heights.min() + _CROWN_M)
        self._heights, self._height_shapes = heights[extreme], self._anny.blendshapes[:, extreme, 2].clone()
        self._wardrobe = lru_cache(maxsize=4)(self._cut)
        self._bones = {bone: index for index, bone in enumerate(self._anny.bone_labels)}

    def surface(self, figure: Figure, dressed: bool) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Return vertices [V, 3], metres, body frame, and faces [F, 3] of a figure, with its outfit or without."""
        vertices, faces = self._posed(figure.who, figure.pose), self._faces
        if figure.outfit is not None:
            finer, wardrobe = self._wardrobe(figure.who, figure.outfit)
            vertices, faces = finer(vertices), finer.faces
            if dressed:
                vertices = wardrobe.worn(vertices)
        return standing(vertices, figure.height_m), faces

    def places(self, figure: Figure) -> NDArray[np.float64]:
        """Return where on the template the vertices of `surface` lie, [V, 3], metres."""
        places = load_template().vertices
        return places if figure.outfit is None else self._wardrobe(figure.who, figure.outfit)[0](places)

    def posable(self, who: Person) -> Posable:
        """Return a person's surface and skeleton at rest, to be posed without Anny."""
        with torch_threads(1), self._torch.inference_mode():
            shape = who.phenotype() | {"height": self._height(who)}
            unturned = self._torch.eye(4, dtype=self._torch.float64).repeat(1, len(self._bones), 1, 1)
            rest = self._anny(unturned, shape)
        posed, modelled = (rest[name][0].numpy() for name in ("bone_poses", "rest_bone_poses"))
        return Posable(
            tuple(self._anny.bone_labels),
            np.array(self._anny.bone_parents),
            posed[:, :3, 3] @ BODY_FROM_ANNY.T,
            modelled[:, :3, 3] @ BODY_FROM_ANNY.T,
            BODY_FROM_ANNY @ posed[:, :3, :3] @ modelled[:, :3, :3].transpose(0, 2, 1) @ BODY_FROM_ANNY.T,
            rest["rest_vertices"][0].numpy() @ BODY_FROM_ANNY.T,
            self._faces,
            self._anny.vertex_bone_indices.numpy(),
            self._anny.vertex_bone_weights.numpy(),
        )

    def _posed(self, who: Person, pose: Pose) -> NDArray[np.float64]:
        with torch_threads(1), self._torch.inference_mode():
            shape = who.phenotype() | {"height": self._height(who)}
            output = self._anny(self._pose_parameters(pose), shape)
            vertices: NDArray[np.float64] = output["vertices"][0].numpy() @ BODY_FROM_ANNY.T
        return vertices

    def _cut(self, who: Person, outfit: Outfit) -> tuple[Refinement, Wardrobe]:
        """Refine the triangles for an outfit's folds and cut it, both for one person; takes about a second."""
        from bodyseg_data.bodies.wardrobe import FINE_M, Refinement, Wardrobe

        rest = self._posed(who, Pose())
        finer = Refinement(rest, self._faces, FINE_M)
        return finer, Wardrobe(finer(rest), finer.faces, outfit)

    def _height(self, who: Person) -> float:
        """Return the height parameter that gives a person's stature, which is linear in it."""
        ends = self._torch.tensor([0.0, 1.0], dtype=self._torch.float64)
        shapes = self._anny.get_phenotype_blendshape_coefficients(**who.phenotype(), height=ends)
        rest = (self._heights + shapes @ self._height_shapes).numpy()
        short, tall = (rest.max(axis=1) - rest.min(axis=1)).tolist()
        return float(np.clip((who.stature_m - short) / (tall - short), 0, 1))

    def _pose_parameters(self, pose: Pose) -> torch.Tensor:
        """Return Anny's pose [1, bones, 4, 4]: rotations in axes aligned with the world, each in its parent's frame."""
        turns = np.tile(np.eye(4), (1, len(self._bones), 1, 1))
        for bone, rotation in bone_rotations(pose).items():
            turns[0, self._bones[bone], :3, :3] = BODY_FROM_ANNY.T @ rotation @ BODY_FROM_ANNY
        return self._torch.from_numpy(turns)


def standing(vertices: NDArray[np.float64], height_m: float = 0.0) -> NDArray[np.float64]:
    """Return vertices [V, 3] over the origin, the lowest one `height_m` above the floor, rounded to the micrometre."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    offset = np.array([(low[0] + high[0]) / 2, low[1] - height_m, (low[2] + high[2]) / 2])
    # To the micrometre, which hides nearly all differences between processors in the last bits.
    rounded: NDArray[np.float64] = np.round(vertices - offset, _DECIMALS) + 0.0  # which makes -0 into 0
    return rounded
