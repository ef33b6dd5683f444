"""Devices to compute on."""

import contextlib
import functools
import os
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from dsr.utils.configuration import ConfigError

_P = ParamSpec("_P")
_R = TypeVar("_R")
# What a CPU has where convolutions in bfloat16 are faster, also with gradients (benchmarks/run.py speed train-step).
_FAST_ON_CPU = ("_is_avx512_bf16_supported", "_is_amx_tile_supported")


def fast_precision(device: torch.device) -> str:
    """Return the precision that convolutions are fast in: bfloat16 on a GPU or CPU with instructions for it."""
    if device.type == "cuda":
        return "bfloat16" if torch.cuda.is_bf16_supported(including_emulation=False) else "float32"
    flags = (getattr(torch.cpu, name, lambda: False) for name in _FAST_ON_CPU)
    return "bfloat16" if device.type == "cpu" and any(flag() for flag in flags) else "float32"


def widened(value: Any) -> Any:
    """Return float16 and bfloat16 tensors, also those of a mapping, in float32; anything else as it is."""
    if isinstance(value, Mapping):
        return {name: widened(each) for name, each in value.items()}
    return value.float() if isinstance(value, Tensor) and value.dtype in (torch.float16, torch.bfloat16) else value


def in_own_precision(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Let a metric or a loss compute without ``torch.autocast``, and in float32 where its arguments have 16 bits."""

    @functools.wraps(function)
    def computed(*given: _P.args, **named: _P.kwargs) -> _R:
        with contextlib.ExitStack() as stack:
            backends: tuple[Any, ...] = torch.backends.cudnn, torch.backends.cuda.matmul
            for backend in backends:
                if backend.allow_tf32 and torch.cuda.is_available():
                    stack.callback(setattr, backend, "allow_tf32", True)
                    backend.allow_tf32 = False
            for kind in ("cpu", "cuda", "mps", "xpu"):
                if torch.is_autocast_enabled(kind):
                    stack.enter_context(torch.autocast(kind, enabled=False))
            return function(*map(widened, given), **widened(named))

    return computed


def made_once(make: Callable[_P, _R]) -> Callable[_P, _R]:
    """Keep the constants that a function makes: no step waits for their copy to a GPU, and a graph may contain them.

    Gradients can be computed with them, also where they were first asked for in inference mode.
    """
    kept = functools.lru_cache(64)(torch.inference_mode(mode=False)(make))

    @functools.wraps(make)
    def get(*given: _P.args, **named: _P.kwargs) -> _R:
        if torch.compiler.is_compiling():  # or exporting, by tensors without values, which must not be kept
            return make(*given, **named)
        return kept(*given, **named)  # type: ignore[arg-type]  # they are hashable

    # As torch.compiler.assume_constant_result does, which first imports the compiler, a second of every command
    get._dynamo_marked_constant = True  # type: ignore[attr-defined]
    return get


@made_once
def constant(values: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return numbers, (n,), or rows of numbers, as a tensor, which is not to be changed in place."""
    return torch.tensor(values, dtype=dtype, device=device)


def known_true(flags: Tensor) -> bool:
    """Return whether all flags are set; False for those on a GPU, since reading them would wait for it."""
    return flags.device.type == "cpu" and bool(flags.all())


def pick_device(name: str, fast_on: str = "any", precision: str = "float32") -> torch.device:
    """Return the device of that name; on a GPU, convolutions in float32 use TF32 for ``tf32`` alone, products never.

    ``auto`` is $DSR_DEVICE, else the first GPU where there is one and the method is ``fast_on`` any, else the CPU.
    """
    given_by = "device"
    if name == "auto" and os.environ.get("DSR_DEVICE"):
        given_by, name = "$DSR_DEVICE", os.environ["DSR_DEVICE"]
    if name == "auto":
        name = "cuda" if fast_on == "any" and torch.cuda.is_available() else "cpu"
    if name.startswith("mps"):
        raise ConfigError(f"{given_by}: expected auto, cpu or cuda, got {name!r}, which has no float64")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError) as error:  # torch asserts that it was built for CUDA
        raise ConfigError(f"{given_by}: expected auto, cpu or a device of this machine, got {name!r}") from error
    if device.type == "cuda":
        torch.backends.cudnn.allow_tf32 = precision == "tf32"
        torch.backends.cuda.matmul.allow_tf32 = False  # maps are enlarged and averaged by products of matrices
    elif precision == "tf32":
        raise ConfigError(f"precision: expected auto, float32 or bfloat16 on device={device}, got tf32")
    return device
