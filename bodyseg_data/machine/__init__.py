"""The machine under this program: compiled loops, libraries, threads, memory, hardware."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.machine.host import computes_bfloat16, hardware, keep_freed_memory, peak_mb, processors
    from bodyseg_data.machine.kernels import compiled, if_ready, loops, use_compiled
    from bodyseg_data.machine.libraries import (
        SOFTWARE_DRIVER,
        compress,
        missing_library,
        opened_picture,
        require_libraries,
        required,
    )
    from bodyseg_data.machine.threads import MOST_THREADS, of_each, pieces, torch_threads, wait_briefly
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
