"""Packing: bodies are rendered into shards, and scenes that were rendered elsewhere are written."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.packing.engines import PROCESSES, check_engine, open_engine
    from bodyseg_data.packing.jobs import processes
    from bodyseg_data.packing.joining import join
    from bodyseg_data.packing.mesh_reduction import reduced_body
    from bodyseg_data.packing.options import Packing, in_poses
    from bodyseg_data.packing.packer import pack, plan
    from bodyseg_data.packing.render_packing import pack_renders
    from bodyseg_data.packing.sampler import Sampler
    from bodyseg_data.packing.shard_writer import ShardWriter
    from bodyseg_data.packing.skipping import STOP, FaultyMeshes, OnError, OnFaults
    from bodyseg_data.packing.things import FURNITURE, Numbers, ThingsPlace, draw_things, in_front
    from bodyseg_data.packing.writing import STATE_NAME
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
