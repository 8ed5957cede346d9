"""The libraries that compute ONNX graphs on the processor, by name."""

import contextlib
import io
from abc import ABC, abstractmethod
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from threading import Lock
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.machine import required

Precision = Literal["float32", "bfloat16"]

RANGE: Final = "range_m"
SCORES: Final = "scores"
"""Names of values of a graph: range images [B, 1, H, W], metres; scores [B, H / stride, W / stride, C], rounded up."""

_FATAL_ONLY: Final = 4  # level of ONNX Runtime's log
MOST_BYTES: Final = 1 << 32  # for ONNX Runtime in all: a small graph may ask for any number


class Runtime(ABC):
    """A library that computes ONNX graphs on the processor.

    library: name of the module, and extra: of the package that installs it. precisions: those that it computes in.
    """

    library: ClassVar[str]
    extra: ClassVar[str]
    precisions: ClassVar[tuple[Precision, ...]]

    @abstractmethod
    def __init__(self, graph: bytes, precision: Precision, threads: int) -> None:
        """Compile a graph from `RANGE` to `SCORES` for so many threads. Raises MissingLibrary."""

    @abstractmethod
    def scores(self, range_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute scores [B, h, w, C] of range images [B, 1, H, W], C contiguous."""

    @classmethod
    def loaded(cls) -> Any:
        """The library's module. Raises MissingLibrary if it is not installed."""
        return required(cls.library, f"the backend {cls.library}", cls.extra)


class OnnxRuntime(Runtime):
    """ONNX Runtime; its processor kernels know no bfloat16."""

    library, extra = "onnxruntime", "onnx"
    precisions: ClassVar[tuple[Precision, ...]] = ("float32",)

    def __init__(self, graph: bytes, precision: Precision, threads: int) -> None:
        library = self.loaded()
        options = library.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        options.log_severity_level = _FATAL_ONLY  # errors are raised, and their lines are the message
        options.add_session_config_entry("session.use_env_allocators", "1")
        _limit_memory()
        self._session = library.InferenceSession(graph, options, providers=["CPUExecutionProvider"])

    def scores(self, range_m: NDArray[np.float32]) -> NDArray[np.float32]:
        found: NDArray[np.float32] = self._session.run([SCORES], {RANGE: range_m})[0]
        return found


@cache
def _limit_memory() -> None:
    """Bound what ONNX Runtime allocates in this process, unless its user already has."""
    library = OnnxRuntime.loaded()
    arena = library.OrtAllocatorType.ORT_ARENA_ALLOCATOR
    info = library.OrtMemoryInfo("Cpu", arena, 0, library.OrtMemType.DEFAULT)
    with contextlib.suppress(library.capi.onnxruntime_pybind11_state.Fail):
        library.create_and_register_allocator(info, library.OrtArenaCfg({"max_mem": MOST_BYTES}))


class OpenVino(Runtime):
    library, extra = "openvino", "openvino"
    precisions: ClassVar[tuple[Precision, ...]] = ("float32", "bfloat16")

    def __init__(self, graph: bytes, precision: Precision, threads: int) -> None:
        settings = {
            "INFERENCE_NUM_THREADS": threads,
            "INFERENCE_PRECISION_HINT": "bf16" if precision == "bfloat16" else "f32",
            "PERFORMANCE_HINT": "LATENCY",
            "ENABLE_CPU_PINNING": False,  # other work of the process runs beside it
        }

        def compiled() -> Any:
            core = self.loaded().Core()
            return core.compile_model(core.read_model(io.BytesIO(graph)), "CPU", settings).create_infer_request()

        # In a thread that ends: OpenVINO 2026.4 gives the thread that compiles a stack for signals, and takes its
        # memory away with the core. Another core's stack, or a core that goes in another thread, leaves the address
        # behind: the next signal ends the process, or is written into what has come to lie there, as the heap.
        with ThreadPoolExecutor(1) as thread:
            self._request = thread.submit(compiled).result()
        self._one_at_a_time = Lock()  # else a thread gets the scores of another one's images

    def scores(self, range_m: NDArray[np.float32]) -> NDArray[np.float32]:
        with self._one_at_a_time:
            found: NDArray[np.float32] = self._request.infer([range_m], share_inputs=True)[0]
        return found


RUNTIMES: Final[dict[str, type[Runtime]]] = {"onnxruntime": OnnxRuntime, "openvino": OpenVino}
"""Name -> class, which imports its library when it is used."""

TORCH: Final = "torch"
OF_FILES: Final = "onnxruntime"
"""The backend of an ONNX file for which none is named."""

if TYPE_CHECKING:
    BackendName = str
else:
    BackendName = Literal[(TORCH, *RUNTIMES)]

RUN_HELP: Final = "network: 'large', a training's folder, a .safetensors or .onnx file (default: compact)"
BACKEND_HELP: Final = (
    "library that computes the network (default: torch, or onnxruntime for an .onnx file); on a processor, openvino "
    "takes 0.8 to 1.0 times as long as torch in the same precision"
)
FLIP_HELP: Final = (
    "average with labels of the mirror image: 0.7 points more on real people, in 1.5 to 2 times the network's time"
)
PRECISION_HELP: Final = "number type in which the network computes (default: float32)"
QUICK_PRECISION_HELP: Final = (
    "number type in which the network computes (default: bfloat16 on a processor with instructions for it, else "
    "float32; for an .onnx file, float32)"
)
DEVICE_HELP: Final = "device that computes: cpu, cuda, cuda:1 ... (default: a GPU if there is one)"
THREADS_HELP: Final = "threads that compute on the processor (default: all)"
"""Help of options of commands on networks, where those commands find it without PyTorch."""
