"""Eight or sixteen numbers as one value inside compiled code.

The functions below are one or a few LLVM instructions each, whatever the processor's own width:
``splat(s)`` fills all elements, ``vadd(u, v)`` is ``u + v``, ``vsub(u, v)`` is ``u - v``,
``vmul(u, v)`` is ``u v``, ``vmadd(u, v, w)`` is ``u v + w`` and ``dot(x, y, z, u, v, w, a)`` is
``x u + y v + z w + a``, element by element; ``madd(s, v, w)`` is ``s v + w`` with a scalar s,
``horizontal_sum(v)`` adds the elements, ``where_above(u, v, x, y)`` is x where u > v, else y, and
``muladd(a, b, c)`` is ``a b + c`` of scalars. ``vdiv(u, v)`` is ``u / v`` and ``vlog(u)`` the
natural logarithm in single precision.

``at(x, k)`` is element k of a C-ordered array of any shape, ``span`` is the eight from k on, and
``put_span`` writes them: unlike ``x[k]``, which counts from the end where k is negative, they do
not look at k. ``wide_span`` and ``wide_splat`` make values of sixteen, for kernels that most of the
time goes to: a processor with AVX-512 takes these at once, and others half by half.

Products are fused with the sum that follows wherever the processor can, and sums are taken in the
order that is written: bits do not depend on what else is compiled.

All work in compiled code only; ``tests/unit/test_simd.py`` holds them against numpy.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.cgutils import get_or_insert_function
from numba.extending import intrinsic, models, register_model

SIMD_WIDTH = 8
WIDE = 16
"""Numbers in a value of :func:`wide_span`."""

_INT = ir.IntType(32)
_CODE = {types.float32: ir.FloatType(), types.float64: ir.DoubleType()}


class _VectorType(types.Type):
    def __init__(self, element: Any, width: int) -> None:
        super().__init__(name=f"{element}x{width}")
        self.element, self.width = element, width


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, ir.VectorType(_CODE[kind.element], kind.width))


def _of(element: Any, width: int = SIMD_WIDTH) -> Any:
    """The vector of elements of a type."""
    return _VectorType(types.float64 if element == types.float64 else types.float32, width)


def _single(value: Any) -> bool:
    return isinstance(value, _VectorType) and value.element == types.float32


def _place(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [index])


def _from(width: int) -> Callable[..., Any]:
    """How to find so many elements of an array."""

    def code(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
        place = _place(context, builder, array_type, array, index)
        kind = ir.VectorType(_CODE[array_type.dtype], width)
        return builder.bitcast(place, kind.as_pointer())

    return code


def _fill(builder: Any, scalar: Any, width: int = SIMD_WIDTH) -> Any:
    blank = ir.Constant(ir.VectorType(scalar.type, width), ir.Undefined)
    first = builder.insert_element(blank, scalar, ir.Constant(_INT, 0))
    zeros = ir.Constant(ir.VectorType(_INT, width), [0] * width)
    return builder.shuffle_vector(first, blank, zeros)


def multiply_add(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """Emit ``a b + c`` of scalars or vectors, fused where the processor can."""
    name = {ir.FloatType(): "f32", ir.DoubleType(): "f64"}
    kind = a.type
    suffix = f"v{kind.count}{name[kind.element]}" if isinstance(kind, ir.VectorType) else name[kind]
    signature = ir.FunctionType(kind, [kind] * 3)
    code = get_or_insert_function(builder.module, signature, f"llvm.fmuladd.{suffix}")
    return builder.call(code, [a, b, c])


def _read(place: Any) -> Any:
    """How to read what stands at a place in an array."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = builder.load(place(context, builder, signature.args[0], *args))
        value.align = signature.args[0].dtype.bitwidth // 8
        return value

    return code


def _emit(code: Callable[..., Any]) -> Callable[..., Any]:
    """What an intrinsic is made of, from a function of the builder and the values."""
    return lambda context, builder, signature, args: code(builder, *args)


@intrinsic
def at(typing: Any, array: Any, index: Any) -> Any:
    """Element ``index`` of an array as it lies in memory."""
    return array.dtype(array, types.intp), _read(_place)


@intrinsic
def span(typing: Any, array: Any, index: Any) -> Any:
    """Eight elements from ``index`` on, as they lie in memory."""
    return _of(array.dtype)(array, types.intp), _read(_from(SIMD_WIDTH))


@intrinsic
def wide_span(typing: Any, array: Any, index: Any) -> Any:
    """Sixteen elements from ``index`` on, as they lie in memory."""
    return _of(array.dtype, WIDE)(array, types.intp), _read(_from(WIDE))


@intrinsic
def put_span(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write the elements of a value from ``index`` on, as they lie in memory."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        where = _from(args[2].type.count)(context, builder, signature.args[0], args[0], args[1])
        builder.store(args[2], where).align = signature.args[0].dtype.bitwidth // 8
        return context.get_dummy_value()

    return types.void(array, types.intp, value), code


@intrinsic
def splat(typing: Any, scalar: Any) -> Any:
    """A number in all of eight elements."""
    return _of(scalar)(scalar), _emit(_fill)


@intrinsic
def wide_splat(typing: Any, scalar: Any) -> Any:
    """A number in all of sixteen elements."""
    return _of(scalar, WIDE)(scalar), _emit(lambda builder, number: _fill(builder, number, WIDE))


@intrinsic
def vadd(typing: Any, left: Any, right: Any) -> Any:
    """``left + right``, element by element."""
    return left(left, left), _emit(lambda builder, *values: builder.fadd(*values))


@intrinsic
def vsub(typing: Any, left: Any, right: Any) -> Any:
    """``left - right``, element by element."""
    return left(left, left), _emit(lambda builder, *values: builder.fsub(*values))


@intrinsic
def vmul(typing: Any, left: Any, right: Any) -> Any:
    """``left * right``, element by element."""
    return left(left, left), _emit(lambda builder, *values: builder.fmul(*values))


@intrinsic
def vdiv(typing: Any, left: Any, right: Any) -> Any:
    """``left / right``, element by element."""
    return left(left, left), _emit(lambda builder, *values: builder.fdiv(*values))


@intrinsic
def madd(typing: Any, scalar: Any, value: Any, addend: Any) -> Any:
    """``scalar * value + addend`` with a scalar in the precision of the vectors."""

    def code(builder: Any, s: Any, v: Any, w: Any) -> Any:
        return multiply_add(builder, _fill(builder, s, v.type.count), v, w)

    return value(value.element, value, value), _emit(code)


@intrinsic
def vmadd(typing: Any, left: Any, right: Any, addend: Any) -> Any:
    """``left * right + addend``, element by element."""
    return left(left, left, left), _emit(multiply_add)


@intrinsic
def dot(typing: Any, x: Any, y: Any, z: Any, u: Any, v: Any, w: Any, addend: Any) -> Any:
    """``x u + y v + z w + addend``, element by element."""

    def code(builder: Any, x: Any, y: Any, z: Any, u: Any, v: Any, w: Any, addend: Any) -> Any:
        for left, right in ((z, w), (y, v), (x, u)):
            addend = multiply_add(builder, left, right, addend)
        return addend

    return x(x, x, x, x, x, x, x), _emit(code)


@intrinsic
def where_above(typing: Any, left: Any, right: Any, over: Any, other: Any) -> Any:
    """``over`` where ``left`` is above ``right``, else ``other``, element by element."""

    def code(builder: Any, u: Any, v: Any, x: Any, y: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", u, v), x, y)

    return left(left, left, left, left), _emit(code)


@intrinsic
def horizontal_sum(typing: Any, value: Any) -> Any:
    """The sum of all elements."""

    def code(builder: Any, parts: Any) -> Any:
        width = parts.type.count
        while width > 1:
            width //= 2
            blank = ir.Constant(parts.type, ir.Undefined)
            low, high = (
                builder.shuffle_vector(parts, blank, _lanes(list(range(k, k + width))))
                for k in (0, width)
            )
            parts = builder.fadd(low, high)
        return builder.extract_element(parts, ir.Constant(_INT, 0))

    return value.element(value), _emit(code)


@intrinsic
def muladd(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """``a * b + c`` of three floats of one precision."""
    if not a == b == c or a not in _CODE:
        return None
    return a(a, a, a), _emit(multiply_add)


@intrinsic
def rsqrt(typing: Any, value: Any) -> Any:
    """``1 / sqrt(value)`` in single precision, to 3e-7, for one or more normal numbers above zero.

    A first guess, and Newton's steps. For vectors a processor with AVX has a guess to 4e-4, one
    with AVX-512 a better one of sixteen, which leaves one step. Elsewhere the bits of a float are
    nearly its logarithm, which makes a guess that leaves three.
    """
    if value != types.float32 and not _single(value):
        return None

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        (number,), kind = args, args[0].type
        vector = isinstance(kind, ir.VectorType)

        def each(element: Any, same: float) -> Any:
            if not vector:
                return ir.Constant(element, same)
            return ir.Constant(ir.VectorType(element, kind.count), [same] * kind.count)

        target = context.codegen().magic_tuple()
        if vector and has_guess(target):
            y, steps = _guess(builder, number, "+avx512f" in target[2].split(",")), 1
        else:
            bits = each(_INT, 1).type
            half = builder.lshr(builder.bitcast(number, bits), each(_INT, 1))
            y, steps = builder.bitcast(builder.sub(each(_INT, 0x5F375A86), half), kind), 3
        x = builder.fmul(number, each(ir.FloatType(), -0.5))
        for _ in range(steps):
            step = multiply_add(builder, x, builder.fmul(y, y), each(ir.FloatType(), 1.5))
            y = builder.fmul(y, step)
        return y

    return value(value), code


def _guess(builder: Any, number: Any, wide: bool) -> Any:
    """The processor's guess of 1 / sqrt(x) for eight or sixteen numbers, these at once or not."""
    kind = number.type
    if kind.count == WIDE and wide:
        mask = ir.IntType(WIDE)
        signature = ir.FunctionType(kind, [kind, kind, mask])
        name = "llvm.x86.avx512.rsqrt14.ps.512"
        code = get_or_insert_function(builder.module, signature, name)
        return builder.call(code, [number, ir.Constant(kind, ir.Undefined), ir.Constant(mask, -1)])
    if kind.count == WIDE:
        blank, parts = ir.Constant(kind, ir.Undefined), []
        for first in (0, SIMD_WIDTH):
            lanes = list(range(first, first + SIMD_WIDTH))
            half = builder.shuffle_vector(number, blank, _lanes(lanes))
            parts.append(_guess(builder, half, wide))
        return builder.shuffle_vector(*parts, _lanes(list(range(WIDE))))
    code = get_or_insert_function(
        builder.module, ir.FunctionType(kind, [kind]), "llvm.x86.avx.rsqrt.ps.256"
    )
    return builder.call(code, [number])


def _lanes(numbers: list[int]) -> Any:
    """Which elements a shuffle takes."""
    return ir.Constant(ir.VectorType(_INT, len(numbers)), numbers)


_ROOT_HALF = 0x3F3504F3
"""Bits of √½ in single precision."""
_LOG = (
    0.070376836292, -0.11514610310, 0.11676998740, -0.12420140846, 0.14249322787,
    -0.16668057665, 0.20000714765, -0.24999993993, 0.33333331174,
)  # fmt: skip
"""Of (log(1 + x) - x + x²/2) / x³ between √½ - 1 and √2 - 1; S. Moshier, Cephes (1989), logf."""
_LOG_TWO = 0.693359375, -2.12194440e-4


@intrinsic
def vlog(typing: Any, value: Any) -> Any:
    """Natural logarithm of normal numbers above zero, to 1e-7 or 1e-7 of it."""
    if not _single(value):
        return None

    def code(builder: Any, number: Any) -> Any:
        whole = ir.VectorType(_INT, number.type.count)

        def each(same: float, kind: Any = number.type) -> Any:
            return ir.Constant(kind, [same] * kind.count)

        bits = builder.bitcast(number, whole)
        power = builder.ashr(builder.sub(bits, each(_ROOT_HALF, whole)), each(23, whole))
        bits = builder.sub(bits, builder.shl(power, each(23, whole)))
        x = builder.fsub(builder.bitcast(bits, number.type), each(1.0))
        exponent = builder.sitofp(power, number.type)
        square, y = builder.fmul(x, x), each(_LOG[0])
        for factor in _LOG[1:]:
            y = multiply_add(builder, y, x, each(factor))
        y = builder.fmul(y, builder.fmul(x, square))
        y = multiply_add(builder, exponent, each(_LOG_TWO[1]), y)
        y = multiply_add(builder, square, each(-0.5), y)
        return multiply_add(builder, exponent, each(_LOG_TWO[0]), builder.fadd(x, y))

    return value(value), _emit(code)


def has_guess(target: tuple[str, str, str]) -> bool:
    """Whether a target (triple, processor, features) has AVX's guess of 1 / sqrt(x)."""
    triple, _, features = target
    return triple.startswith("x86_64") and "+avx" in features.split(",")


def _pointer(kind: Any) -> Any:
    @intrinsic
    def pointer(typing: Any, address: Any) -> Any:
        """A pointer to the numbers that stand at an address."""

        def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.inttoptr(args[0], context.get_value_type(signature.return_type))

        return types.CPointer(kind)(types.intp), code

    return pointer


singles, doubles, integers = _pointer(types.float32), _pointer(types.float64), _pointer(types.int64)
