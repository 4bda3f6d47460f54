"""Import of image folders."""

from pathlib import Path

import pytest

from ipsys_log.errors import IpsysError
from ipsys_log.exchange.image_folders import find_images, read_images
from ipsys_log.messages import CompressedImage


def folder(tmp_path: Path, *names: str) -> Path:
    for name in names:
        path = tmp_path / "pictures" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())
    return tmp_path / "pictures"


def test_numbers_in_names_count_by_their_value(tmp_path: Path) -> None:
    names = [f"red/img{n}.jpg" for n in (1, 2, 10, 11)] + [f"white/frame_{n:03}.PNG" for n in range(4)]
    messages = list(read_images(find_images(folder(tmp_path, *names)), None, {}, 2.0))
    assert all(isinstance(message.payload, CompressedImage) for message in messages)
    order = [message.payload.data.decode() for message in messages if message.camera == "red"]
    assert order == names[:4]
    # The n-th images of the cameras have one time, and no two messages have the same log time.
    instants = [message.publish_time_ns for message in messages]
    assert instants[::2] == instants[1::2]
    assert len({message.log_time_ns for message in messages}) == len(messages)
    assert {message.payload.format for message in messages} == {"jpeg", "png"}


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["red/a.tiff", "red/b.jpg"], "a.tiff: only .jpg"),
        (["Red/a.jpg"], "rename the folder"),
        (["a.jpg"], "no sub-folders with pictures"),
    ],
)
def test_pictures_that_would_be_left_out_are_named(tmp_path: Path, names: list[str], said: str) -> None:
    with pytest.raises(IpsysError, match=said):
        find_images(folder(tmp_path, *names))


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf")])
def test_invalid_rate_is_refused(tmp_path: Path, rate: float) -> None:
    with pytest.raises(IpsysError, match="pictures per second"):
        list(read_images(find_images(folder(tmp_path, "red/a.jpg")), None, {}, rate))
