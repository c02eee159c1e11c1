"""Functions that are parts of compiled loops."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

from neurosim.base.compiled import njit


def kernel(**options: Any) -> Callable[[Any], Any]:
    """Compile a function that is a part of a loop and makes no arrays.

    Numba counts references to each array and each part of one. In a robot's step this takes as long
    as the step itself. The caller of a kernel keeps the arrays, so kernels do not count. Only
    compiled code can call a kernel, because an interface to Python takes long to compile.
    ``inline="always"`` copies a function into each of its callers before types are found, so it is
    for a few lines; ``forceinline`` leaves larger parts to LLVM.

    Args:
        options: of ``numba.njit``.
    """
    alone = {"_nrt": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return njit(cache=False, error_model="numpy", **alone, **options)


@kernel()
def smallest(values: NDArray, count: int, rank: int) -> Any:
    """Return the value of a rank, from 0, among the first ones, which it reorders.

    Numba takes some seconds to compile ``np.sort`` or ``np.median``, and ten for ``np.partition``.
    Source: Hoare (1961), Algorithm 65: find.
    """
    low, high = 0, count - 1
    while low < high:
        pivot, i, j = values[(low + high) // 2], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    return values[rank]
