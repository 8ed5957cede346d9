"""Single samples as tensors, and their way through PyTorch's own DataLoader."""
