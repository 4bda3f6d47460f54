"""Schemas that released logs hold are compatible with those of today: fields are only ever added."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    EnumDescriptorProto,
    FieldDescriptorProto,
    FileDescriptorSet,
)
from mcap.reader import make_reader

from ipsys_log.log.codec import schema_data
from tests.conftest import ROOT

LOGS = sorted([*ROOT.glob("sample_logs/*.mcap"), *ROOT.glob("tests/golden/**/*.mcap")])


def stored_schemas(path: Path) -> dict[str, bytes]:
    """Return the descriptor set of each schema in a log, by the name of the schema."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        assert {schema.encoding for schema in summary.schemas.values()} == {"protobuf"}
        return {schema.name: schema.data for schema in summary.schemas.values()}


def definitions(files: FileDescriptorSet) -> dict[str, DescriptorProto | EnumDescriptorProto]:
    """Return the messages and enums of a descriptor set, nested ones too, by full name."""

    def nested(
        scope: str, message: DescriptorProto
    ) -> Iterator[tuple[str, DescriptorProto | EnumDescriptorProto]]:
        name = f"{scope}.{message.name}"
        yield name, message
        yield from ((f"{name}.{enum.name}", enum) for enum in message.enum_type)
        for inner in message.nested_type:
            yield from nested(name, inner)

    found: dict[str, DescriptorProto | EnumDescriptorProto] = {}
    for file in files.file:
        found |= {f"{file.package}.{enum.name}": enum for enum in file.enum_type}
        for message in file.message_type:
            found |= dict(nested(file.package, message))
    return found


def meaning(field: FieldDescriptorProto) -> tuple[object, ...]:
    """Return what the bytes of a field depend on, its name, and whether it can be missing."""
    return (field.name, field.type, field.type_name, field.label, field.proto3_optional)


def incompatible(old: FileDescriptorSet, new: FileDescriptorSet) -> list[str]:
    """List the messages, fields and enum values of old schemas that new ones lack or define otherwise."""
    faults = []
    today = definitions(new)
    for name, definition in definitions(old).items():
        now = today.get(name)
        if isinstance(definition, DescriptorProto) and isinstance(now, DescriptorProto):
            fields = {field.number: meaning(field) for field in now.field}
            for field in definition.field:
                if fields.get(field.number) != meaning(field):
                    faults.append(f"{name}.{field.name} = {field.number}")
        elif isinstance(definition, EnumDescriptorProto) and isinstance(now, EnumDescriptorProto):
            values = {(value.name, value.number) for value in now.value}
            faults += [
                f"{name}.{value.name} = {value.number}"
                for value in definition.value
                if (value.name, value.number) not in values
            ]
        else:
            faults.append(name)
    return faults


@pytest.mark.parametrize("path", LOGS, ids=lambda path: path.stem)
def test_schemas_of_released_logs_lose_and_change_nothing(path: Path) -> None:
    stored = stored_schemas(path)
    assert stored
    for name, data in stored.items():
        new = FileDescriptorSet.FromString(schema_data(name))
        assert incompatible(FileDescriptorSet.FromString(data), new) == [], name


def test_released_logs_hold_the_schemas_of_all_stages() -> None:
    stored = {name for path in LOGS for name in stored_schemas(path)}
    names = (
        "Rig",
        "Measurement",
        "Markers",
        "CameraPoints",
        "Model",
        "Evaluation",
        "Positions",
        "Tracks",
        "Run",
    )
    assert {f"ipsys.v1.{name}" for name in names} <= stored
    assert {f"foxglove.{name}" for name in ("CompressedImage", "CameraCalibration")} <= stored


def _message(files: FileDescriptorSet, name: str) -> DescriptorProto:
    definition = definitions(files)[name]
    assert isinstance(definition, DescriptorProto)
    return definition


def _enum(files: FileDescriptorSet, name: str) -> EnumDescriptorProto:
    definition = definitions(files)[name]
    assert isinstance(definition, EnumDescriptorProto)
    return definition


ANNOTATIONS, POINTS = "foxglove.ImageAnnotations", "foxglove.PointsAnnotation"


def _remove_field(files: FileDescriptorSet) -> None:
    del _message(files, POINTS).field[2]


def _renumber(files: FileDescriptorSet) -> None:
    _message(files, POINTS).field[2].number = 99


def _retype(files: FileDescriptorSet) -> None:
    _message(files, POINTS).field[0].type_name = ".google.protobuf.Duration"


def _relabel(files: FileDescriptorSet) -> None:
    _message(files, POINTS).field[2].label = FieldDescriptorProto.LABEL_OPTIONAL


def _rename(files: FileDescriptorSet) -> None:
    _message(files, POINTS).field[2].name = "corners"


def _exchange_numbers(files: FileDescriptorSet) -> None:
    one, other = _message(files, POINTS).field[:2]
    one.number, other.number = other.number, one.number


def _remove_value(files: FileDescriptorSet) -> None:
    del _enum(files, f"{POINTS}.Type").value[1]


def _renumber_value(files: FileDescriptorSet) -> None:
    _enum(files, f"{POINTS}.Type").value[1].number = 99


def _rename_message(files: FileDescriptorSet) -> None:
    _message(files, POINTS).name = "DotsAnnotation"


@pytest.mark.parametrize(
    "change",
    [
        *(_remove_field, _renumber, _retype, _relabel, _rename, _exchange_numbers),
        *(_remove_value, _renumber_value, _rename_message),
    ],
)
def test_a_change_of_a_stored_schema_is_seen(change: Callable[[FileDescriptorSet], None]) -> None:
    old, new = (FileDescriptorSet.FromString(schema_data(ANNOTATIONS)) for _ in range(2))
    change(new)
    faults = incompatible(old, new)
    assert faults
    assert all(fault.startswith(POINTS) for fault in faults)


def test_additions_to_a_stored_schema_are_accepted() -> None:
    old, new = (FileDescriptorSet.FromString(schema_data(ANNOTATIONS)) for _ in range(2))
    _message(new, POINTS).field.add(name="note", number=99, type=FieldDescriptorProto.TYPE_STRING)
    _enum(new, f"{POINTS}.Type").value.add(name="CURVE", number=99)
    new.file.add(name="more.proto", package="more").message_type.add(name="More")
    assert incompatible(old, new) == []
    assert incompatible(new, old) == [f"{POINTS}.note = 99", f"{POINTS}.Type.CURVE = 99", "more.More"]
