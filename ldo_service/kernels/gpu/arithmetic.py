"""Arithmetic with bitwise equal results in the interpreter of Triton and on each GPU.

All kernels use only sums, products, correctly rounded divisions and roots, comparisons and integer
operations. `PINNED` stops the compiler from fusing products with sums. Approximate instructions
differ between generations of GPUs; `tests/kernels/gpu/cubins.py` rejects them.
"""

from functools import partial
from typing import Any

import triton
import triton.language as tl

# Integer arguments of kernels. Triton would compile another variant of a kernel for sizes of 1
# and for multiples of 16, even in the middle of a run, because the number of pairs always
# changes.
SIZES = (
    *("n", "n_pairs", "n_visible", "n_programs"),
    *("width", "height", "columns", "side", "across", "down"),
)
kernel: Any = partial(triton.jit, do_not_specialize=SIZES)  # Decorator of launched functions.

PINNED = {"enable_fp_fusion": False}  # Option of each launch and each compilation.

LOG2_E = tl.constexpr(1.44269504)  # The constants equal those of `kernels/projection.hpp`.
LN_2 = tl.constexpr(0.6931471805599453)


@triton.jit
def exp2(x):
    """Return 2^x for x in [-126, 126], with a relative error below 2.5e-7.

    Adding 1.5 * 2^23 to x rounds x to an integer, which the low bits of the sum contain. A
    polynomial approximates 2^f for the remaining fraction f in [-1/2, 1/2]. `kernels/simd.hpp`
    contains the same operations.
    """
    shifted = x + 12582912.0
    f = x - (shifted - 12582912.0)
    p = f * 1.326472725e-03 + 9.671512688e-03
    p = p * f + 5.550733744e-02
    p = p * f + 2.402224208e-01
    p = p * f + 6.931469776e-01
    p = p * f + 1.0
    exponent = shifted.to(tl.int32, bitcast=True) << 23
    return (p.to(tl.int32, bitcast=True) + exponent).to(tl.float32, bitcast=True)


@triton.jit
def log2(x):
    """Return log2 of a normal float32 x > 0, with an absolute error below 1e-6.

    The result is the exponent of x plus log2(m) of its mantissa m in [sqrt(1/2), sqrt(2)). A
    polynomial in s = (m - 1) / (m + 1) approximates log2(m), because ln(m) = 2 atanh(s).
    """
    bits = x.to(tl.int32, bitcast=True)
    e = (bits - 0x3F3504F3) >> 23
    m = (bits - (e << 23)).to(tl.float32, bitcast=True)
    s = tl.div_rn(m - 1.0, m + 1.0)
    square = s * s
    p = square * 0.41219858 + 0.57707801
    p = p * square + 0.96179669
    p = p * square + 2.88539008
    return e.to(tl.float32) + p * s


@triton.jit
def exp(x):
    return exp2(clamp(x * LOG2_E, -126.0, 126.0))


@triton.jit
def log(x):
    return log2(x) * LN_2


@triton.jit
def clamp(x, low, high):
    return tl.minimum(tl.maximum(x, low), high)


@triton.jit
def sign(x):
    return tl.where(x < 0.0, -1.0, tl.where(x > 0.0, 1.0, 0.0))


@triton.jit
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
def cross(a, b):
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@triton.jit
def add_scaled(a, b, s):
    """Return the vector a + s b."""
    return a[0] + b[0] * s, a[1] + b[1] * s, a[2] + b[2] * s
