"""Eight numbers as one value inside compiled code.

Numba's loops over a short last axis stay scalar. The functions below are one LLVM vector
instruction each, whatever the processor's own width: ``load(x, a)`` is row ``a`` of a C-ordered
float32 or float64 array of shape (n, 8), ``store(x, a, v)`` writes it, ``splat(s)`` fills all
lanes, ``madd(s, v, w)`` is ``s v + w`` with a scalar s, ``vmadd(u, v, w)`` is ``u v + w`` lane by
lane, ``vadd(u, v)`` is ``u + v``; ``widen(v)`` and ``narrow(v)`` turn single into double precision
and back.

``at(x, k)`` is element k of a C-ordered array of any shape, ``put(x, k, s)`` writes it, ``span``
and ``put_span`` do the same with the eight from k on: unlike ``x[k]``, which counts from the end
where k is negative, they do not look at k.

All work in compiled code only; ``tests/test_simd.py`` holds them against numpy.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, register_model
from numpy.typing import NDArray

LANES = 8
_LINE = 64
"""Bytes of a cache line."""

_INT = ir.IntType(32)
_FLAGS = ("contract", "nsz", "reassoc")


class _VectorType(types.Type):
    def __init__(self, element: Any) -> None:
        super().__init__(name=f"{element}x{LANES}")
        self.element = element


_SINGLE, _DOUBLE = _VectorType(types.float32), _VectorType(types.float64)
_CODE = {
    types.float32: ir.VectorType(ir.FloatType(), LANES),
    types.float64: ir.VectorType(ir.DoubleType(), LANES),
}


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _CODE[kind.element])


def _of(element: Any) -> Any:
    """The vector of elements of a type."""
    return _DOUBLE if element == types.float64 else _SINGLE


def _place(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [index])


def _from(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    place = _place(context, builder, array_type, array, index)
    return builder.bitcast(place, _CODE[array_type.dtype].as_pointer())


def _row(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    offset = builder.mul(index, ir.Constant(index.type, LANES))
    return _from(context, builder, array_type, array, offset)


def _fill(builder: Any, scalar: Any) -> Any:
    blank = ir.Constant(ir.VectorType(scalar.type, LANES), ir.Undefined)
    first = builder.insert_element(blank, scalar, ir.Constant(_INT, 0))
    zeros = ir.Constant(ir.VectorType(_INT, LANES), [0] * LANES)
    return builder.shuffle_vector(first, blank, zeros)


def _multiply_add(builder: Any, a: Any, b: Any, c: Any) -> Any:
    return builder.fadd(builder.fmul(a, b, flags=_FLAGS), c, flags=_FLAGS)


def _read(place: Any) -> Any:
    """How to read what stands at a place in an array."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = builder.load(place(context, builder, signature.args[0], *args))
        value.align = signature.args[0].dtype.bitwidth // 8
        return value

    return code


def _write(place: Any) -> Any:
    """How to write to a place in an array."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        where = place(context, builder, signature.args[0], args[0], args[1])
        builder.store(args[2], where).align = signature.args[0].dtype.bitwidth // 8
        return context.get_dummy_value()

    return code


@intrinsic
def load(typing: Any, array: Any, index: Any) -> Any:
    """Row ``index`` of an array of shape (n, 8)."""
    return _of(array.dtype)(array, types.intp), _read(_row)


@intrinsic
def store(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write row ``index`` of an array of shape (n, 8)."""
    return types.void(array, types.intp, _of(array.dtype)), _write(_row)


@intrinsic
def at(typing: Any, array: Any, index: Any) -> Any:
    """Element ``index`` of an array as it lies in memory."""
    return array.dtype(array, types.intp), _read(_place)


@intrinsic
def put(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write element ``index`` of an array as it lies in memory."""
    return types.void(array, types.intp, array.dtype), _write(_place)


@intrinsic
def span(typing: Any, array: Any, index: Any) -> Any:
    """Eight elements from ``index`` on, as they lie in memory."""
    return _of(array.dtype)(array, types.intp), _read(_from)


@intrinsic
def put_span(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write eight elements from ``index`` on, as they lie in memory."""
    return types.void(array, types.intp, _of(array.dtype)), _write(_from)


@intrinsic
def splat(typing: Any, scalar: Any) -> Any:
    """A number in all lanes."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _fill(builder, args[0])

    return _of(scalar)(scalar), code


@intrinsic
def vadd(typing: Any, left: Any, right: Any) -> Any:
    """``left + right``, lane by lane."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fadd(*args, flags=_FLAGS)

    return left(left, left), code


@intrinsic
def madd(typing: Any, scalar: Any, value: Any, addend: Any) -> Any:
    """``scalar * value + addend`` with a scalar in the precision of the vectors."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _multiply_add(builder, _fill(builder, args[0]), args[1], args[2])

    return value(value.element, value, value), code


@intrinsic
def vmadd(typing: Any, left: Any, right: Any, addend: Any) -> Any:
    """``left * right + addend``, lane by lane."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _multiply_add(builder, *args)

    return left(left, left, left), code


@intrinsic
def widen(typing: Any, value: Any) -> Any:
    """Single precision as double."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fpext(args[0], _CODE[types.float64])

    return _DOUBLE(_SINGLE), code


@intrinsic
def narrow(typing: Any, value: Any) -> Any:
    """Double precision rounded to single."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fptrunc(args[0], _CODE[types.float32])

    return _SINGLE(_DOUBLE), code


def aligned_zeros(shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
    """Zeros that begin on a cache line, so that a row of eight lies on one or two whole ones."""
    kind = np.dtype(dtype)
    size = math.prod(shape) * kind.itemsize
    raw = np.zeros(size + _LINE, np.uint8)
    first = -raw.ctypes.data % _LINE
    return raw[first : first + size].view(kind).reshape(shape)
