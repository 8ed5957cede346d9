"""Made rooms: furniture, walls and people drawn by keys, seen as a rig sees them, as shards."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.rooms.room_packing import OwnThings, chosen_kinds, pack_rooms, people_of
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
