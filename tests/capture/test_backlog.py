"""Frames that wait for the stages: their number is bounded, and each searched frame can be decoded."""

from collections.abc import Sequence

from hypothesis import given
from hypothesis import strategies as st

from ipsys_log.capture.backlog import Waiting
from ipsys_log.messages import CompressedVideo, Message, SkippedVideo, image_topic

KEY, OTHER = bytes.fromhex("00000001 67 00000001 65 88"), bytes.fromhex("00000001 41 9a")


def video(number: int, key: bool, camera: str = "red") -> Message:
    frame = CompressedVideo(number, camera, KEY if key else OTHER, "h264")
    return Message(image_topic(camera), 1000 + number, number, frame, camera)


def numbers(messages: Sequence[Message]) -> list[int]:
    return [message.log_time_ns - 1000 for message in messages]


def searched(messages: Sequence[Message]) -> list[int]:
    return numbers([one for one in messages if isinstance(one.payload, CompressedVideo)])


def test_the_oldest_frames_of_a_video_are_only_decoded() -> None:
    waiting = Waiting()
    skipped = [late for n in range(10) for late in waiting.put(video(n, n == 0))]
    taken = waiting.take()
    assert numbers(taken) == list(range(10))
    assert searched(taken) == [7, 8, 9]
    assert numbers(skipped) == list(range(7))
    assert [one.payload.frame.data for one in taken if isinstance(one.payload, SkippedVideo)] == [
        KEY, *[OTHER] * 6,
    ]  # fmt: skip


def test_frames_before_a_searched_keyframe_are_not_decoded() -> None:
    waiting = Waiting()
    skipped = [late for n in range(10) for late in waiting.put(video(n, n in (0, 7)))]
    assert numbers(waiting.take()) == [7, 8, 9]
    assert numbers(skipped) == list(range(7))


def test_frames_are_skipped_until_a_late_keyframe() -> None:
    waiting = Waiting()
    skipped = []
    for n in range(1000):
        skipped += waiting.put(video(n, n == 0))
        assert len(waiting) <= 30
    assert numbers(waiting.take()) == []
    assert sorted(numbers(skipped)) == list(range(1000))
    assert waiting.put(video(1000, True)) == []
    assert searched(waiting.take()) == [1000]


# A case is the frames of two cameras, their keyframes, and the times at which the stages take frames.
steps = st.lists(st.tuples(st.sampled_from("ab"), st.booleans(), st.integers(0, 40)), max_size=200)


@given(steps, st.integers(1, 40))
def test_each_frame_is_searched_or_reported_as_skipped(came: list[tuple[str, bool, int]], every: int) -> None:
    waiting = Waiting()
    taken: list[Message] = []
    skipped: list[Message] = []
    sent: dict[str, list[int]] = {"a": [], "b": []}
    keys = set()
    for n, (camera, chance, pause) in enumerate(came):
        key = not sent[camera] or (chance and n % every == 0)
        keys |= {n} if key else set()
        sent[camera].append(n)
        skipped += waiting.put(video(n, key, camera))
        assert len(waiting) <= 60
        if pause == 0:
            taken += waiting.take()
    taken += waiting.take()
    assert sorted(searched(taken) + numbers(skipped)) == list(range(len(came)))
    for camera, order in sent.items():
        seen = [one for one in taken if one.camera == camera]
        assert numbers(seen) == sorted(numbers(seen))
        for frame in searched(seen):
            since = max(n for n in keys & set(order) if n <= frame)
            needed = [n for n in order if since <= n <= frame]
            assert [n for n in numbers(seen) if since <= n <= frame] == needed
