"""Triangle meshes of bodies: reading, repair, landmarks, and their partition into 33 parts."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.meshes.body_checks import check_body
    from bodyseg_data.meshes.coincident import separate
    from bodyseg_data.meshes.geodesics import GeodesicMethod, nearest_sources
    from bodyseg_data.meshes.landmarks import METRES, LandmarkSet, PointLandmarks, load_landmark_file, load_landmarks
    from bodyseg_data.meshes.mending import welded
    from bodyseg_data.meshes.mesh import HEIGHT_RANGE_M, Mesh, SceneMesh, face_normals, find_edges, vertex_normals
    from bodyseg_data.meshes.mesh_files import MeshContent, mesh_stem, preferred, read_mesh
    from bodyseg_data.meshes.partitioning import Borders, Partition, partition
    from bodyseg_data.meshes.repairing import repair, with_pymeshlab
    from bodyseg_data.meshes.scene_files import gltf_buffers, mesh_content, scene_stem
    from bodyseg_data.meshes.solids import Solid, SurfacePiece, cuboid, together, turned_solid
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
