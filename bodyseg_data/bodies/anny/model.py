"""The body model Anny, evaluated for one body at a time: surfaces of figures, and people to be posed in NumPy."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.anny.library import BODY_FROM_ANNY, load_anny
from bodyseg_data.bodies.anny.people import Person
from bodyseg_data.bodies.anny.posable import Posable
from bodyseg_data.bodies.anny.skeleton import Pose, bone_rotations
from bodyseg_data.bodies.clothes.outfits import Outfit
from bodyseg_data.core.system.torch_threads import torch_threads

if TYPE_CHECKING:
    import torch

    from bodyseg_data.bodies.clothes.refining import Refinement
    from bodyseg_data.bodies.clothes.wardrobe import Wardrobe

_DECIMALS: Final = 6
_CROWN_M: Final = 0.06  # generous: the highest and lowest vertices of people differ by far less in height


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
        self._heights, self._height_shapes = self._crown_and_soles()
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
        from bodyseg_data.bodies.clothes.refining import Refinement
        from bodyseg_data.bodies.clothes.wardrobe import FINE_M, Wardrobe

        rest = self._posed(who, Pose())
        finer = Refinement(rest, self._faces, FINE_M)
        return finer, Wardrobe(finer(rest), finer.faces, outfit)

    def _crown_and_soles(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return heights [N] of possibly highest or lowest vertices, and each shape's shift of them [shapes, N]."""
        heights = self._anny.template_vertices[:, 2]
        extreme = (heights > heights.max() - _CROWN_M) | (heights < heights.min() + _CROWN_M)
        return heights[extreme], self._anny.blendshapes[:, extreme, 2].clone()

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
