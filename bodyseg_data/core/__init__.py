"""Ideas that every room shares: errors, checks, random numbers, progress."""

from typing import TYPE_CHECKING

from bodyseg_data.core.doors import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.core.doors import signals_held
    from bodyseg_data.core.errors import (
        BadConfig,
        BadLandmarks,
        BadMesh,
        BadSample,
        BadShard,
        BodysegError,
        Bounds,
        Checked,
        MissingLibrary,
        bounded,
        check_choice,
        check_class,
        check_fields,
        check_int,
        one_line,
        reported,
    )
    from bodyseg_data.core.progress import NotedProgress, ProgressCallback, Stopwatch, silent
    from bodyseg_data.core.randomness import Draws, check_epoch, check_seed, uniform
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
