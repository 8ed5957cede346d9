"""Repair of raw scans with pymeshlab, in the one thread in which it is imported and works, whoever asks.

A scan may consist of unconnected triangles, have duplicate, degenerate or inverted faces, and edges that three faces
share. A renderer draws these, but geodesics, normals and the checks of `Mesh` fail or go wrong.

Two faults of pymeshlab 2025.7 damage the heap. Loaded in a thread that ends before the process does, it leaves Qt data
of a dead thread behind, which the end of the process follows. Its decimation releases the interpreter's lock and is not
reentrant, so two threads at once write into each other's mesh. One daemon thread that takes all of the work in turn,
and never ends, has neither.

Its licence is GPL-3.0, so it is imported only where a user chose it, by `--pymeshlab`, `--tolerance-mm` or rooms.
"""

import contextlib
import ctypes
import importlib.util
import os
import sys
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadMesh
from bodyseg_data.machine import missing_library, require_libraries
from bodyseg_data.meshes.mesh import Floats, check_arrays, face_components, signed_volumes

_Result = TypeVar("_Result")

_SHARED_LIBRARIES: Final = (("torch", "lib/libgomp.so.1"), ("openvino", "libs/libtbb.so.12"))
"""Libraries that pymeshlab brings, too, by the same name: the linker takes whichever was loaded first for everybody."""

SAME_POINT_M: Final = 1e-6
"""Distance in metres below which vertices are joined: far below a scanner's resolution, above rounding in files."""

_FEATURE: Final = "mesh repair"


def repair(name: str, vertices: Floats, faces: NDArray[Any]) -> tuple[Floats, NDArray[np.int32]]:
    """Repair a surface for `Mesh` and geodesics: returns vertices float64 [V, 3], metres, and faces int32 [F, 3].

    name: of the mesh, for messages. vertices: float [V, 3], metres. faces: int [F, 3].
    Steps, in this order: join coincident vertices; remove degenerate and duplicate faces; at edges of more than two
    faces remove the smallest; separate pieces that meet in a single vertex; orient neighbouring faces alike and each
    connected piece outwards; remove vertices that no face uses. Holes are not filled.

    Vertex indices change: landmarks by vertex are invalid afterwards, landmarks by coordinates stay valid.
    Raises BadMesh for a surface that cannot be repaired (no face left, coordinates that are not finite, faces with
    missing vertices, a one-sided surface), MissingLibrary without pymeshlab or the system libraries it loads.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    check_arrays(f"mesh {name}", vertices, faces, check_unused=False)  # pymeshlab checks nothing
    used, renumbered = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], renumbered.reshape(faces.shape).astype(np.int32)
    vertices, faces = with_pymeshlab(_FEATURE, lambda pymeshlab: _filtered(pymeshlab, name, vertices, faces))
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    clashes = len(edges) - len(np.unique(edges, axis=0))  # neighbours of one orientation cross an edge in opposite ways
    if clashes:
        raise BadMesh(f"mesh {name} cannot be repaired: it has one side only, found {clashes} edges where faces clash")
    return vertices, _outward(vertices, faces)


def with_pymeshlab(feature: str, work: Callable[[Any], _Result]) -> _Result:
    """Call `work` with the module pymeshlab, in the thread for it; return what it returns, raise what it raises.

    feature: named in the message about what is missing. work: makes all meshes of pymeshlab that it needs, and returns
    arrays: no mesh may leave the thread. It must not call this function. A process's first call takes a third of a
    second more. A forked process has a thread of its own. Raises MissingLibrary without pymeshlab, libGL or libOpenGL.
    """
    return _worker.call(lambda: work(_import_pymeshlab(feature)))


class _Worker:
    """A daemon thread that starts with the first job and takes one after the other."""

    def __init__(self) -> None:
        self._start = threading.Lock()
        self._jobs: SimpleQueue[tuple[Future[Any], Callable[[], Any]]] | None = None

    def call(self, job: Callable[[], _Result]) -> _Result:
        with self._start:
            if self._jobs is None:
                self._jobs = SimpleQueue()
                # Not of a pool of threads: those end, with pymeshlab's data, before the process does.
                threading.Thread(target=_work_forever, args=(self._jobs,), name="pymeshlab", daemon=True).start()
        answer: Future[_Result] = Future()
        self._jobs.put((answer, job))
        return answer.result()


def _work_forever(jobs: SimpleQueue[tuple[Future[Any], Callable[[], Any]]]) -> None:
    while True:
        answer, job = jobs.get()
        try:
            result = job()
        except BaseException as error:  # handed to the caller, whatever it is: this thread stays
            _release_frames(error)
            answer.set_exception(error)
        else:
            answer.set_result(result)
            del result
        del answer, job


def _release_frames(error: BaseException) -> None:
    """Release what the frames of an exception and of its causes hold: meshes, which must end in this thread."""
    link: BaseException | None = error
    while link is not None:
        traceback.clear_frames(link.__traceback__)
        link = link.__cause__ or link.__context__


def _import_pymeshlab(feature: str) -> Any:
    # Without libOpenGL pymeshlab prints a page of warnings and comes up without half of its filters.
    require_libraries(feature, ("GL", "OpenGL"))
    try:
        if "pymeshlab" not in sys.modules:
            _load_shared_libraries()
        import pymeshlab
    except (ImportError, OSError, AttributeError) as error:
        raise missing_library(feature, error, extra="pymeshlab") from error
    return pymeshlab


def _load_shared_libraries() -> None:
    """Load those of other packages first, so that PyTorch, OpenVINO and ssl keep their own if they come later."""
    with contextlib.suppress(ImportError):
        import ssl  # noqa: F401  # with libcrypto
    for package, name in _SHARED_LIBRARIES:
        with contextlib.suppress(OSError, ValueError):  # absent, another build, or not a package that was installed
            found = importlib.util.find_spec(package)
            for folder in (found.submodule_search_locations or ()) if found else ():
                ctypes.CDLL(str(Path(folder) / name))


_worker: Final = _Worker()
os.register_at_fork(after_in_child=_worker.__init__)  # type: ignore[misc]  # a child has none of its parent's threads


def _filtered(
    pymeshlab: Any, name: str, vertices: Floats, faces: NDArray[np.int32]
) -> tuple[Floats, NDArray[np.int32]]:
    """All steps of `repair` but the last orientation, in pymeshlab's thread."""
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces))
    try:
        meshes.meshing_merge_close_vertices(threshold=pymeshlab.PureValue(SAME_POINT_M))
        meshes.meshing_remove_null_faces()
        meshes.meshing_remove_duplicate_faces()
        if meshes.current_mesh().face_number() == 0:
            raise BadMesh(f"mesh {name} cannot be repaired: no face has an area")
        meshes.meshing_repair_non_manifold_edges(method="Remove Faces")
        meshes.meshing_repair_non_manifold_vertices(vertdispratio=0.0)
        meshes.meshing_re_orient_faces_coherently()
        meshes.meshing_remove_unreferenced_vertices()
    except pymeshlab.PyMeshLabException as error:
        raise BadMesh(f"mesh {name} cannot be repaired: {' '.join(str(error).split())}") from error
    whole = meshes.current_mesh()
    return np.array(whole.vertex_matrix(), np.float64), np.array(whole.face_matrix(), np.int32)


def _outward(vertices: Floats, faces: NDArray[np.int32]) -> NDArray[np.int32]:
    """The faces [F, 3], inverted in every connected piece that encloses a negative volume."""
    piece_of_vertex = face_components(len(vertices), faces)
    count = int(piece_of_vertex.max()) + 1
    piece = piece_of_vertex[faces[:, 0]]
    # Measured about the mean vertex of the piece, so that the sign is right also for one with small holes.
    size = np.bincount(piece_of_vertex, minlength=count)
    middle = np.stack([np.bincount(piece_of_vertex, axis, count) for axis in vertices.T], axis=1) / size[:, None]
    corners = vertices[faces] - middle[piece][:, None]
    inside_out = np.bincount(piece, signed_volumes(corners), count)[piece] < 0
    turned = faces.copy()
    turned[inside_out] = turned[inside_out][:, ::-1]
    return turned
