"""Payloads keep every bit in the log, and the schemas are those of the package."""

import subprocess
import sys
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import given
from hypothesis import strategies as st

from ipsys_log import messages as m
from ipsys_log.errors import LogError
from ipsys_log.log.codec import PAYLOADS, decode, encode, schema_data

ROOT = Path(__file__).resolve().parents[2]

numbers = st.floats(allow_nan=False, allow_infinity=False)
times = st.integers(min_value=0, max_value=2**62)
ids = st.integers(min_value=0, max_value=2**32 - 1)


def arrays(*shape: int) -> st.SearchStrategy[Any]:
    size = int(np.prod(shape))
    return st.lists(numbers, min_size=size, max_size=size).map(lambda row: np.array(row).reshape(shape))


def rows(strategy: st.SearchStrategy[Any]) -> st.SearchStrategy[tuple[Any, ...]]:
    return st.lists(strategy, max_size=4).map(tuple)


payloads = st.one_of(
    st.builds(m.Markers, times, rows(st.builds(m.Marker, ids, arrays(4, 2))), ids, ids),
    st.builds(
        m.CameraPoints,
        times,
        rows(st.builds(m.CameraPoint, ids, numbers, numbers, numbers, st.none() | numbers)),
    ),
    st.builds(
        m.Positions,
        times,
        rows(
            st.builds(
                m.Position, ids, numbers, numbers, numbers, st.none() | numbers, st.none() | arrays(3, 3)
            )
        ),
    ),
    st.builds(
        m.Measurement,
        times,
        st.text(),
        st.none() | st.text(),
        st.none() | ids,
        rows(st.builds(m.Distance, st.text(), numbers, st.none() | numbers)),
        st.none() | st.sampled_from(["left", "right"]),
        st.none() | numbers,
        st.none() | numbers,
        st.none() | st.builds(m.Interval, times, times),
        st.none() | st.builds(m.WorldPoint, numbers, numbers, numbers),
        rows(st.text()),
    ),
    st.builds(
        m.Run,
        times,
        st.text(),
        st.text(),
        st.dictionaries(st.text(), st.text()),
        st.dictionaries(st.text(), st.text()),
        st.none() | st.builds(m.Rig, st.text(), st.text(), numbers, rows(st.builds(m.RigMarker, ids))),
    ),
    st.builds(m.CompressedImage, times, st.text(), st.binary(), st.text()),
)


def same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray):
        return isinstance(other, np.ndarray) and one.tobytes() == other.tobytes() and one.shape == other.shape
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if hasattr(one, "__dataclass_fields__"):
        return type(one) is type(other) and all(
            same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one)
        )
    return bool(one == other) and type(one) is type(other)


@given(payloads)
def test_reader_returns_the_written_messages(payload: Any) -> None:
    name = next(key for key, kind in PAYLOADS.items() if kind is type(payload))
    data = encode(payload)
    back = decode(name, data)
    assert same(back, payload)
    assert encode(back) == data


@given(payloads)
def test_log_is_readable_with_its_own_schemas(payload: Any) -> None:
    name = next(key for key, kind in PAYLOADS.items() if kind is type(payload))
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema_data(name)).file:
        pool.Add(file)
    stranger = message_factory.GetMessageClass(pool.FindMessageTypeByName(name)).FromString(encode(payload))
    hints = get_type_hints(type(payload), include_extras=True)
    for field in fields(payload):
        value = getattr(payload, field.name)
        if hints[field.name] in (str, int, float, bytes):
            assert getattr(stranger, field.name) == value
        if value is None:
            assert not stranger.HasField(field.name)


@given(
    times, st.text(), st.text(), st.sampled_from([0, 127, 128, (32 << 10) - 1, 32 << 10, 100_000, 1 << 21])
)
def test_long_bytes_are_set_where_protobuf_sets_them(time: int, frame: str, text: str, size: int) -> None:
    data = bytes(range(256)) * (size // 256) + bytes(size % 256)
    for payload in (
        m.CompressedImage(time, frame, data, text),
        m.RawImage(time, frame, size, 3, text, 9, data),
    ):
        encoded = encode(payload)
        assert same(decode(f"foxglove.{type(payload).__name__}", encoded), payload)
        module = import_module(f"foxglove_schemas_protobuf.{type(payload).__name__}_pb2")
        proto = getattr(module, type(payload).__name__).FromString(encoded)
        assert proto.SerializeToString(deterministic=True) == encoded


def test_zero_is_not_missing() -> None:
    point = m.CameraPoint(0, 0.0, 0.0, 0.0, 0.0)
    back = decode("ipsys.v1.CameraPoints", encode(m.CameraPoints(0, (point,)))).points[0]
    assert back.heading_rad == 0.0
    missing = m.CameraPoint(0, 0.0, 0.0, 0.0)
    assert (
        decode("ipsys.v1.CameraPoints", encode(m.CameraPoints(0, (missing,)))).points[0].heading_rad is None
    )


@pytest.mark.parametrize("data", [b"\xff\xff\xff", b"\x12\x04\x12\x02\x00\x00"])
def test_bytes_that_are_no_such_message(data: bytes) -> None:
    with pytest.raises(LogError, match=r"ipsys\.v1\.Markers"):
        decode("ipsys.v1.Markers", data)


def test_every_payload_mirrors_its_schema() -> None:
    """A field without a schema entry would be lost; the codec finds it only on use."""
    for name, payload in PAYLOADS.items():
        pool = descriptor_pool.DescriptorPool()
        for file in descriptor_pb2.FileDescriptorSet.FromString(schema_data(name)).file:
            pool.Add(file)
        descriptor = pool.FindMessageTypeByName(name)
        assert {f.name for f in fields(payload)} <= set(descriptor.fields_by_name), name
        if name.startswith("ipsys."):
            assert set(descriptor.fields_by_name) == {f.name for f in fields(payload)}, name


def test_the_shipped_descriptor_set_is_that_of_the_schemas(tmp_path: Path) -> None:
    fresh = tmp_path / "fresh.binpb"
    subprocess.run(
        ["bash", str(ROOT / "scripts/compile-schemas"), str(fresh)],
        check=True,
        env={"PATH": "/usr/bin:/bin", "PYTHON": sys.executable},
    )
    sets = [
        descriptor_pb2.FileDescriptorSet.FromString(path.read_bytes())
        for path in (fresh, ROOT / "ipsys_log/schemas.binpb")
    ]
    assert sets[0] == sets[1], "run scripts/compile-schemas"
