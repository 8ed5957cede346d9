"""OpenVINO on the processor."""

from __future__ import annotations

import io
from importlib import import_module
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.system.libraries import missing_library
from bodyseg_model.runtimes.onnx_files import Precision
from bodyseg_model.runtimes.runtime import Runtime


class OpenVino(Runtime):
    """OpenVINO; int8 comes as a quantised graph, whose other layers compute in float32."""

    precisions: ClassVar[tuple[Precision, ...]] = ("float32", "bfloat16", "int8")

    def __init__(self, graph: bytes, precision: Precision, threads: int) -> None:
        core = _import().Core()
        settings = {
            "INFERENCE_NUM_THREADS": threads,
            "INFERENCE_PRECISION_HINT": "bf16" if precision == "bfloat16" else "f32",
            "PERFORMANCE_HINT": "LATENCY",
            "ENABLE_CPU_PINNING": False,  # other work of the process runs beside it
        }
        self._request = core.compile_model(core.read_model(io.BytesIO(graph)), "CPU", settings).create_infer_request()

    def scores(self, range_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """See `Runtime.scores`."""
        found: NDArray[np.float32] = self._request.infer([range_m], share_inputs=True)[0]
        return found

    @classmethod
    def version(cls) -> str:
        """See `Runtime.version`."""
        return str(_import().__version__)


def _import() -> Any:
    try:
        return import_module("openvino")
    except ImportError as error:
        raise missing_library("the backend openvino", error, extra="openvino") from error
