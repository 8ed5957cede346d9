"""Sources of bodies to render, behind one Protocol."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.bodies.alignment import Units, UpAxis, metres_a_unit
    from bodyseg_data.bodies.anny_model import load_anny
    from bodyseg_data.bodies.mesh_bodies import MeshBodies
    from bodyseg_data.bodies.motions.catalogue import FRAMES_PER_SECOND
    from bodyseg_data.bodies.skeleton import RigidMotion, about, from_rotation_vector
    from bodyseg_data.bodies.source import Body, BodyRef, BodySource, collapsed, shortened
    from bodyseg_data.bodies.sources import SOURCES, check_source, open_source
    from bodyseg_data.bodies.template import load_template, region_labels
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
