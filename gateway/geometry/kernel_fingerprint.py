"""What the machine code of a kernel follows from, as a fingerprint.

Numba keeps compiled kernels on the disk, and compiles one anew when the file it stands in changes: too
seldom, for the code of the kernels that it calls and the constants they freeze lie in other files, and too
often, for most edits of a file change neither. The fingerprint is taken of the kernel's own bytecode and
constants and, through every name they use, of all kernels, constants and named tuples that go into the
machine code. It names no place, so a cache may be moved or shared between installations. Signatures,
processors and the versions of Numba and Python are Numba's own part of the key.
"""

from __future__ import annotations

import ast
import builtins
import functools
import hashlib
from collections.abc import Callable, Iterable, Iterator
from enum import Enum
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

Function = Callable[..., object]
COMPILATION = {"error_model": "numpy", "slp_vectorize": 1}
"""How all kernels are compiled. IEEE division (x / 0 is inf or NaN, never an exception). Neighbouring
elements of a block are computed in one instruction (superword-level parallelism), each as it would be alone.
Reassociation of sums stays off: the same input gives the same bits."""


def fingerprint(functions: Iterable[Function]) -> str:
    """Return 16 hexadecimal digits that change with whatever the code of these kernels follows from.

    Annotations are strings (``from __future__ import annotations``) or classes. Raises ``TypeError`` for a
    kernel that uses a global of a kind unknown here.
    """
    found: dict[str, list[str]] = {}
    waiting = list(functions)
    while waiting:
        function = waiting.pop()
        name = f"{function.__module__}.{function.__qualname__}"
        # Kernels may call each other in a circle.
        if name not in found:
            found[name], called = _described(function)
            waiting += called
    digest = hashlib.sha256(repr(COMPILATION).encode())
    # Sorted: the order in which kernels are met must not change the digest.
    for name in sorted(found):
        digest.update("\n".join((name, *found[name], "")).encode())
    return digest.hexdigest()[:16]


@functools.cache
def _described(function: Function) -> tuple[list[str], list[Function]]:
    """Return the lines that describe one kernel, and the kernels that it calls."""
    if not isinstance(function, FunctionType):
        raise TypeError(f"{function!r} is not a function written in Python")
    code, names = function.__code__, function.__globals__
    lines = [*_code_lines(code, function.__doc__), repr(function.__defaults__)]
    called: list[Function] = []
    for name in sorted(_used_names(code)):
        if name not in names:
            continue  # an attribute or a builtin: the bytecode names it
        value = names[name]
        if isinstance(value, ModuleType):
            values = [(f"{name}.{a}", getattr(value, a)) for a in _used_names(code) if _is_ours(value, a)]
        else:
            values = [(name, value)]
        for full_name, each in sorted(values):
            _describe(full_name, each, lines, called)
    for annotation in function.__annotations__.values():
        lines += _annotated(annotation, names) if isinstance(annotation, str) else _class_lines(annotation)
    for cell in function.__closure__ or ():
        _describe("closure", cell.cell_contents, lines, called)
    return lines, called


def _describe(name: str, value: Any, lines: list[str], called: list[Function]) -> None:
    """Append what one used value contributes: a kernel to ``called``, anything else to ``lines``."""
    kernel = getattr(value, "kernel_function", None)
    if kernel is not None:
        called.append(kernel)
        lines.append(f"{name} calls {kernel.__module__}.{kernel.__qualname__}")
    elif isinstance(value, np.ndarray):
        lines.append(f"{name} = {value.dtype.str} {value.shape} {value.tobytes().hex()}")
    elif isinstance(value, type):
        lines += _class_lines(value)
    elif value is None or isinstance(
        value, (bool, int, float, complex, str, tuple, Enum, np.generic, np.dtype)
    ):
        lines.append(f"{name} = {value!r}")
    elif isinstance(value, BuiltinFunctionType | np.ufunc):
        lines.append(f"{name} is {value!r}")
    else:
        # Better no cache than one that does not notice a change.
        raise TypeError(f"a kernel uses {name}, a {type(value).__name__}: its fingerprint cannot follow that")


def _code_lines(code: CodeType, documentation: str | None) -> Iterator[str]:
    """Yield what the compiler reads of a function: no line numbers, file names or documentation."""
    yield code.co_code.hex()
    yield repr((code.co_names, code.co_varnames, code.co_freevars, code.co_argcount, code.co_kwonlyargcount))
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _code_lines(constant, None)
        elif constant is None or constant != documentation:
            yield repr(constant)


def _used_names(code: CodeType) -> set[str]:
    names = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            names |= _used_names(constant)
    return names


def _is_ours(module: ModuleType, name: str) -> bool:
    """Return whether a module of kernels has the name; NumPy and ``math`` change with the compiler alone."""
    if module.__name__.partition(".")[0] in ("numpy", "math"):
        return False
    return not isinstance(getattr(module, name, module), ModuleType)


def _class_lines(kind: type) -> Iterator[str]:
    """Yield the layout of a named tuple (kernels read its fields by place) or an enumeration's values."""
    yield f"{kind.__module__}.{kind.__qualname__}"
    if issubclass(kind, Enum):
        yield repr([(member.name, member.value) for member in kind])
    elif hasattr(kind, "_fields"):
        yield repr(kind._fields)


def _annotated(annotation: str, names: dict[str, Any]) -> Iterator[str]:
    """Yield the layouts of the named tuples in an annotation. Raises ``TypeError`` for an unknown name."""
    for node in ast.walk(ast.parse(annotation)):
        if isinstance(node, ast.Name):
            if node.id not in names and not hasattr(builtins, node.id):
                raise TypeError(
                    f"a kernel's annotation names {node.id}, which is not imported where it stands"
                )
            kind = names.get(node.id)
            if isinstance(kind, type) and hasattr(kind, "_fields"):
                yield from _class_lines(kind)
