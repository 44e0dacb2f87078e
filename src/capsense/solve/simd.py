"""Eight single-precision numbers as one value inside compiled code.

Numba's loops over a short last axis stay scalar. The functions below are one LLVM vector
instruction each, whatever the processor's own width: ``load(x, a)`` is row ``a`` of a C-ordered
float32 array of shape (n, 8), ``store(x, a, v)`` writes it, ``splat(s)`` fills all lanes,
``madd(s, v, w)`` is ``s v + w`` with a scalar s, and ``vmadd(u, v, w)`` is ``u v + w`` lane by
lane. They work in compiled code only; ``tests/solve/test_simd.py`` holds them against numpy.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, register_model

LANES = 8

_VECTOR = ir.VectorType(ir.FloatType(), LANES)
_INT = ir.IntType(32)
_FLAGS = ("contract", "nsz", "reassoc")
_ALIGN = 4


class _VectorType(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"float32x{LANES}")


vector = _VectorType()


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


def _row(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    offset = builder.mul(index, ir.Constant(index.type, LANES))
    return builder.bitcast(builder.gep(data, [offset]), _VECTOR.as_pointer())


def _fill(builder: Any, scalar: Any) -> Any:
    blank = ir.Constant(_VECTOR, ir.Undefined)
    first = builder.insert_element(blank, scalar, ir.Constant(_INT, 0))
    zeros = ir.Constant(ir.VectorType(_INT, LANES), [0] * LANES)
    return builder.shuffle_vector(first, blank, zeros)


def _multiply_add(builder: Any, a: Any, b: Any, c: Any) -> Any:
    return builder.fadd(builder.fmul(a, b, flags=_FLAGS), c, flags=_FLAGS)


@intrinsic
def load(typing: Any, array: Any, index: Any) -> Any:
    """Row ``index`` of a float32 array of shape (n, 8)."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = builder.load(_row(context, builder, signature.args[0], *args))
        value.align = _ALIGN
        return value

    return vector(array, types.intp), code


@intrinsic
def store(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write row ``index`` of a float32 array of shape (n, 8)."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = _row(context, builder, signature.args[0], args[0], args[1])
        builder.store(args[2], place).align = _ALIGN
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), code


@intrinsic
def splat(typing: Any, scalar: Any) -> Any:
    """A float32 in all lanes."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _fill(builder, args[0])

    return vector(types.float32), code


@intrinsic
def madd(typing: Any, scalar: Any, value: Any, addend: Any) -> Any:
    """``scalar * value + addend`` with a float32 scalar."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _multiply_add(builder, _fill(builder, args[0]), args[1], args[2])

    return vector(types.float32, vector, vector), code


@intrinsic
def vmadd(typing: Any, left: Any, right: Any, addend: Any) -> Any:
    """``left * right + addend``, lane by lane."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _multiply_add(builder, *args)

    return vector(vector, vector, vector), code
