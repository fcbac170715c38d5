# SPDX-License-Identifier: Apache-2.0
"""A pretend GPU for machines without one: what CUDA refuses, waits for and launches, seen on any CPU.

torch's own means do not do here: a CPU build refuses fake tensors on "cuda", and fake tensors have no values,
without which neither matching nor metrics run. So PrivateUse1, torch's free place for a backend, is set up as
a backend in Python called "pretend". Its tensors wrap CPU tensors *with values*. Every operation on them
passes through ``_run``, which

- raises ``DeviceMixError`` where CUDA would ("expected all tensors to be on the same device"),
- notes every operation for which CUDA makes the host wait until the device has done all that it was given,
  and the lines that asked for it: ``.item()``, a boolean index, ``nonzero``, a copy from or to pageable
  memory such as ``torch.tensor([...], device=...)``, and the like,
- counts launches of kernels: operations that are neither views nor allocations, and Triton's kernels, which
  run on the wrapped tensors in Triton's interpreter.

An operation counts as one launch; where CUDA needs several for it, the true number is higher. Autocast casts
as CUDA's does, for the operations that the network has.

The backend belongs to a whole process and must be set up before its first gradient. So tests run on it in a
process of their own, one for each of pytest's::

    from .pretend_device import DEVICE, on_pretend_device, recorded

    @on_pretend_device
    def test_no_wait():
        with recorded() as seen:
            torch.ones(2, device=DEVICE).sum()
        assert not seen.waits, seen

A test's arguments are copied to that process: parameters and ``tmp_path`` can be, ``monkeypatch`` cannot.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import importlib
import os
import pickle
import subprocess
import sys
import traceback
import types
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor
from torch.nn.functional import scaled_dot_product_attention
from torch.optim.optimizer import _foreach_supported_types as taken_by_optimizers
from torch.utils import backend_registration
from torch.utils._foreach_utils import _foreach_supported_types as taken_by_norms
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes

NAME = "pretend"
DEVICE = f"{NAME}:0"

aten = torch.ops.aten

_set_up_backend = getattr(backend_registration, "_setup_privateuseone_for_python_backend", None)

_COPIES = {aten.copy_.default, aten._to_copy.default}
_CONVOLUTIONS = {aten.convolution.default: 0, aten.convolution_backward.default: 1}
"""Convolutions, and where the features are among their arguments, followed by the weight."""

_INDEXING = {aten.index.Tensor, aten.index_put.default, aten.index_put_.default}
_WAITS = {
    aten._linalg_check_errors.default: "a check for errors",
    aten._local_scalar_dense.default: ".item()",
    aten._unique2.default: "unique",
    aten.bincount.default: "bincount",
    aten.equal.default: "torch.equal",
    aten.masked_select.default: "masked_select",
    aten.nonzero.default: "nonzero",
    aten.unique_consecutive.default: "unique_consecutive",
    aten.unique_dim.default: "unique",
}
_NO_LAUNCH = {
    *(
        "_local_scalar_dense",
        "_reshape_alias",
        "_unsafe_view",
        "alias",
        "detach",
        "is_same_size",
        "lift_fresh",
    ),
    *("empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided", "resize_"),
}
_TENSORS_A_LAUNCH = (110, 64, 48, 36, 30)
"""Tensors of each list that one launch of a ``_foreach`` or fused operation takes, by the number of lists
(``MultiTensorApply.cuh`` in torch). That it takes no more than 320 pieces of 65,536 elements is left out of
the count: a test's tensors are small. With the weights of the paper's network it makes one launch more."""

_ATTENTION_BACKWARD = 3
"""Kernels in which flash attention computes its gradients; forward it is one."""

_KERNELS = {"block_attention": 2, "block_attention_backward": 5, "block_sum": 2}
"""Kernels that raytran's operators launch, for when they are left out; a test counts those that run."""

# Of CUDA's lists of what autocast casts, the operations that the network has.
_TO_16_BITS = (
    *("linear", "conv2d", "conv3d", "conv_transpose2d.input", "conv_transpose3d.input"),
    *("matmul", "mm", "bmm", "addmm", "baddbmm", "scaled_dot_product_attention"),
)
_TO_32_BITS = (
    *("layer_norm", "group_norm", "softmax.int", "log_softmax.int", "smooth_l1_loss", "mse_loss"),
    *("exp", "log", "pow.Tensor_Scalar", "reciprocal", "sum", "sum.dim_IntList", "cumsum"),
)


class DeviceMixError(RuntimeError):
    """Tensors of two devices met where CUDA wants those of one."""


class Ledger:
    """What was seen.

    Attributes:
        waits: how often the host waits for the device, by reason and lines.
        launches: how many kernels are launched, by name.
    """

    def __init__(self) -> None:
        self.waits: Counter[str] = Counter()
        self.launches: Counter[str] = Counter()

    def __str__(self) -> str:
        total = f"{self.waits.total()} waits, {self.launches.total()} launches"
        return "\n".join([total, *(f"{count:4d} x {place}" for place, count in self.waits.most_common())])


_ledger = Ledger()
_waits_so_far = 0
_stand_ins: dict[str, Callable[..., Any]] = {}
_traced: dict[Any, tuple[Any, Ledger]] = {}
_libraries: list[torch.library.Library] = []
_page_locked: dict[int, Tensor] = {}
"""Tensors in page-locked memory, by their addresses, which being here they keep."""


@contextlib.contextmanager
def recorded() -> Iterator[Ledger]:
    """Note apart what happens in the block of this statement."""
    global _ledger
    outer, _ledger = _ledger, Ledger()
    try:
        yield _ledger
    finally:
        _ledger = outer


@contextlib.contextmanager
def kernels_left_out() -> Iterator[None]:
    """Count what raytran's kernels do without doing it, where the interpreter would take seconds.

    Attention and splatting give zeros; the pairs of the same cameras are traced once.
    """
    from raytran.ops.triton import traverse as trace_blocks

    trace = trace_blocks.trace_blocks

    def trace_once(cameras: Any, grid: Any, *rest: Any, capacity: int | None = None) -> Any:
        global _waits_so_far
        tensors = _inside([cameras.intrinsics, cameras.world_from_camera, grid.center])
        known = (
            str([tensor.tolist() for tensor in tensors]),
            cameras.image_size,
            grid.resolution,
            grid.extent,
            rest,
            capacity,
        )
        if known not in _traced:
            with recorded():
                trace(cameras, grid, *rest, capacity=capacity)  # makes what is kept for all others
            with recorded() as seen:
                _traced[known] = trace(cameras, grid, *rest, capacity=capacity), seen
        (pairs, number), seen = _traced[known]
        _waits_so_far += seen.waits.total()
        _ledger.waits.update(seen.waits)
        _ledger.launches.update(seen.launches)
        return replace(pairs), number  # a copy, so that the orders of the pairs are made anew

    _stand_ins.update(_ZEROS)
    trace_blocks.trace_blocks = trace_once
    try:
        yield
    finally:
        _stand_ins.clear()
        trace_blocks.trace_blocks = trace


class Pretend(torch.Tensor):
    """A tensor on the pretend device, around the tensor on the CPU that has its values."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> Pretend:
        form: dict[str, Any] = {"dtype": inner.dtype, "device": torch.device(DEVICE)}
        if inner.layout == torch.strided:  # no wrapper can say that it is sparse, and none needs to
            form |= {"strides": inner.stride(), "storage_offset": inner.storage_offset()}
        self = torch.Tensor._make_wrapper_subclass(cls, inner.shape, **form)
        self.inner = inner
        return self

    def __repr__(self) -> str:
        return f"Pretend({self.inner})"

    def __reduce_ex__(self, protocol: int) -> Any:
        """Be saved as what ``torch.load(map_location="cpu")`` makes of a GPU's tensor."""
        return self.inner.detach().__reduce_ex__(protocol)

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is torch.Tensor.tolist:
            return args[0].cpu().tolist()
        if func in (torch.Tensor.numpy, torch.Tensor.__array__):
            raise DeviceMixError(f"a tensor on {NAME} cannot become an array, at {_place()}")
        # What comes back on the CPU must not become one of these.
        with torch._C.DisableTorchFunctionSubclass():
            return func(*args, **(kwargs or {}))

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class Everything(TorchDispatchMode):
    """Sees also what starts on the CPU: tensors made on the device, page-locked memory, ranks that talk."""

    def __enter__(self) -> Everything:
        # torch.tensor([...], device=...) is then made on the CPU and copied in a way that is seen.
        torch._C._set_only_lift_cpu_tensors(True)
        super().__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        torch._C._set_only_lift_cpu_tensors(False)
        super().__exit__(*error)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func.namespace == "c10d":
            return _talk(func, args, kwargs)
        if _is_here(kwargs.get("device")) or any(map(_is_pretend, _tensors((args, kwargs)))):
            return _run(func, args, kwargs)
        if func is aten.is_pinned.default:
            return _is_page_locked(args[0])
        if func is aten._pin_memory.default:
            return _lock_page(args[0].clone())
        if kwargs.get("pin_memory"):
            return _lock_page(func(*args, **(kwargs | {"pin_memory": False})))
        return func(*args, **kwargs)


class _Form(NamedTuple):
    """What an operation's schema says.

    Attributes:
        name: without its namespace.
        launches: whether it does anything on the device.
        changed: for each result the place and name of the argument that it is, None for a new tensor.
    """

    name: str
    launches: bool
    changed: tuple[tuple[int, str] | None, ...]


@functools.cache
def _form(func: Any) -> _Form:
    schema, name = func._schema, func._schema.name.split("::")[-1]
    aliases = [argument.alias_info for argument in schema.arguments]
    is_view = any(alias and not alias.is_write for alias in aliases) and bool(schema.returns)
    written = [alias.before_set if alias and alias.is_write else None for alias in aliases]
    changed: list[tuple[int, str] | None] = []
    for alias in (result.alias_info for result in schema.returns):
        place = written.index(alias.before_set) if alias and alias.is_write else None
        changed.append(None if place is None else (place, schema.arguments[place].name))
    return _Form(name, not (is_view or name in _NO_LAUNCH), tuple(changed))


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Run an operation on the tensors inside, and note what CUDA would do."""
    form, device = _form(func), kwargs.get("device")
    _check_devices(func, args, list(_tensors((args, kwargs))))
    reason = _wait_of(func, args, kwargs)
    if reason is not None:
        _wait(reason)
    run = func
    if func.namespace == "raytran":  # its kernels are counted where they are launched
        if form.name in _stand_ins:
            run = _stand_ins[form.name]
            _ledger.launches[form.name] += _KERNELS[form.name]
    elif form.launches:
        _ledger.launches[form.name] += _launches_of(func, form.name, args)
    kwargs_inside = {key: _inside(value) for key, value in kwargs.items()}
    if device is not None:
        kwargs_inside["device"] = torch.device("cpu")
        kwargs_inside.pop("non_blocking", None)
    found = run(*map(_inside, args), **kwargs_inside)
    if func in _CONVOLUTIONS:
        found = _laid_out(found, _form_of_convolution(func, args))
    elif func is aten.native_group_norm.default:
        found = _laid_out(found, torch.contiguous_format)  # CUDA's gives no other
    if device is not None and not _is_here(device):
        # What comes from the device without a wait, torch puts into page-locked memory.
        return _lock_page(found) if kwargs.get("non_blocking") else found
    results = [
        _outside(value) if place is None else args[place[0]] if place[0] < len(args) else kwargs[place[1]]
        for value, place in zip(found if len(form.changed) > 1 else [found], form.changed, strict=False)
    ]
    return tuple(results) if len(results) > 1 else results[0] if results else None


def _launches_of(func: Any, name: str, args: Any) -> int:
    """Return how many kernels an operation launches, as far as that is known here."""
    if name.startswith(("_foreach", "_fused")):
        return _launches_over_lists(name, args)
    if func in _CONVOLUTIONS:
        form = _form_of_convolution(func, args)
        tensors = [argument.inner for argument in args[: _CONVOLUTIONS[func] + 2]]
        return 1 + sum(not tensor.is_contiguous(memory_format=form) for tensor in tensors)  # it copies them
    if func is aten.native_group_norm.default:
        return 1 if args[0].inner.is_contiguous() else 2
    return 1


def _form_of_convolution(func: Any, args: Any) -> torch.memory_format:
    """Return how cuDNN wants what a convolution reads, and gives it: channels last, if any of it lies so."""
    features, weight = (argument.inner for argument in args[_CONVOLUTIONS[func] :][:2])
    last = {4: torch.channels_last, 5: torch.channels_last_3d}[weight.ndim]
    lies_so = features.is_contiguous(memory_format=last) or weight.is_contiguous(memory_format=last)
    return last if lies_so else torch.contiguous_format


def _launches_over_lists(name: str, args: Any) -> int:
    """Return how many kernels an operation over lists of tensors launches."""
    lists = [argument for argument in args if isinstance(argument, list | tuple)]
    lists = [values for values in lists if values and isinstance(values[0], Tensor)]
    layouts = [[(tensor.shape, tensor.stride()) for tensor in tensors] for tensors in lists]
    if name == "_foreach_copy_" and layouts[0] != layouts[1]:
        return len(lists[0])  # then one after another
    # A fused optimiser reads the steps, its last list, beside the pieces of the others.
    depth = len(lists) - name.startswith("_fused")
    launches = -(-len(lists[0]) // _TENSORS_A_LAUNCH[depth - 1])
    return launches + 2 if name == "_foreach_norm" else launches  # zeros before, the pieces' sum behind


def _wait(reason: str) -> None:
    global _waits_so_far
    _waits_so_far += 1
    _ledger.waits[f"{reason} at {_place()}"] += 1


def _check_devices(func: Any, args: Any, tensors: list[Tensor]) -> None:
    """Raise where CUDA would, of tensors of which some are on the CPU."""
    elsewhere = [tensor for tensor in tensors if not _is_pretend(tensor)]
    if not elsewhere or func in _COPIES:
        return
    if func in _INDEXING:
        values = args[2] if len(args) > 2 else args[0]
        is_allowed = _is_pretend(args[0]) and (_is_pretend(values) or not values.ndim)  # whatever the indices
    else:
        takes_numbers = torch.Tag.pointwise in func.tags or func is aten.fill_.Tensor
        is_allowed = takes_numbers and not any(tensor.ndim for tensor in elsewhere)
    if not is_allowed:
        raise DeviceMixError(f"{func}: tensors on {NAME} and on the CPU, at {_place()}")


def _wait_of(func: Any, args: Any, kwargs: dict[str, Any]) -> str | None:
    """Say why CUDA makes the host wait for an operation, None if it does not."""
    if func in _COPIES:
        return _wait_of_copy(func, args, kwargs)
    if func in _INDEXING:
        indices = [index for index in args[1] if index is not None]
        if any(index.dtype in (torch.bool, torch.uint8) for index in indices):
            return "boolean index"
        return None if all(map(_is_pretend, indices)) else "index on the CPU"
    if func is aten.repeat_interleave.Tensor and kwargs.get("output_size") is None:
        return "repeat_interleave without output_size"
    return "a check for errors" if kwargs.get("check_errors") else _WAITS.get(func)


def _wait_of_copy(func: Any, args: Any, kwargs: dict[str, Any]) -> str | None:
    if func is aten.copy_.default:
        to_here, from_here = map(_is_pretend, args[:2])
        host, at_once = args[1] if to_here else args[0], kwargs.get("non_blocking") or args[2:] == (True,)
    else:
        from_here, at_once = _is_pretend(args[0]), kwargs.get("non_blocking")
        to_here = from_here if kwargs.get("device") is None else _is_here(kwargs["device"])
        host = args[0] if to_here else None  # made in page-locked memory
    if to_here == from_here or (at_once and (host is None or _is_page_locked(host))):
        return None
    return "copy from pageable memory" if to_here else "copy to the host"


def _talk(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Let ranks talk. The group of all GPUs does so by NCCL, which takes no tensors on the CPU."""
    import torch.distributed as dist

    tensors = list(_tensors((args, kwargs)))
    if tensors and all(map(_is_pretend, tensors)):
        _ledger.launches[_form(func).name] += 1
        found = func(*map(_inside, args), **kwargs)
        return (args[0], *found[1:]) if isinstance(found, tuple) else found
    objects = [argument for argument in args if isinstance(argument, torch.ScriptObject)]
    groups = [dist.ProcessGroup.unbox(one) for one in objects if "ProcessGroup" in str(one._type())]
    if dist.group.WORLD in groups and "barrier" not in func._schema.name:
        raise DeviceMixError(f"{func}: NCCL takes no tensors on the CPU, at {_place()}")
    return func(*args, **kwargs)


def _tensors(values: Any) -> Iterator[Tensor]:
    if isinstance(values, Tensor):
        yield values
    elif isinstance(values, list | tuple | dict):
        for value in values.values() if isinstance(values, dict) else values:
            yield from _tensors(value)


def _laid_out(value: Any, form: torch.memory_format) -> Any:
    if isinstance(value, tuple):
        return tuple(_laid_out(item, form) for item in value)
    return value.contiguous(memory_format=form) if isinstance(value, Tensor) and value.ndim > 1 else value


def _inside(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return type(value)(map(_inside, value))
    return value.inner if isinstance(value, Pretend) else value


def _outside(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return type(value)(map(_outside, value))
    return Pretend(value) if isinstance(value, Tensor) else value


def _is_pretend(value: Any) -> bool:
    return isinstance(value, Pretend)


def _is_here(device: Any) -> bool:
    return device is not None and torch.device(device).type == NAME


def _lock_page(tensor: Tensor) -> Tensor:
    _page_locked[tensor.untyped_storage().data_ptr()] = tensor
    return tensor


def _is_page_locked(tensor: Tensor) -> bool:
    return tensor.untyped_storage().data_ptr() in _page_locked


_NOT_SHOWN = (str(Path(torch.__file__).parent), __file__)


def _place() -> str:
    """Return the two innermost lines outside of torch and of this file."""
    lines: list[str] = []
    frame: types.FrameType | None = sys._getframe(1)
    while frame is not None and len(lines) < 2:
        file = frame.f_code.co_filename
        if not file.startswith(_NOT_SHOWN):
            lines.append(f"{'/'.join(file.rsplit('/', 2)[-2:])}:{frame.f_lineno}")
        frame = frame.f_back
    return " < ".join(lines) or "the backward pass"


def _no_attention(query: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
    out = torch.zeros_like(query, memory_format=torch.contiguous_format)
    return out, query.new_zeros(query.shape[:2], dtype=torch.float32)


_ZEROS: dict[str, Callable[..., Any]] = {
    "block_attention": _no_attention,
    "block_attention_backward": lambda _, saved, *__: tuple(map(torch.zeros_like, saved[:3])),
    "block_sum": lambda source, *rest: source.new_zeros(rest[-1], source.shape[1], dtype=torch.float32),
}


class _Attention(torch.autograd.Function):
    """Dense attention in one kernel, as on CUDA; of an unknown backend torch does it in many operations."""

    @staticmethod
    def forward(ctx: Any, options: dict[str, Any], *inputs: Tensor) -> Tensor:
        ctx.options = options
        ctx.save_for_backward(*inputs)
        _ledger.launches["attention"] += 1
        with _disable_current_modes():
            return Pretend(scaled_dot_product_attention(*_inside(inputs), **options))

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        _ledger.launches["attention_backward"] += _ATTENTION_BACKWARD
        with _disable_current_modes(), torch.enable_grad():
            inputs = [tensor.detach().requires_grad_() for tensor in _inside(ctx.saved_tensors)]
            out = scaled_dot_product_attention(*inputs, **ctx.options)
            return None, *map(Pretend, torch.autograd.grad(out, inputs, _inside(gradient)))


def _attend(
    query: Tensor, key: Tensor, value: Tensor, attn_mask: Tensor | None = None, *rest: Any, **more: Any
) -> Tensor:
    tensors = list(_tensors((query, key, value, attn_mask)))
    _check_devices(aten.scaled_dot_product_attention.default, (), tensors)
    options = dict(zip(("dropout_p", "is_causal"), rest, strict=False)) | more
    return _Attention.apply(options | {"attn_mask": _inside(attn_mask)}, query, key, value)


class _Backend(backend_registration._DummyBackendModule):
    """What torch asks ``torch.pretend`` for."""

    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.float16, torch.bfloat16]

    def get_rng_state(self, device: Any = None) -> Tensor:
        return torch.get_rng_state()

    def set_rng_state(self, state: Tensor, device: Any = None) -> None:
        torch.set_rng_state(state)

    def current_stream(self, device: Any = None) -> None:
        """Return the one stream that there is."""

    class Event:
        """What the device comes to when it has done all before: waited for, unless it was since."""

        def record(self, stream: None) -> None:
            self._waits = _waits_so_far

        def query(self) -> bool:
            return self._waits < _waits_so_far

        def synchronize(self) -> None:
            if not self.query():
                _wait("an event")


def set_up() -> None:
    """Set up the backend in this process; what is done on it then stands in a block of ``Everything``."""
    torch.set_num_threads(1)
    torch.backends.mkldnn.set_flags(False)  # its 16-bit gradients of convolutions are noise on small volumes
    _set_up_backend(NAME, backend_module=_Backend())
    for taken in (taken_by_optimizers, taken_by_norms):
        taken.append(Pretend)
    operations, others = torch.library.Library("aten", "IMPL"), torch.library.Library("_", "IMPL")
    operations.impl("scaled_dot_product_attention", _attend, "AutogradPrivateUse1")
    others.fallback(torch.library.fallthrough_kernel, "AutocastPrivateUse1")
    for names, in_32_bits in ((_TO_16_BITS, False), (_TO_32_BITS, True)):
        for name in names:
            operations.impl(name, _with_autocast(name, in_32_bits=in_32_bits), "AutocastPrivateUse1")
    _libraries.extend([operations, others])
    with contextlib.suppress(ImportError):
        from triton.runtime.interpreter import GridExecutor

        GridExecutor.__call__ = functools.partialmethod(_launch, GridExecutor.__call__)


def _with_autocast(name: str, *, in_32_bits: bool) -> Callable[..., Any]:
    operation, _, overload = name.partition(".")
    run = getattr(getattr(aten, operation), overload or "default")
    excluded = torch._C.DispatchKeySet(torch._C.DispatchKey.AutocastPrivateUse1)

    def cast(value: Any) -> Any:
        if not isinstance(value, Tensor) or not value.is_floating_point() or value.dtype == torch.float64:
            return value
        return value.to(torch.float32 if in_32_bits else torch.get_autocast_dtype(NAME))

    def call(*args: Any, **kwargs: Any) -> Any:
        with torch._C._ExcludeDispatchKeyGuard(excluded):
            return run(*map(cast, args), **{key: cast(value) for key, value in kwargs.items()})

    return call


def _launch(self: Any, interpret: Callable[..., None], *args: Any, **kwargs: Any) -> None:
    """Launch a kernel of Triton's."""
    _ledger.launches[self.fn.__name__] += 1
    with _disable_current_modes():
        interpret(self, *map(_inside, args), **kwargs)


class _Process:
    """A Python in which the backend is set up, and which runs tests by their names."""

    def __init__(self) -> None:
        # It sees none of the GPUs that the machine may have.
        more = {"TRITON_INTERPRET": "1", "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
        pipe = subprocess.PIPE
        self._python = subprocess.Popen(
            [sys.executable, __file__], stdin=pipe, stdout=pipe, env=os.environ | more
        )
        atexit.register(self._python.communicate)

    def run(self, module: str, name: str, arguments: dict[str, Any]) -> str | None:
        """Run a test and say how it failed, None if it passed."""
        pickle.dump((module, name, arguments), self._python.stdin)
        self._python.stdin.flush()
        try:
            return pickle.load(self._python.stdout)
        except EOFError:
            _process.cache_clear()
            return f"the process of the pretend device ended with code {self._python.wait()}"


@functools.cache
def _process() -> _Process:
    return _Process()


def on_pretend_device(test: Callable[..., None]) -> Callable[..., None]:
    """Run a test in a process that has the pretend device; skip it where torch is too old for that."""

    @pytest.mark.skipif(_set_up_backend is None, reason="this torch takes no backend in Python")
    @functools.wraps(test)
    def run(**arguments: Any) -> None:
        failure = _process().run(test.__module__, test.__name__, arguments)
        if failure is not None:
            pytest.fail(failure, pytrace=False)

    return run


def _serve() -> None:
    """Run tests as they come in, until the process ends that sends them."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a test prints must not come among the answers
    set_up()
    while True:
        try:
            module, name, arguments = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        failure = None
        try:
            test = getattr(importlib.import_module(module), name).__wrapped__
            with Everything(), recorded():
                test(**arguments)
        except BaseException:
            failure = traceback.format_exc()
        _page_locked.clear()
        pickle.dump(failure, answers)
        answers.flush()


if __name__ == "__main__":
    # Tests import this file from the package that pytest makes of their folder.
    package = types.ModuleType("tests")
    package.__path__ = [str(Path(__file__).parent)]
    sys.modules |= {"tests": package, "tests.pretend_device": sys.modules["__main__"]}
    _serve()
