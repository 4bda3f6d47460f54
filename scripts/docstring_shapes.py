"""An extension of mkdocstrings for the docstrings of this project.

Their parameters have ``name : shape and meaning``, as in ``points_m : (n, 3), in m``. numpydoc expects a type
there, and the signature has the type already. The extension shows this text as the description.
"""

from __future__ import annotations

from typing import Any

from griffe import DocstringSectionKind, Extension, Function, Object

_RESULTS = {DocstringSectionKind.returns, DocstringSectionKind.yields}
_NAMED = {DocstringSectionKind.attributes, DocstringSectionKind.parameters}


class ShapesAsDescriptions(Extension):
    """Descriptions in place of the types in docstrings, and types from the signature."""

    def on_object(self, *, obj: Object, **kwargs: Any) -> None:  # noqa: ARG002
        """Change the sections of a docstring, before its page is made."""
        for section in obj.docstring.parsed if obj.docstring else ():
            if section.kind in _NAMED | _RESULTS:
                for element in section.value:
                    _describe(element, _declared_type(element, section.kind, obj))


def _describe(element: Any, declared: Any) -> None:
    """Move the text behind the colon to the description; take the type from the signature."""
    text = str(element.annotation or "")
    if text and text != str(declared or ""):
        element.description = f"{text}\n{element.description}".strip()
    element.annotation = declared


def _declared_type(element: Any, kind: DocstringSectionKind, obj: Object) -> Any:
    if not isinstance(obj, Function):
        member = obj.members.get(element.name) if kind in _NAMED else None
        return getattr(member, "annotation", None)
    if kind in _RESULTS:
        return obj.returns
    names = [name for name in (element.name, element.name.lstrip("*")) if name in obj.parameters]
    return obj.parameters[names[0]].annotation if names else None
