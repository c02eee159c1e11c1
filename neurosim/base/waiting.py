"""Compiled functions in which a thread waits for another one, without Python's lock."""

from __future__ import annotations

import platform
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from neurosim.base.compiled import njit

_X86, _ARM = ("llvm.x86.sse2.pause",), ("llvm.aarch64.hint", 1)
#: LLVM's name of the instruction with which a thread waits, and its number, if any.
_PAUSE: tuple[Any, ...] = {"x86_64": _X86, "amd64": _X86, "aarch64": _ARM, "arm64": _ARM}.get(
    platform.machine().lower(), ()
)


def _place(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Return the address of a number in an array."""
    array = context.make_array(signature.args[0])(context, builder, arguments[0])
    return builder.gep(array.data, [arguments[1]])


@intrinsic
def _seen(typing: Any, numbers: Any, place: Any) -> Any:
    """Return the number at a place in an array, as other threads wrote it, and pause."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if _PAUSE:
            name, *given = (ir.Constant(ir.IntType(32), n) if n == 1 else n for n in _PAUSE)
            form = ir.FunctionType(ir.VoidType(), [one.type for one in given])
            builder.call(cgutils.get_or_insert_function(builder.module, form, name), given)
        return builder.load_atomic(_place(context, builder, signature, arguments), "acquire", 8)

    return types.int64(numbers, types.intp), generate


@intrinsic
def show(typing: Any, numbers: Any, place: Any, value: Any) -> Any:
    """Write a number into an array after all that was written before, for other threads."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address = _place(context, builder, signature, arguments)
        builder.store_atomic(arguments[2], address, "release", 8)
        return context.get_dummy_value()

    return types.void(numbers, types.intp, types.int64), generate


@intrinsic
def claim(typing: Any, numbers: Any, place: Any, count: Any) -> Any:
    """Add to the number at a place in an array; return what it was, for one thread alone."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address = _place(context, builder, signature, arguments)
        return builder.atomic_rmw("add", address, arguments[2], "acq_rel")

    return types.int64(numbers, types.intp, types.int64), generate


@njit(nogil=True)
def passed(numbers, place, number, turns):  # type: ignore[no-untyped-def]
    """Wait until a number [N] int64 has reached another one; return whether it has within turns."""
    for _ in range(turns):  # noqa: SIM110 - compiled
        if _seen(numbers, place) >= number:
            return True
    return False


@njit(nogil=True)
def rest(numbers, place, done, turns):  # type: ignore[no-untyped-def]
    """Show at a place that work is done, and wait for more work at 0; see :func:`passed`."""
    show(numbers, place, done)
    return passed(numbers, 0, done + 1, turns)


def compiled() -> bool:
    """Return whether Numba compiles functions; with NUMBA_DISABLE_JIT they are Python's."""
    return hasattr(passed, "overloads")
