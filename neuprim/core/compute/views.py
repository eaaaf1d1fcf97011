"""numba intrinsics: a borrowed array, copies of sixteen floats, and compression of sixteen by flags."""

from __future__ import annotations

from typing import Any

from llvmlite import binding, ir
from numba import types
from numba.core.imputils import impl_ret_borrowed
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

_COMPRESSES = 19 <= binding.llvm_version_info[0] <= 22
"""Whether LLVM moves the chosen elements of a vector together by one instruction; it is called experimental, and other
versions are not asked."""

_SIXTEEN = ir.VectorType(ir.FloatType(), 16)


def _lent(context, array):  # type: ignore[no-untyped-def]
    """The same array without its owner: views of it count no references, which is atomic and slow.

    Only for arrays that somebody else keeps; a kernel's own are given back by :func:`release_array` after the last use.
    """

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        view = make_array(signature.return_type)(context, builder, value=arguments[0])
        view.meminfo = context.get_constant_null(types.MemInfoPointer(types.voidptr))
        return impl_ret_borrowed(context, builder, signature.return_type, view._getvalue())

    return array(array), code


def _place(context, builder, signature, arguments, array, index):  # type: ignore[no-untyped-def]
    """Where the sixteen floats of an argument begin."""
    data = make_array(signature.args[array])(context, builder, value=arguments[array]).data
    return builder.bitcast(builder.gep(data, [arguments[index]]), _SIXTEEN.as_pointer())


def _copy16(context, target, at, source, first):  # type: ignore[no-untyped-def]
    """target[at : at + 16] = source[first : first + 16] of float32 arrays, which LLVM would copy one by one."""

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        read, written = (_place(context, builder, signature, arguments, *where) for where in ((2, 3), (0, 1)))
        builder.store(builder.load(read, align=4), written, align=4)
        return context.get_dummy_value()

    return types.void(target, types.intp, source, types.intp), code


def _keep16(context, array, at, first, flags):  # type: ignore[no-untyped-def]
    """Move those of array[first : first + 16] whose flag is not 0 to array[at:], zeros behind them; returns how many.

    All sixteen are read before any is written: ``at`` may be at most ``first`` where more is to be read.
    """

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        zeros, i32, i64 = ir.Constant(_SIXTEEN, [0.0] * 16), ir.IntType(32), ir.IntType(64)
        value, flag = (
            builder.load(_place(context, builder, signature, arguments, 0, index), align=4) for index in (2, 3)
        )
        kept = builder.fcmp_unordered("!=", flag, zeros)
        written = _place(context, builder, signature, arguments, 0, 1)
        count = builder.zext(builder.ctpop(builder.bitcast(kept, ir.IntType(16))), i64)
        if _COMPRESSES:
            kind = ir.FunctionType(_SIXTEEN, [_SIXTEEN, kept.type, _SIXTEEN])
            compress = builder.module.declare_intrinsic("llvm.experimental.vector.compress.v16f32", (), kind)
            builder.store(builder.call(compress, [value, kept, zeros]), written, align=4)
            return count
        builder.store(zeros, written, align=4)
        to, moved = builder.bitcast(written, ir.FloatType().as_pointer()), ir.Constant(i64, 0)
        for lane in range(16):
            chosen = builder.extract_element(kept, i32(lane))
            place = builder.gep(to, [moved])
            builder.store(builder.select(chosen, builder.extract_element(value, i32(lane)), builder.load(place)), place)
            moved = builder.add(moved, builder.zext(chosen, i64))
        return count

    return types.intp(array, types.intp, types.intp, types.intp), code


def _returned(context, array):  # type: ignore[no-untyped-def]
    """Does nothing, after the last use of what a kernel's own array lent: numba would free it earlier."""

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return context.get_dummy_value()

    return types.void(array), code


borrow_array: Any = intrinsic(_lent)
release_array: Any = intrinsic(_returned)
copy16: Any = intrinsic(_copy16)
compress16: Any = intrinsic(_keep16)
