"""The readers of untrusted data. For damaged input, they may only raise an `IpsysError`.

If a reader refuses its input, it writes nothing. No input takes more than a few seconds of the processor.
"""

import asyncio
import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote

from hypothesis import strategies as st

from ipsys_log.app.web.app import build_app
from ipsys_log.calibration import images as calibration_pictures
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.calibration_files import read_intrinsics
from ipsys_log.exchange.image_folders import find_times
from ipsys_log.exchange.imsel import read_mat
from ipsys_log.exchange.ros_bags import find_bag_cameras, read_bag
from ipsys_log.live_runs.survey.sheet import read_sheet
from ipsys_log.log.codec import PAYLOADS, decode, encode, schema_name
from ipsys_log.log.dataset import Session
from ipsys_log.log.reader import LogReader
from ipsys_log.log.recovery import repair
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import CompressedImage, CompressedVideo
from ipsys_log.messages.rig_file import load_rig
from ipsys_log.vision.decode import decode_grey, decode_rows
from ipsys_log.vision.video import Video
from tests.fuzz import seeds
from tests.fuzz.damage import damaged
from tests.web.test_measuring_page import Recording

_MOST_CPU_S = 5.0

Target = tuple[st.SearchStrategy[Any], Callable[[Any], None]]


def attack(act: Callable[[Any], None], given: Any) -> None:
    """Run one case within its processor time, that of this thread alone.

    A case that takes too long is run again: a slow case is slow each time, a busy machine is not.
    """
    for _ in range(3):
        start_s = time.thread_time()
        with suppress(IpsysError):
            act(given)
        if time.thread_time() - start_s < _MOST_CPU_S:
            return
    raise AssertionError(f"a case takes more than {_MOST_CPU_S} s")


@contextmanager
def file(data: bytes, name: str) -> Iterator[Path]:
    """Write the data to a file; if a reader refuses it, the file and its folder stay unchanged."""
    with TemporaryDirectory(prefix="fuzz") as folder:
        path = Path(folder) / name
        path.write_bytes(data)
        try:
            yield path
        except IpsysError:
            assert path.read_bytes() == data
            assert [one.name for one in path.parent.iterdir()] == [name]
            raise


def read_log(data: bytes) -> None:
    with file(data, "a.mcap") as path, Session([path]) as session:
        session.runs()
        for topic in session.readers[0].channels:
            with suppress(IpsysError):
                for _ in session.messages([topic]):
                    pass
                session.readers[0].channel_hash(topic)


def append_log(data: bytes) -> None:
    with file(data, "a.mcap") as path:
        with LogWriter.append(path) as log:
            log.add_channel("/fuzz", None)
            log.write("/fuzz", 5, 5, b"payload")
        with suppress(IpsysError), LogReader(path) as reader:  # the earlier damage is still there
            assert [message.data for message in reader.messages(["/fuzz"])][-1:] == [b"payload"]


def repair_log(data: bytes) -> None:
    with file(data, "a.mcap") as path:
        repair(path)
        LogReader(path).close()


def decode_payload(given: tuple[str, str, bytes]) -> None:
    name, encoding, data = given
    decode(name, data, encoding)


def read_rig(data: bytes) -> None:
    with file(data, "lab.toml") as path:
        load_rig(path)


def read_lens(given: tuple[str, bytes]) -> None:
    kind, data = given
    with file(data, f"lens{kind}") as path:
        read_intrinsics(path, "red")


def read_measurements(data: bytes) -> None:
    with file(data, "sheet.csv") as path:
        read_sheet(path, seeds.RIG, 0)


def read_times(data: bytes) -> None:
    with file(data, "times.csv") as path:
        find_times({"red": [Path("red/1.jpg"), Path("red/2.jpg")]}, str(path))


def read_tables(data: bytes) -> None:
    with file(data, "a.mat") as path:
        read_mat(path)


def read_ros_bag(given: tuple[str, bytes]) -> None:
    kind, data = given
    with file(data, f"drive{kind}") as path:
        for _ in read_bag(path, find_bag_cameras(path, {})):
            pass


def decode_picture(data: bytes) -> None:
    calibration_pictures._decode(data)
    frame = CompressedImage(0, "red", data, "jpeg")
    with suppress(IpsysError):
        decode_rows(frame, [slice(8, 24)])
    decode_grey(frame)


def decode_video(given: tuple[str, list[bytes]]) -> None:
    name, parts = given
    video = Video(name)
    for data in parts:
        with suppress(IpsysError):
            video(CompressedVideo(0, "red", data, name))


def ask_page(given: tuple[str, str, bytes]) -> None:
    method, path, body = given
    assert asyncio.run(_ask(method, path, body)) < 500


async def _ask(method: str, path: str, body: bytes) -> int:
    """Return the status of an answer, directly from the page without a socket."""
    statuses: list[int] = []
    plain, _, query = path.partition("?")
    scope = {
        "type": "http", "method": method, "path": plain, "raw_path": quote(plain).encode(),
        "query_string": quote(query, safe="=&%").encode(), "headers": [], "root_path": "", "scheme": "http",
        "server": ("localhost", 80), "client": ("localhost", 1), "http_version": "1.1",
    }  # fmt: skip

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(event: Any) -> None:
        if event["type"] == "http.response.start":
            statuses.append(event["status"])

    await build_app(Recording())(scope, receive, send)
    return statuses[0]


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.just("\ud800"),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["A", "B", "Z"]), inner),
    max_leaves=6,
)
_TYPED = st.sampled_from(
    ["", "1", "150", "1e308", "nan", "-5", "9" * 3000, "left", "\ud800", "\x1b[2J", "p1"]
)
_PLACE = st.fixed_dictionaries(
    {
        "marker": _TYPED | st.just("0"),
        "distances": st.dictionaries(st.sampled_from("ABZ"), _TYPED | _JSON) | _JSON,
    },
    optional=dict.fromkeys(("side", "height", "split", "stop", "accepted", "id"), _TYPED | _JSON),
)
_BODY = st.one_of(
    _PLACE.map(json.dumps).map(str.encode),
    _JSON.map(json.dumps).map(str.encode),
    damaged([b'{"marker":"0","distances":{"A":"170","B":"190"},"side":"left","height":"10"}']),
)
_PATHS = ["/api/check", "/api/measure", "/api/undo", "/api/views", "/api/scene", "/picture/red/1", "/"]
_ENDS = [
    "",
    "?marker=1",
    f"?marker={'9' * 5000}",
    f"{'9' * 5000}",
    "?marker=\u0663",
    "?stop=-1",
    "?stop=\x1b",
]
_REQUEST = st.tuples(
    st.sampled_from(["POST", "POST", "GET"]),
    st.builds("{}{}".format, st.sampled_from(_PATHS), st.sampled_from(_ENDS)),
    _BODY,
)


def _payload_bytes() -> st.SearchStrategy[tuple[str, str, bytes]]:
    whole = {schema_name(type(payload)): encode(payload) for _, payload in seeds.payloads()}
    names = st.sampled_from([*sorted(PAYLOADS), "sensor_msgs/msg/Image", "other"])
    own = st.sampled_from(sorted(whole)).flatmap(
        lambda name: st.tuples(st.just(name), st.just("protobuf"), damaged([whole[name]]))
    )
    text = _JSON.map(json.dumps).map(str.encode) | damaged(
        [b'{"timestamp":{"sec":1,"nsec":2},"points":[{}]}']
    )
    return st.one_of(
        own,
        st.tuples(names, st.just("protobuf"), damaged(sorted(whole.values()))),
        st.tuples(names, st.just("json"), text),
    )


def _files(wholes: Sequence[tuple[str, bytes]]) -> st.SearchStrategy[tuple[str, bytes]]:
    """Return files with their suffixes, damaged."""
    return st.sampled_from(wholes).flatmap(lambda one: st.tuples(st.just(one[0]), damaged([one[1]])))


def _video_bytes() -> st.SearchStrategy[tuple[str, list[bytes]]]:
    units = [b"\0\0\0\1\x67\x42\0\x0a\xf8\x41\xa2", b"\0\0\0\1\x68\xce\x38\x80", b"\0\0\0\1\x65\x88\x84\0"]
    return st.tuples(
        st.sampled_from(["h264", "h265"]), st.lists(damaged([*units, b"".join(units)]), max_size=4)
    )


TARGETS: dict[str, Callable[[], Target]] = {
    "reader": lambda: (damaged(seeds.logs()), read_log),
    "append": lambda: (damaged(seeds.logs()), append_log),
    "repair": lambda: (damaged(seeds.logs()), repair_log),
    "codec": lambda: (_payload_bytes(), decode_payload),
    "rig": lambda: (damaged(seeds.rig_files()), read_rig),
    "lens": lambda: (_files(seeds.lens_files()), read_lens),
    "sheet": lambda: (damaged(seeds.sheets()), read_measurements),
    "times": lambda: (damaged([b"file,time\nred/1.jpg,1700000000.5\nred/2.jpg,1700000001\n"]), read_times),
    "mat": lambda: (damaged(seeds.mat()), read_tables),
    "bag": lambda: (_files(seeds.bags()), read_ros_bag),
    "picture": lambda: (damaged(seeds.pictures()), decode_picture),
    "video": lambda: (_video_bytes(), decode_video),
    "page": lambda: (_REQUEST, ask_page),
}
