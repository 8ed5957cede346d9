"""Networks in other runtimes: ONNX files with the answer in the graph, ONNX Runtime and OpenVINO."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_model.runtimes.backends import (
        backend_of,
        load_network,
        on_backend,
        put_on_backend,
        quick_precision,
        to_device,
    )
    from bodyseg_model.runtimes.libraries import (
        BACKEND_HELP,
        DEVICE_HELP,
        FLIP_HELP,
        PRECISION_HELP,
        QUICK_PRECISION_HELP,
        RUN_HELP,
        THREADS_HELP,
        BackendName,
        Precision,
    )
    from bodyseg_model.runtimes.onnx_files import OPSET, SUFFIX, write_onnx
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
