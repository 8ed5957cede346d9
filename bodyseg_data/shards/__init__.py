"""Shards (plain tars of samples), their manifest, codecs, stores and cache."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.shards.ahead import LookAhead, Place
    from bodyseg_data.shards.cache import with_cache, with_kept_index
    from bodyseg_data.shards.codecs import CODECS, CodecName
    from bodyseg_data.shards.codecs.png import SIGNATURE, check_checksums, decode_chunks, read_chunks, read_header
    from bodyseg_data.shards.columns import (
        ColumnWriter,
        column_file,
        column_files,
        column_names,
        column_tar,
        open_columns,
        with_columns,
        write_column_manifest,
    )
    from bodyseg_data.shards.faults import find_column_faults, find_faults, find_index_faults
    from bodyseg_data.shards.manifest import (
        EXTERNAL,
        FACING_FROM_RANGE,
        LARGEST_MANIFEST,
        MANIFEST_FORMAT,
        MANIFEST_NAME,
        RIG_FIELD,
        Manifest,
        ProjectorKind,
        check_plane,
        check_rigs,
        read_manifest,
        write_manifest,
    )
    from bodyseg_data.shards.records import (
        BODY_FIELDS,
        CheckedFile,
        Fields,
        Row,
        ShardRecord,
        record_from_json,
        record_to_json,
        shard_name,
    )
    from bodyseg_data.shards.remote import RemoteFolder, RetryPolicy, Unreachable, open_store, read_optional
    from bodyseg_data.shards.sample_codec import decode_sample, encode_sample, facing_masks, stored_info
    from bodyseg_data.shards.store import READ_ATTEMPTS, TALLY, LocalFolder, Stage, Store, open_file
    from bodyseg_data.shards.tar import ShardReader, TarWriter
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
