"""Named tuples that compiled code takes by reference.

Numba hands a tuple on to another function entry by entry, and an array by seven to nine values: a
Green's function is some 250 arguments of each function that takes it. A class that is decorated by
:func:`by_reference` is unpacked once where Python calls a kernel; from there on one address is
handed on. A step takes three quarters of the time, a scene of a batch as long. The tuple is read
only: kernels cannot make one.
This stands on Numba's public interface for extensions (``numba.extending``).
"""

from __future__ import annotations

from typing import Any, TypeVar

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import impl_ret_borrowed
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    NativeValue,
    infer_getattr,
    lower_getattr_generic,
    models,
    register_model,
    typeof_impl,
    unbox,
)

_Class = TypeVar("_Class", bound=type)


class Reference(types.Type):
    """Type of a named tuple that is handed on by its address."""

    def __init__(self, inner: Any) -> None:
        self.dtype = inner
        super().__init__(name=f"reference({inner})")


def _held(inner: Any) -> Any:
    """Type of an entry: those that are named tuples are references into the outer one."""
    return Reference(inner) if isinstance(inner, types.BaseNamedTuple) else inner


register_model(Reference)(models.PointerModel)


def by_reference(cls: _Class) -> _Class:
    """Have kernels take instances of a named tuple by reference, and named tuples within it."""

    @typeof_impl.register(cls)
    def _type(value: Any, context: Any) -> Reference:
        entries = [typeof_impl(entry, context) for entry in value]
        plain = [e.dtype if isinstance(e, Reference) else e for e in entries]
        return Reference(types.BaseTuple.from_types(plain, cls))

    return cls


@unbox(Reference)
def _unbox(kind: Reference, obj: Any, c: Any) -> NativeValue:
    native = c.unbox(kind.dtype, obj)
    model = c.context.data_model_manager[kind.dtype]
    slot = cgutils.alloca_once(c.builder, model.get_data_type())
    c.context.pack_value(c.builder, kind.dtype, native.value, slot)

    def cleanup() -> None:
        if native.cleanup is not None:
            native.cleanup()
        if c.context.enable_nrt:  # what Numba itself does for types that it counts references of
            c.context.nrt.decref(c.builder, kind.dtype, native.value)

    return NativeValue(slot, is_error=native.is_error, cleanup=cleanup)


@infer_getattr
class _Entries(AttributeTemplate):
    key = Reference

    def generic_resolve(self, kind: Reference, name: str) -> Any:  # type: ignore[override]
        inner = kind.dtype
        return _held(inner[inner.fields.index(name)]) if name in inner.fields else None


@lower_getattr_generic(Reference)
def _entry(context: Any, builder: Any, kind: Reference, value: Any, name: str) -> Any:
    place = kind.dtype.fields.index(name)
    inner, zero = kind.dtype[place], ir.Constant(ir.IntType(32), 0)
    address = builder.gep(value, [zero, ir.Constant(ir.IntType(32), place)], inbounds=True)
    if isinstance(inner, types.BaseNamedTuple):
        return address
    value = context.unpack_value(builder, inner, address)
    return impl_ret_borrowed(context, builder, inner, value)
