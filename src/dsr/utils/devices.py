"""Devices to compute on."""

from __future__ import annotations

import os

import torch

from dsr.utils.builder import ConfigError


def fast_precision(device: torch.device) -> str:
    """Return the precision that convolutions are fast in: bfloat16 on a GPU that has it and on a CPU with AMX."""
    if device.type == "cuda":
        return "bfloat16" if torch.cuda.is_bf16_supported(including_emulation=False) else "float32"
    amx = getattr(torch.cpu, "_is_amx_tile_supported", None)
    return "bfloat16" if device.type == "cpu" and amx is not None and amx() else "float32"


def inference_precision(device: torch.device) -> str:
    """Return the precision in which convolutions without gradients are fast; a CPU may have AVX-512 for bfloat16."""
    avx = getattr(torch.cpu, "_is_avx512_bf16_supported", None)
    return "bfloat16" if device.type == "cpu" and avx is not None and avx() else fast_precision(device)


def pick_device(name: str) -> torch.device:
    """Return the device of that name; ``auto`` is $DSR_DEVICE, else the first GPU where there is one, else the CPU.

    Raises:
        ConfigError: there is no such device here.

    """
    given_by = "device"
    if name == "auto" and os.environ.get("DSR_DEVICE"):
        given_by, name = "$DSR_DEVICE", os.environ["DSR_DEVICE"]
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError) as error:  # torch asserts that it was built for CUDA
        raise ConfigError(f"{given_by}: expected auto, cpu or a device of this machine, got {name!r}") from error
    return device
