# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Native functions of the kernels: operations across a block of threads, and fast loads of array elements.

Every thread of a block must call a block operation. On the CPU, a static buffer replaces the hardware operation. Warp's
own indexing allows negative indices and 64-bit strides, so that loading a span takes nine instructions. In loops over
hits, indices are not negative and arrays are contiguous (:func:`neuprim.core.compute.warp.array`), so that the loads
of this module take two instructions.
"""

# annotations must be values, not text: Warp reads them, and cannot look up the local names of a function
import functools
from collections.abc import Callable
from typing import Any

from neuprim.core.compute.warp import Floats, Ints, Shorts2d, Vec2s, Vec4s2d, wp
from neuprim.core.render.cuda.layout import TILE, WARP

_ANY = """
#if defined(__CUDA_ARCH__)
    return __syncthreads_or(yes);
#else
    static int answer;
    WP_TILE_SYNC();
    answer = 0;
    WP_TILE_SYNC();
    if (yes) answer = 1;
    WP_TILE_SYNC();
    return answer;
#endif
"""


@wp.func_native(_ANY)
def any_tile_thread(yes: int) -> int:
    """Return 1 if ``yes`` is not 0 in any thread of the block, else 0."""


def _halving_sums(width: int) -> str:
    """Return native code that sums ``width`` values over a warp: 31 shuffles per 32 values instead of 160.

    In each step, a lane (thread) keeps half of its values and adds the same half of a partner lane. With m = width/32,
    lane l ends with the sums l m to l m + m - 1. Loops have constant bounds, so that the compiler unrolls them.
    """
    steps = ""
    for bit in (16, 8, 4, 2, 1):
        half = width * bit // WARP
        steps += f"""
    #pragma unroll
    for (int i = 0; i < {half}; ++i) {{
        const float low = x[i], high = x[i + {half}];
        x[i] = (own & {bit} ? high : low) + __shfl_xor_sync(0xffffffffu, own & {bit} ? low : high, {bit});
    }}"""
    each = width // WARP
    return f"""
#if defined(__CUDA_ARCH__)
    const int own = threadIdx.x;
{steps}
    #pragma unroll
    for (int i = 0; i < {each}; ++i) out.data[size_t(pair) * {width} + {each} * own + i] = x[i];
#else
    static float every[{WARP}][{width}];
    for (int c = 0; c < {width}; ++c) every[lane][c] = x[c];
    WP_TILE_SYNC();
    float a[{WARP}];
    for (int c = {each} * lane; c < {each} * lane + {each}; ++c) {{
        for (int l = 0; l < {WARP}; ++l) a[l] = every[l][c];
        for (int bit = {WARP // 2}; bit > 0; bit >>= 1)
            for (int l = 0; l < bit; ++l) a[l] += a[l + bit];
        out.data[size_t(pair) * {width} + c] = a[0];
    }}
    WP_TILE_SYNC();
#endif
"""


@functools.cache
def gradient_row_type(width: int) -> Any:
    """Return the Warp type of a gradient row of ``width`` floats: the gradients of one (tile, primitive) pair."""
    return wp.types.vector(length=width, dtype=wp.float32)


@functools.cache
def gradient_row_sums(width: int) -> Callable[..., Any]:
    """Return a function (x, lane, out, pair) that sums the rows ``x`` of a warp's threads into row ``pair`` of ``out``.

    ``lane`` is the thread's number in the warp. ``width``, the length of a row, is a multiple of 32.
    """
    row = gradient_row_type(width)

    @wp.func_native(_halving_sums(width))
    def sums(x: row, lane: int, out: Floats, pair: int): ...

    return sums


@wp.func_native("return numbers.data[at];")
def pixel_float_at(numbers: Floats, at: int) -> float: ...


@wp.func_native("return numbers.data[at];")
def int_at(numbers: Ints, at: int) -> int: ...


@wp.func_native("return numbers.data[size_t(row) * size_t(width) + column];")
def pixel_row_float(numbers: Floats, row: int, width: int, column: int) -> float:
    """Return element (row, column) of an array whose rows have ``width`` elements."""


@wp.func_native(f"return spans.data[size_t(pair) * {TILE} + y];")
def span_of(spans: Shorts2d, pair: int, y: int) -> int:
    """Return the packed span of covered pixels in tile row ``y`` of a pair; see :func:`~.chord.slot_of_pixel`."""


@wp.func_native("return rows.data[size_t(row) * size_t(width) + column];")
def load_rasterizer_row_column(rows: Vec4s2d, row: int, width: int, column: int) -> wp.vec4:
    """Return float4 column ``column`` of a primitive's row; rows have ``width`` columns."""


@wp.func_native("return hits.data[slot];")
def pixel_hit_at(hits: Vec2s, slot: int) -> wp.vec2: ...


@wp.func_native("hits.data[slot] = hit;")
def set_pixel_hit(hits: Vec2s, slot: int, hit: wp.vec2): ...
