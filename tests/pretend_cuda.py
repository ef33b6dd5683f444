"""A CUDA device that computes on the CPU, and refuses what CUDA refuses: tests of devices where there is no GPU.

Within ``with pretend_cuda():`` a tensor that is made on, or moved to, ``"cuda"`` is a :class:`CudaTensor`. It says that
it is on ``cuda:0``, has real values in the CPU's memory, and can be differentiated. An operation that mixes it with a
tensor of the CPU raises the error that CUDA would raise, and so do ``numpy()`` and a generator of the CPU. Values can
be read (``item``, ``bool``, indices by masks), so that methods run to their end, and results can be compared.
``torch.autocast("cuda")`` does nothing, and ``torch.inference_mode`` is ``torch.no_grad``.

torch's FakeTensorMode has such a device, too, but without values: what reads one ends there.
"""

import contextlib
from unittest import mock

import lightning
import torch
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.strategies import SingleDeviceStrategy
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_flatten, tree_map

CUDA = torch.device("cuda", 0)
_CPU = torch.device("cpu")
_Trainer = lightning.Trainer
_MIXED = "Expected all tensors to be on the same device, but found at least two devices, cuda:0 and cpu! ({})"
_COPIES = ("copy_", "_to_copy")
_INDEXED = ("index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index", "_unsafe_index_put")
_JOINED = ("cat", "stack")
_MOVES = ("to", "cpu", "cuda")
_READS = ("tolist", "numpy", "__array__")
_EMPTY = []  # Not empty while a tensor is made that is meant to be on ``meta``, without values


class CudaTensor(Tensor):
    """A tensor that is on ``cuda:0`` as far as programs can tell; for C++ it is on the device ``meta``."""

    values: Tensor

    @staticmethod
    def __new__(cls, values, *, requires_grad=False):
        """Make one of a tensor of the CPU, which it shares."""
        values = values.resolve_conj().resolve_neg()  # C++ does not see these bits
        made = Tensor._make_wrapper_subclass(
            cls,
            values.shape,
            strides=values.stride(),
            storage_offset=values.storage_offset(),
            dtype=values.dtype,
            device="meta",
            requires_grad=requires_grad,
        )
        made.values = values
        return made

    @property
    def device(self):
        return CUDA

    @property
    def is_cuda(self):
        return True

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        """Check the devices, and compute on the CPU."""
        return _compute(func, args, kwargs or {})


class _Factories(TorchDispatchMode):
    """Tensors that C++ makes on the device of a :class:`CudaTensor`."""

    @classmethod
    def _should_skip_dynamo(cls):
        return False  # which would import the compiler, seconds

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _compute(func, args, kwargs or {})


class _Functions(TorchFunctionMode):
    """What Python calls with a device, and what reads a tensor's memory."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        name = getattr(func, "__name__", "")
        subject = args[0] if args and isinstance(args[0], Tensor) else None
        if subject is not None and name in _MOVES and func is getattr(Tensor, name, None):
            return _move(subject, name, args[1:], kwargs)
        if isinstance(subject, CudaTensor) and name in _READS:
            if name == "tolist":
                return subject.values.tolist()
            raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy it first.")
        if isinstance(subject, CudaTensor) and name == "as_tensor":
            return _move(subject, "to", (), kwargs)
        if subject is not None and name == "new_tensor":
            kwargs.setdefault("dtype", subject.dtype)
            kwargs.setdefault("device", subject.device)
            func, args = torch.tensor, args[1:]
        if isinstance(subject, CudaTensor) and name in ("__getitem__", "__setitem__"):
            args = (subject, _with_tensors(args[1]), *args[2:])  # C++ would make empty indices of lists
        if "generator" in kwargs and kwargs["generator"] is not None:
            _expect_generator(kwargs["generator"], _is_cuda(kwargs.get("device")) or isinstance(subject, CudaTensor))
        if kwargs.get("device") is not None and torch.device(kwargs["device"]).type == "meta":
            _EMPTY.append(True)
            try:
                return func(*args, **kwargs)
            finally:
                _EMPTY.pop()
        if _is_cuda(kwargs.get("device")):
            kwargs["device"] = _CPU
            gradient = bool(kwargs.pop("requires_grad", False))
            made = func(*tree_map(_values_of, args), **tree_map(_values_of, kwargs))
            return made if not isinstance(made, Tensor) else CudaTensor(made).requires_grad_(gradient)
        return func(*args, **kwargs)


class _Generator(torch.Generator):
    """A generator of random numbers, which may say that it is on a GPU."""

    on_cuda: bool

    def __new__(cls, device="cpu"):
        made = super().__new__(cls, "cpu")
        made.on_cuda = _is_cuda(device)
        return made

    @property
    def device(self):
        return CUDA if self.on_cuda else _CPU


@contextlib.contextmanager
def pretend_cuda():
    """Have a device ``cuda`` in the block, which is yielded."""
    with contextlib.ExitStack() as stack:
        for name, answer in (("is_available", True), ("is_bf16_supported", True), ("synchronize", None)):
            stack.enter_context(mock.patch(f"torch.cuda.{name}", mock.Mock(return_value=answer)))
        stack.enter_context(mock.patch("torch.Generator", _Generator))
        stack.enter_context(mock.patch("torch.autocast", _make_autocast(torch.autocast)))
        stack.enter_context(mock.patch("lightning.Trainer", _make_trainer))
        stack.enter_context(mock.patch.object(torch.inference_mode, "__enter__", _enter_without_gradients))
        stack.enter_context(_Factories())
        stack.enter_context(_Functions())
        yield CUDA


def _enter_without_gradients(context):
    """Begin ``torch.inference_mode``, whose tensors take no subclasses' views, as ``torch.no_grad``."""
    context._inference_mode_context = torch.set_grad_enabled(not context.mode and torch.is_grad_enabled())
    context._inference_mode_context.__enter__()


class _Accelerator(CPUAccelerator):
    """Lightning's accelerator for the CPU, which has the pretended device."""

    def setup_device(self, device):
        """Take any device."""


def _make_trainer(*, accelerator, devices, **named):
    """Return Lightning's trainer, for the pretended device where it is one for GPUs."""
    if accelerator != "gpu":
        return _Trainer(accelerator=accelerator, devices=devices, **named)
    return _Trainer(strategy=SingleDeviceStrategy(CUDA, _Accelerator()), **named)


def _make_autocast(real):
    """Return ``torch.autocast``; for ``cuda`` it is that of the device that C++ sees, which has none."""

    def make(device_type, *args, **kwargs):
        if device_type == "cuda":
            return contextlib.nullcontext()
        return real(device_type, *args, **kwargs)

    return make


def _compute(func, args, kwargs):
    """Return what an operation of PyTorch gives, on the CPU or on the pretended device."""
    name = func.overloadpacket.__name__
    leaves = [each for each in tree_flatten((args, kwargs))[0] if isinstance(each, Tensor)]
    device = kwargs.get("device")
    on_cuda = any(isinstance(each, CudaTensor) for each in leaves)
    if not on_cuda and (_EMPTY or any(each.is_meta for each in leaves)):
        return func(*args, **kwargs)
    inside = {**kwargs, "device": _CPU} if device is not None else kwargs
    inside, values = tree_map(_values_of, inside), tree_map(_values_of, args)
    if name in _COPIES:
        to_cuda = isinstance(args[0], CudaTensor) if device is None or name == "copy_" else not _is_cpu(device)
    else:
        to_cuda = on_cuda if device is None else not _is_cpu(device)
        if on_cuda:
            _expect_one_device(name, args, leaves)
        if kwargs.get("generator") is not None:
            _expect_generator(kwargs["generator"], to_cuda)
    out = func(*values, **inside)
    if not to_cuda:
        return args[0] if name == "copy_" else out
    wrapped = tree_map(lambda each: CudaTensor(each) if isinstance(each, Tensor) else each, out)
    return return_and_correct_aliasing(func, args, kwargs, wrapped) if on_cuda and name != "_to_copy" else wrapped


def _expect_one_device(name, args, leaves):
    """Raise what CUDA raises for tensors of several devices; it takes single numbers of the CPU."""
    if name in _INDEXED and isinstance(args[0], CudaTensor):  # indices may be the CPU's
        leaves = [each for each in args[2:3] if isinstance(each, Tensor)]
    for each in leaves:
        if not isinstance(each, CudaTensor) and (each.dim() > 0 or name in _JOINED):
            raise RuntimeError(_MIXED.format(name))


def _expect_generator(generator, on_cuda):
    if on_cuda != (generator.device.type == "cuda"):
        found, expected = ("cpu", "cuda") if on_cuda else ("cuda", "cpu")
        raise RuntimeError(f"Expected a '{expected}' device type for generator but found '{found}'")


def _move(tensor, name, args, kwargs):
    """Carry out ``tensor.to``, ``cpu`` or ``cuda``."""
    rest, device = list(args), kwargs.pop("device", None)
    if name != "to":
        device = name
    elif rest and isinstance(rest[0], Tensor):
        other = rest.pop(0)
        device = other.device
        kwargs.setdefault("dtype", other.dtype)
    elif rest and (rest[0] is None or isinstance(rest[0], str | torch.device | int)):
        device = rest.pop(0)
    if rest and "dtype" not in kwargs:
        kwargs["dtype"] = rest[0]
    kwargs = {key: value for key, value in kwargs.items() if value is not None and key != "non_blocking"}
    converted = Tensor.to(tensor, **kwargs) if kwargs else tensor
    if device is None or _is_cuda(device) == isinstance(tensor, CudaTensor):
        return converted
    return _Move.apply(converted)


class _Move(torch.autograd.Function):
    """A copy between the devices, which gradients go through, too."""

    @staticmethod
    def forward(ctx, tensor):
        return tensor.values.clone() if isinstance(tensor, CudaTensor) else CudaTensor(tensor.clone())

    @staticmethod
    def backward(ctx, gradient):
        return gradient.values.clone() if isinstance(gradient, CudaTensor) else CudaTensor(gradient.clone())


def _with_tensors(index):
    """Return an index with tensors in place of lists."""
    if isinstance(index, tuple):
        return tuple(_with_tensors(each) for each in index)
    return torch.as_tensor(index) if isinstance(index, list) else index


def _values_of(each):
    return each.values if isinstance(each, CudaTensor) else each


def _is_cuda(device):
    return device is not None and (isinstance(device, int) or torch.device(device).type == "cuda")


def _is_cpu(device):
    return torch.device(device).type == "cpu"
