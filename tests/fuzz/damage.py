"""Random damage to bytes and texts, drawn and shrunk by Hypothesis."""

from collections.abc import Sequence

from hypothesis import strategies as st

# Numbers and signs that often cause faults in readers.
_NUMBERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 1 << 31, 1 << 32, 1 << 62, 1 << 63, (1 << 64) - 1)
_TEXTS = (
    b"nan", b"inf", b"-1", b"1e308", b"1e999", b"9" * 5000, b"\x1b[31m", b"\xff\xfe", b"\0", b"\n",
    b'"', b"'", b"[" * 300, b"{" * 300, b",", b";", b"\xe2\x80\xae", b"-", b"0", b" " * 100, b"&a *a",
    b"<<:", b"!!", b"\\ud800",
)  # fmt: skip
_PLACE = st.integers(0, 1 << 16)
_EDIT = st.one_of(
    st.tuples(st.just("set"), _PLACE, st.binary(min_size=1, max_size=4)),
    st.tuples(st.just("set"), _PLACE, st.sampled_from([n.to_bytes(8, "little") for n in _NUMBERS])),
    st.tuples(st.just("set"), _PLACE, st.sampled_from([bytes(16), bytes(512), b"\xff" * 16])),
    st.tuples(st.just("insert"), _PLACE, st.one_of(st.binary(max_size=8), st.sampled_from(_TEXTS))),
    st.tuples(st.just("remove"), _PLACE, st.integers(1, 64)),
    st.tuples(st.just("repeat"), _PLACE, st.integers(1, 256)),
    st.tuples(st.just("cut"), _PLACE, st.just(0)),
)


def damaged(wholes: Sequence[bytes]) -> st.SearchStrategy[bytes]:
    """Return one of some valid inputs after up to six edits; some stay valid, some are noise."""
    edited = st.builds(_apply, st.sampled_from(list(wholes)), st.lists(_EDIT, max_size=6))
    return st.one_of(edited, edited, edited, edited, st.binary(max_size=200))


def _apply(whole: bytes, edits: list[tuple[str, int, bytes | int]]) -> bytes:
    data = bytearray(whole)
    for kind, place, what in edits:
        at = place % (len(data) + 1)
        if isinstance(what, bytes):
            data[at : at + (len(what) if kind == "set" else 0)] = what
        elif kind == "remove":
            del data[at : at + what]
        elif kind == "repeat":
            data[at:at] = data[at : at + what]
        else:
            del data[at:]
    return bytes(data)
