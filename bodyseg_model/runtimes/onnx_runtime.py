"""ONNX Runtime on the processor."""

from __future__ import annotations

from importlib import import_module
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.system.libraries import missing_library
from bodyseg_model.runtimes.graphs import RANGE, SCORES
from bodyseg_model.runtimes.onnx_files import Precision
from bodyseg_model.runtimes.runtime import Runtime

_ERRORS_ONLY = 3


class OnnxRuntime(Runtime):
    """ONNX Runtime; its processor kernels know no bfloat16."""

    precisions: ClassVar[tuple[Precision, ...]] = ("float32", "int8")

    def __init__(self, graph: bytes, precision: Precision, threads: int) -> None:
        library = _import()
        options = library.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        options.log_severity_level = _ERRORS_ONLY
        self._session = library.InferenceSession(graph, options, providers=["CPUExecutionProvider"])

    def scores(self, range_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """See `Runtime.scores`."""
        found: NDArray[np.float32] = self._session.run([SCORES], {RANGE: range_m})[0]
        return found

    @classmethod
    def version(cls) -> str:
        """See `Runtime.version`."""
        return str(_import().__version__)


def _import() -> Any:
    try:
        return import_module("onnxruntime")
    except ImportError as error:
        raise missing_library("the backend onnxruntime", error, extra="onnx") from error
