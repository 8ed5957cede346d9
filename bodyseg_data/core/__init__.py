"""Ideas that every room shares: errors, checks, files, random numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bodyseg_data.core.doors import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.core.errors import (
        BadConfig,
        BadLandmarks,
        BadMesh,
        BadSample,
        BadShard,
        BadTransform,
        BodysegError,
        Bounds,
        Diverged,
        MissingLibrary,
        Unanswerable,
        Unreachable,
        WorkerLost,
        bounded,
        check_bool,
        check_fields,
        check_int,
        one_line,
        one_of,
        with_text,
    )
    from bodyseg_data.core.files import (
        Table,
        contents,
        flush,
        make_folder,
        parse_json,
        refuse_special,
        sync,
        toml_names,
        toml_text,
        toml_tree,
        write_atomically,
        write_chunks_atomically,
        write_result,
    )
    from bodyseg_data.core.progress import NotedProgress, ProgressCallback, Stopwatch, counter, silent
    from bodyseg_data.core.randomness import (
        Draws,
        Permutation,
        Stream,
        chance,
        check_epoch,
        check_seed,
        generator,
        permutation,
        pixel_draws,
        stream,
        unit,
        units,
    )
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
