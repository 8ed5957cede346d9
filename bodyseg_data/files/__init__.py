"""Files: atomic writes, reads of untrusted files, JSON, and TOML tables read key by key."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.files.access import (
        Table,
        TomlFiles,
        cache_folder,
        claimed,
        contents,
        entries_of,
        held_part,
        last_name,
        make_folder,
        naming,
        natural_key,
        parse_json,
        part_beside,
        parts_left,
        read_bytes,
        read_json,
        refuse_special,
        sync,
        web_page,
        without_doubles,
        write_atomically,
        write_json,
        write_result,
    )
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
