"""The choice of tensors that compiled loops compute on."""

from __future__ import annotations

import torch

from bodyseg_data.core.kernels import use_compiled


def in_loops(tensor: torch.Tensor) -> bool:
    """True if compiled loops compute on a tensor instead of PyTorch's operations, with the same bits: on a processor,
    where numba is installed.
    """
    return tensor.device.type == "cpu" and use_compiled()
