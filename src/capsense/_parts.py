"""Kernels that others call, as Numba compiles them: no further than the others need.

Numba turns every function into machine code of its own, optimised, with a way in for Python, and
then puts what it is made of into each function that calls it, and optimises that again. Of a
kernel that only others call all but the last is of no use; it took more than a third of the time
of a first reading. What is built here is what others are made of, and nothing else.

It stands on Numba's inner interfaces (``numba.core.codegen``), beside the public way to replace a
compiler's steps (``pipeline_class``). ``tests/unit/test_jit.py`` holds results against plain Numba.
"""

from __future__ import annotations

from typing import Any

from llvmlite import binding as llvm
from numba import types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.typing import Context

_ENVIRONMENT = "_ZN08NumbaEnv"
"""How Numba names the place of a function's constants."""


class _PartLibrary(JITCodeLibrary):
    """The code of a function for those that call it; of its own it has a place of constants."""

    def finalize(self) -> None:
        """Collect what the function is made of; its callers optimise it."""
        self._raise_if_finalized()
        module = self._final_module
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            module.link_in(library._get_module_for_linking(), preserve=True)
        for function in module.functions:
            if not function.is_declaration and function.linkage == llvm.Linkage.external:
                function.linkage = "linkonce_odr"
        self._finalize_dynamic_globals()
        self._shared_module = module
        places = [v.name for v in module.global_variables if v.name.startswith(_ENVIRONMENT)]
        own = str(self._codegen._create_empty_module(self.name))
        own += "".join(f'@"{name}" = common global i8* null\n' for name in places)
        self._final_module = llvm.parse_assembly(own)
        self._finalize_final_module()


class _Typing(Context):
    """Numba's rules of types, which remember what a built-in function makes of its arguments.

    For each sum of two numbers Numba tries dozens of rules, such as those of lists and of strings.
    """

    __slots__ = ("_known",)

    def __init__(self, rules: Any) -> None:
        self.__dict__ = rules.__dict__  # it is the same, but for what follows
        self._known: dict[Any, Any] = {}

    def resolve_function_type(self, func: Any, args: Any, kws: Any) -> Any:
        """Signature of a function for types of arguments."""
        known = self._lookup_global(func) or func
        if not isinstance(known, types.Function):
            return super().resolve_function_type(func, args, kws)
        key = known, tuple(args), tuple(dict(kws).items())
        if key not in self._known:
            self._known[key] = super().resolve_function_type(func, args, kws)
        return self._known[key]


_TYPING: dict[Any, _Typing] = {}
"""For each set of a compiler's flags."""


class KernelCompiler(Compiler):
    """Numba's compiler, which finds each type once."""

    def define_pipelines(self) -> list[Any]:
        """As Numba's."""
        state = self.state
        flags = state.flags.copy()
        if flags not in _TYPING:
            _TYPING[flags] = _Typing(state.typingctx)
        state.typingctx = state.targetctx.typing_context = _TYPING[flags]
        return list(super().define_pipelines())


class PartCompiler(KernelCompiler):
    """The same for functions that only compiled ones call."""

    def define_pipelines(self) -> list[Any]:
        """As Numba's, into a library that is no more than a part of others."""
        state = self.state
        state.library = _PartLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        return super().define_pipelines()
