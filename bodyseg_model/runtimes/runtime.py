"""Runtimes that compute ONNX graphs on the processor, ONNX Runtime and OpenVINO, and the network that asks them."""

import contextlib
import io
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cache
from importlib import import_module
from typing import Any, ClassVar, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig
from bodyseg_data.machine import missing_library
from bodyseg_model.networks import Network, check_range_images
from bodyseg_model.runtimes.onnx_files import RANGE, SCORES, OnnxModel, scores_part

Precision = Literal["float32", "bfloat16"]

_FATAL_ONLY: Final = 4  # of ONNX Runtime's log
_MOST_BYTES: Final = 1 << 32  # of ONNX Runtime in all: small graphs may ask for any number


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
        try:
            return import_module(cls.library)
        except ImportError as error:
            raise missing_library(f"the backend {cls.library}", error, extra=cls.extra) from error


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
        library.create_and_register_allocator(info, library.OrtArenaCfg({"max_mem": _MOST_BYTES}))


class OpenVino(Runtime):
    """OpenVINO."""

    library, extra = "openvino", "openvino"
    precisions: ClassVar[tuple[Precision, ...]] = ("float32", "bfloat16")

    def __init__(self, graph: bytes, precision: Precision, threads: int) -> None:
        core = self.loaded().Core()
        settings = {
            "INFERENCE_NUM_THREADS": threads,
            "INFERENCE_PRECISION_HINT": "bf16" if precision == "bfloat16" else "f32",
            "PERFORMANCE_HINT": "LATENCY",
            "ENABLE_CPU_PINNING": False,  # other work of the process runs beside it
        }
        self._request = core.compile_model(core.read_model(io.BytesIO(graph)), "CPU", settings).create_infer_request()

    def scores(self, range_m: NDArray[np.float32]) -> NDArray[np.float32]:
        found: NDArray[np.float32] = self._request.infer([range_m], share_inputs=True)[0]
        return found


class RuntimeNetwork(Network):
    """A network whose scores a runtime computes; all else that takes a `Network` takes it, but it cannot be trained.

    identity: name and version of the runtime, and precision, as plain JSON. Threads are as many as torch may use when
    scores are asked for; a session is kept for each number. Raises BadConfig for a precision that the runtime does not
    have, MissingLibrary if the runtime is not installed.
    """

    together = False  # a runtime prepares for every shape of its input that it has not met

    def __init__(self, model: OnnxModel, name: str, runtime: type[Runtime], precision: Precision) -> None:
        settings = model.card.get("settings")
        focal_px = settings.get("focal_px") if isinstance(settings, dict) else None  # what a finder of people needs
        super().__init__({"focal_px": focal_px} if focal_px else {}, model.facts.classes)
        check_precision(name, runtime.precisions, precision)
        self.output_stride = model.facts.output_stride
        self.model = model
        self._runtime, self._graph = runtime, scores_part(model.graph).SerializeToString()
        self._sessions: dict[int, Runtime] = {}
        self.identity: dict[str, Any] = {
            "backend": name,
            "version": str(runtime.loaded().__version__),
            "precision": precision,
        }
        self._precision: Precision = precision
        self.eval()

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        """Compute scores; see `Network.scores`. Raises BadConfig for a graph that cannot, or gives others."""
        check_range_images(range_m)
        threads = torch.get_num_threads()
        try:
            if threads not in self._sessions:
                self._sessions[threads] = self._runtime(self._graph, self._precision, threads)
            found = self._sessions[threads].scores(range_m.detach().cpu().float().contiguous().numpy())
        except Exception as error:  # of the runtime's own kinds
            text = " ".join(str(error).split())
            why = f"it asks for more than {_MOST_BYTES} bytes" if "vailable memory" in text else text[:300]
            raise BadConfig(f"{self.identity['backend']} cannot compute the network: {why}") from error
        wanted = [len(range_m), *(-(-side // self.output_stride) for side in range_m.shape[2:]), self.classes]
        if list(found.shape) != wanted:
            raise BadConfig(f"by its stride and classes, scores must be {wanted}, found {list(found.shape)}")
        return torch.from_numpy(found).permute(0, 3, 1, 2)


def check_precision(backend: str, precisions: Sequence[Precision], precision: Precision) -> None:
    """Raise BadConfig unless a backend has a precision."""
    if precision not in precisions:
        raise BadConfig(f"{backend} computes in {' or '.join(precisions)}, found {precision}")
