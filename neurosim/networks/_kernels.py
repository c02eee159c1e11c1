"""The compiled inner loop of population_error."""

from __future__ import annotations

import numpy as np

from neurosim.base.compiled import njit

#: Number of rows per pass, whose outputs stay in the first-level cache.
_ROWS = 256

_f = np.float32
_njit = njit(fastmath={"contract", "reassoc", "nsz", "arcp"}, error_model="numpy")


@njit(cache=False, fastmath={"contract", "nsz"}, inline="always")
def _exp2(z):
    """Return 2 to the power of z, |z| < 126, to about 1e-7 relative.

    Plain arithmetic becomes vector instructions; a call to the library's exponential computes one
    number at a time. The polynomial is 2^f for |f| <= 1/2 (Taylor's series
    of exp(f ln 2), sixth order), the integer part goes into the exponent's bits.
    """
    whole = np.floor(z + _f(0.5))
    f = z - whole
    p = _f(1.5403530e-4)
    p = p * f + _f(1.3333558e-3)
    p = p * f + _f(9.6181291e-3)
    p = p * f + _f(5.5504109e-2)
    p = p * f + _f(2.4022651e-1)
    p = p * f + _f(6.9314718e-1)
    p = p * f + _f(1.0)
    bits = (np.int32(whole) + np.int32(127)) << np.int32(23)
    return p * np.int32(bits).view(np.float32)


@_njit
def _add_unit(out, weight, exponents, log2, start, rows, limit):
    """Add weight times a product unit's magnitude to out, for some rows."""
    if exponents.shape[0] == 5:
        # Without intermediate values in memory; five inputs are the usual case.
        w0, w1, w2, w3, w4 = exponents[0], exponents[1], exponents[2], exponents[3], exponents[4]
        c0, c1 = log2[0, start : start + rows], log2[1, start : start + rows]
        c2, c3 = log2[2, start : start + rows], log2[3, start : start + rows]
        c4 = log2[4, start : start + rows]
        for j in range(rows):
            total = w0 * c0[j] + w1 * c1[j] + w2 * c2[j] + w3 * c3[j] + w4 * c4[j]
            out[j] += weight * _exp2(min(max(total, -limit), limit))
        return
    z = np.zeros(_ROWS, np.float32)
    for i in range(exponents.shape[0]):
        w = exponents[i]
        column = log2[i, start : start + rows]
        for j in range(rows):
            z[j] += w * column[j]
    for j in range(rows):
        out[j] += weight * _exp2(min(max(z[j], -limit), limit))


@njit(fastmath={"contract", "reassoc", "nsz", "arcp"}, error_model="numpy", nogil=True)
def squared_error(
    exponents, signed, weights, bias, log2, x, targets, spans, limit, first, last, sums
):
    """Sum the squared errors of some networks.

    Args:
        exponents: of product units, [O, P, K, I]; all arrays are single precision.
        signed: weight of each product unit times its cosine, by sign pattern, [O, P, M, K].
        weights, bias: the summation units' linear map, [O, P, I] and [O, P].
        log2: base-2 logarithms of the inputs' magnitudes, [I, N].
        x: inputs, [I, N].
        targets: [O, N].
        spans: first row and end of each sign pattern, [M, 2].
        limit: bound of a product unit's base-2 logarithm.
        first, last: the networks, counted through all outputs, from the first to before the last.
        sums: [O, P] float64, written.
    """
    _, population, units, inputs = exponents.shape
    for network in range(first, last):
        g, p = network // population, network % population
        out = np.empty(_ROWS, np.float32)
        total = 0.0
        for pattern in range(spans.shape[0]):
            for start in range(spans[pattern, 0], spans[pattern, 1], _ROWS):
                rows = min(_ROWS, spans[pattern, 1] - start)
                target = targets[g, start : start + rows]
                for j in range(rows):
                    out[j] = bias[g, p] - target[j]
                for i in range(inputs):
                    w = weights[g, p, i]
                    column = x[i, start : start + rows]
                    for j in range(rows):
                        out[j] += w * column[j]
                for k in range(units):
                    weight = signed[g, p, pattern, k]
                    _add_unit(out, weight, exponents[g, p, k], log2, start, rows, limit)
                block = _f(0.0)
                for j in range(rows):
                    block += out[j] * out[j]
                total += block
        sums[g, p] = total
