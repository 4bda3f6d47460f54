"""Comparison of a schema in a log with that of this version: later versions only add fields."""

from collections.abc import Iterator
from typing import NamedTuple

from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorSet
from google.protobuf.message import DecodeError

from ipsys_log.log.codec import PAYLOADS, schema_data
from ipsys_log.log.contents import Schema


class SchemaDifference(NamedTuple):
    """The fields of a stored schema that this version reads differently, and those that it does not know."""

    faults: tuple[str, ...] = ()
    new_fields: tuple[str, ...] = ()


def compare_schema(schema: Schema) -> SchemaDifference:
    """Compare a stored schema with the schema of the same name of this version.

    Schemas that this version does not decode by protobuf give no difference.
    """
    if schema.name not in PAYLOADS or schema.encoding != "protobuf":
        return SchemaDifference()
    try:
        stored = _messages(FileDescriptorSet.FromString(schema.data))
    except (DecodeError, RecursionError):
        return SchemaDifference(("its definition is not valid",))
    if schema.name not in stored:
        return SchemaDifference((f"its definition does not contain {schema.name}",))
    known = _messages(FileDescriptorSet.FromString(schema_data(schema.name)))
    faults: list[str] = []
    new_fields: list[str] = []
    for name in sorted(stored.keys() & known.keys()):
        fields = {field.number: field for field in known[name].field}
        for field in stored[name].field:
            title = f"field {field.number} of {name} ({field.name})"
            if field.number not in fields:
                new_fields.append(title)
            elif _meaning(field) != _meaning(fields[field.number]):
                faults.append(f"{title} is another field here ({fields[field.number].name})")
    return SchemaDifference(tuple(faults), tuple(new_fields))


def _meaning(field: FieldDescriptorProto) -> tuple[str, int, str, bool]:
    """Return the name and the form of a field in the bytes of a message."""
    is_list = field.label == FieldDescriptorProto.LABEL_REPEATED
    return field.name, field.type, field.type_name, is_list


def _messages(files: FileDescriptorSet) -> dict[str, DescriptorProto]:
    """Return the messages of a descriptor set by full name, with nested messages."""

    def nested(scope: str, message: DescriptorProto) -> Iterator[tuple[str, DescriptorProto]]:
        name = f"{scope}.{message.name}"
        yield name, message
        for inner in message.nested_type:
            yield from nested(name, inner)

    return {
        name: definition
        for file in files.file
        for message in file.message_type
        for name, definition in nested(file.package, message)
    }
