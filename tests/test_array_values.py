"""Dataclasses that hold arrays are compared by identity: ``==`` and ``hash()`` of an array raise errors."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import pkgutil
import typing
from array import array
from collections.abc import Callable, Iterator
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np

import ipsys_log


def modules() -> Iterator[ModuleType]:
    for module in pkgutil.walk_packages(ipsys_log.__path__, "ipsys_log."):
        if not module.name.endswith("__main__"):
            yield importlib.import_module(module.name)


def dataclasses_of_the_package() -> list[type]:
    classes = {
        value
        for module in modules()
        for value in vars(module).values()
        if isinstance(value, type) and dataclasses.is_dataclass(value) and value.__module__ == module.__name__
    }
    return sorted(classes, key=lambda value: (value.__module__, value.__qualname__))


def compared_fields(value: type) -> list[str]:
    """Return the fields that ``==`` and ``hash()`` of a dataclass or a named tuple read."""
    if not dataclasses.is_dataclass(value):
        return list(getattr(value, "_fields", ()))
    parameters = value.__dataclass_params__  # type: ignore[attr-defined]
    return [field.name for field in dataclasses.fields(value) if field.compare] if parameters.eq else []


@cache
def array_fields(value: type) -> list[str]:
    """Return the compared fields that hold arrays, directly or within other values."""
    names = compared_fields(value)
    types = field_types(value) if names else {}
    return [name for name in names if holds_array(types[name])]


def holds_array(annotation: Any) -> bool:
    origin = typing.get_origin(annotation)
    if np.ndarray in (annotation, origin):
        return True
    if isinstance(annotation, type) and origin is None:
        return bool(array_fields(annotation))
    if origin is Callable:
        return False
    return any(map(holds_array, typing.get_args(annotation)))


def field_types(value: type) -> dict[str, Any]:
    """Return the types of the fields, with the names that are imported only for the type checker."""
    module = inspect.getmodule(value)
    assert module is not None
    # Python 3.11 cannot read the annotation array[int].
    names = {name: list if known is array else known for name, known in vars(module).items()}
    for node in ast.parse(inspect.getsource(module)).body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            exec(compile(ast.Module(node.body, []), module.__name__, "exec"), names)
    return typing.get_type_hints(value, names)


def test_dataclasses_with_arrays_are_compared_by_identity() -> None:
    found = {value.__qualname__: array_fields(value) for value in dataclasses_of_the_package()}
    wrong = {name: fields for name, fields in found.items() if fields}
    assert wrong == {}, "write @dataclass(..., eq=False)"
