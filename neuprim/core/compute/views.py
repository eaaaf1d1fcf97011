"""Things that numba has no word for: an array that is lent, and sixteen floats at once."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core.imputils import impl_ret_borrowed
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

__all__ = ["copy16", "lent", "returned"]


def _lent(context, array):  # type: ignore[no-untyped-def]
    """The same array without its owner: views of it count no references.

    Counting is atomic: it costs a pair of a few lanes as much as a vector of arithmetic, and threads that count views of one array wait for
    each other. Only for arrays that somebody else keeps, such as the arguments of a kernel; a kernel's own are given back by :func:`returned`
    after the last use of what was lent.
    """

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        view = make_array(signature.return_type)(context, builder, value=arguments[0])
        view.meminfo = context.get_constant_null(types.MemInfoPointer(types.voidptr))
        return impl_ret_borrowed(context, builder, signature.return_type, view._getvalue())

    return array(array), code


def _copy16(context, target, at, source, first):  # type: ignore[no-untyped-def]
    """target[at : at + 16] = source[first : first + 16] of contiguous float32 arrays, read whole before it is written.

    LLVM cannot know that two arrays do not overlap, and copies one float after the other.
    """

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        vector = ir.VectorType(ir.FloatType(), 16).as_pointer()

        def place(array, index):  # type: ignore[no-untyped-def]
            data = make_array(signature.args[array])(context, builder, value=arguments[array]).data
            return builder.bitcast(builder.gep(data, [arguments[index]]), vector)

        builder.store(builder.load(place(2, 3), align=4), place(0, 1), align=4)
        return context.get_dummy_value()

    return types.void(target, types.intp, source, types.intp), code


def _returned(context, array):  # type: ignore[no-untyped-def]
    """Does nothing, after the last use of what an array of the kernel's own lent: numba lets go of it behind the last line that names it."""

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return context.get_dummy_value()

    return types.void(array), code


lent: Any = intrinsic(_lent)
returned: Any = intrinsic(_returned)
copy16: Any = intrinsic(_copy16)
