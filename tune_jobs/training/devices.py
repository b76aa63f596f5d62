"""Choose where a trial computes."""

from __future__ import annotations

import socket

import torch

from policies.errors import CannotRunError


def device_for(num_gpus: float) -> str:
    """Return the device of a trial that was given so many GPUs, `cuda` or `cpu`.

    Raises:
        CannotRunError: PyTorch sees no GPU here. On the CPU the trial would go on unnoticed, many times slower, while a
            GPU is reserved for it.
    """
    if not num_gpus:
        return "cpu"
    if not torch.cuda.is_available():
        host = socket.gethostname()
        raise CannotRunError(
            f"resources.num_gpus is {num_gpus:g}, and PyTorch {torch.__version__} sees no GPU on {host}.",
            "Install PyTorch's build for this GPU's driver there (`nvidia-smi` tells its version), or set "
            "resources.num_gpus to 0.",
        )
    return "cuda"
