# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Numbers of arrays in one instruction each, for the loops over hits.

An index of Warp's may be negative and its strides are read from the launch, in 64 bits: nine instructions for a row's
span, of which two are needed. Here indices are whole numbers from zero, and arrays are contiguous, as
:func:`neuprim.core.compute.warp.array` asserts.
"""

# annotations are values here: Warp reads them
from neuprim.core.compute.warp import wp
from neuprim.core.render.cuda.layout import TILE

__all__ = ["column_of", "element", "hit_at", "leave_hit", "number", "span_of", "whole"]


@wp.func_native("return numbers.data[at];")
def number(numbers: wp.array(dtype=wp.float32), at: int) -> float: ...


@wp.func_native("return numbers.data[at];")
def whole(numbers: wp.array(dtype=wp.int32), at: int) -> int: ...


@wp.func_native("return numbers.data[size_t(row) * size_t(width) + column];")
def element(numbers: wp.array(dtype=wp.float32), row: int, width: int, column: int) -> float:
    """Of rows of ``width`` numbers."""


@wp.func_native(f"return spans.data[size_t(pair) * {TILE} + y];")
def span_of(spans: wp.array2d(dtype=wp.uint16), pair: int, y: int) -> int:
    """Of a pair's row of pixels (:mod:`~neuprim.core.render.cuda.spans`)."""


@wp.func_native("return rows.data[size_t(row) * size_t(width) + column];")
def column_of(rows: wp.array2d(dtype=wp.vec4), row: int, width: int, column: int) -> wp.vec4:
    """Of primitives' rows of ``width`` columns."""


@wp.func_native("return hits.data[slot];")
def hit_at(hits: wp.array(dtype=wp.vec2), slot: int) -> wp.vec2: ...


@wp.func_native("hits.data[slot] = hit;")
def leave_hit(hits: wp.array(dtype=wp.vec2), slot: int, hit: wp.vec2): ...
