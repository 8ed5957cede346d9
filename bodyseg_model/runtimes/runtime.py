"""Base class of runtimes: sessions that compute a network's scores, and the network that asks them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_model.networks.input.relief import check_range_images
from bodyseg_model.networks.network import Network
from bodyseg_model.runtimes.onnx_files import OnnxModel, Precision


class Runtime(ABC):
    """A library that computes ONNX graphs on the processor.

    precisions: those that it computes in.
    """

    precisions: ClassVar[tuple[Precision, ...]]

    @abstractmethod
    def __init__(self, graph: bytes, precision: Precision, threads: int) -> None:
        """Compile a graph from `graphs.RANGE` to `graphs.SCORES` for so many threads. Raises MissingLibrary."""

    @abstractmethod
    def scores(self, range_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute scores [B, h, w, C] of range images [B, 1, H, W], C contiguous."""

    @classmethod
    @abstractmethod
    def version(cls) -> str:
        """Version of the library. Raises MissingLibrary if it is not installed."""


class RuntimeNetwork(Network):
    """A network whose scores a runtime computes; all else that takes a `Network` takes it, but it cannot be trained.

    identity: name and version of the runtime, precision, and calibration of int8, as plain JSON. Threads are as many as
    torch may use when scores are asked for; a session is kept for each number. Raises BadConfig for
    a precision that the runtime or the graph does not have, MissingLibrary if the runtime is not installed.
    """

    together = False  # a runtime prepares for every shape of its input that it has not met

    def __init__(self, model: OnnxModel, name: str, runtime: type[Runtime], precision: Precision) -> None:
        super().__init__({}, model.facts.classes)
        check_precision(name, runtime, model.facts.precision, precision)
        self.output_stride = model.facts.output_stride
        self.model = model
        self._runtime, self._graph = runtime, model.scores_bytes()
        self._sessions: dict[int, Runtime] = {}
        self.identity: dict[str, Any] = {"backend": name, "version": runtime.version(), "precision": precision}
        if model.facts.calibration:
            self.identity["calibration"] = model.facts.calibration
        self._precision: Precision = precision
        self.eval()

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        """Compute scores; see `Network.scores`."""
        check_range_images(range_m)
        threads = torch.get_num_threads()
        if threads not in self._sessions:
            self._sessions[threads] = self._runtime(self._graph, self._precision, threads)
        found = self._sessions[threads].scores(range_m.detach().cpu().float().contiguous().numpy())
        return torch.from_numpy(found).permute(0, 3, 1, 2)


def check_precision(name: str, runtime: type[Runtime], graph: Precision, precision: Precision) -> None:
    """Raise BadConfig unless a runtime computes a graph of the precision `graph` in `precision`."""
    if precision not in runtime.precisions:
        raise BadConfig(f"{name} computes in {' or '.join(runtime.precisions)}, found {precision}")
    if (precision == "int8") != (graph == "int8"):
        raise BadConfig(
            f"a network of {graph} cannot compute in {precision}: int8 needs a file that "
            "`bodyseg export --onnx FILE --precision int8 --calibrate SET` wrote, and such a file int8"
        )
