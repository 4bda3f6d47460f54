"""Structure of calibration files of any program: decoded by content, never by the file name.

A file becomes the name of its syntax and a mapping, as its parser returns it. Three programs have a syntax of
their own; their texts become mappings with the keys of ``camera_info``.

References
----------
http://wiki.ros.org/camera_calibration_parsers, https://colmap.github.io/format.html
"""

import codecs
import json
import re
import tomllib
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import yaml

from ipsys_log.errors import IpsysError

_LARGEST_FILE = 1 << 20  # bytes
# The sections [image] and [<camera>] of the calibrator of ROS; each key is above its values.
_INI = re.compile(
    r"^\[image\]\s+width\s+(?P<image_width>\S+)\s+height\s+(?P<image_height>\S+)\s+\[(?P<camera_name>.+)\]\s+"
    r"camera matrix\s+(?P<camera_matrix>[^a-z\[]+?)\s+distortion\s+(?P<distortion_coefficients>.+)$",
    re.MULTILINE,
)
_COLMAP = re.compile(
    r"^(\d+)[ \t]+([A-Z][A-Z_]+)[ \t]+(\d+)[ \t]+(\d+)((?:[ \t]+\S+){3,20})[ \t]*$", re.MULTILINE
)
# An assignment of MATLAB: rows of a matrix end with a semicolon or a line.
_ASSIGNMENT = re.compile(r"^[ \t]*(?:\w+\.)*(\w+)[ \t]*=[ \t]*(\[[^\]=]*\]|[^\[\n;%]+)[ \t]*;?", re.MULTILINE)
_TOML_LINE = re.compile(r"^[ \t]*(?:\[+[A-Za-z_][\w\".-]*\]+|[\w\"'.-]+[ \t]*=.*)[ \t]*$", re.MULTILINE)
_MATLAB_LINE = re.compile(r"^[ \t]*[\w.]+[ \t]*=[^=]*;[ \t]*$", re.MULTILINE)


class ParsedText(NamedTuple):
    """The text of a calibration file, the name of its syntax, and its contents."""

    text: str
    syntax: str
    contents: Any


def read_text(path: Path) -> str:
    """Return the text of a file in UTF-8, UTF-16 or, if it is none of them, Windows-1252."""
    if not path.is_file():
        raise IpsysError(f"{path}: does not exist; 'ipsys calibrate' writes a calibration file")
    try:
        with path.open("rb") as file:
            data = file.read(_LARGEST_FILE + 1)
    except OSError as error:
        raise IpsysError(f"{path}: cannot be read: {error.strerror}") from error
    if len(data) > _LARGEST_FILE:
        raise IpsysError(f"{path}: is not a calibration file: it has more than 1 MB")
    is_utf16 = data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    try:
        text = data.decode("utf-16" if is_utf16 else "utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("cp1252", errors="replace")
    if "\0" in text:
        raise IpsysError(f"{path}: is not a calibration file: it has bytes that are no text")
    return text.replace("\r\n", "\n")


def parse_text(text: str, where: str) -> ParsedText:
    """Parse the text of a calibration file by its first likely parser.

    Raises
    ------
    IpsysError
        The text is not valid; the error names the line.
    """
    syntax, parse = next((name, parse) for name, is_likely, parse in _PARSERS if is_likely(text))
    try:
        if syntax == "JSON":
            # OpenCV 3 writes the number "0.", which is YAML, but not JSON.
            with suppress(ValueError):
                return ParsedText(text, syntax, parse(text))
            parse = _parse_yaml
        return ParsedText(text, syntax, parse(text))
    except RecursionError as error:
        raise IpsysError(f"{where}: is not a calibration file: it has too many levels") from error
    except yaml.YAMLError as error:
        line = error.problem_mark.line + 1 if isinstance(error, yaml.MarkedYAMLError) else 1
        raise IpsysError(
            f"{where}: is not a calibration file: line {line} is not valid {syntax}; correct this line"
        ) from error
    except (ValueError, ElementTree.ParseError) as error:
        raise IpsysError(f"{where}: is not a calibration file: not valid {syntax}: {error}") from error


def line_of(text: str, *keys: str) -> int:
    """Return the number of the line with the last of these keys, each below the one before, from 1."""
    place = 0
    for key in keys:
        match = re.compile(rf"(?<![\w.]){re.escape(key)}(?!\w)").search(text, place) if key else None
        place = match.start() if match else place
    return text.count("\n", 0, place) + 1


def _parse_yaml(text: str) -> Any:
    # OpenCV 2 to 4 write "%YAML:1.0", which is not YAML; some editors put a comment before it. The text of
    # "ros2 topic echo" has several documents. BaseLoader makes only texts, lists and mappings, with any tag.
    text = re.sub(r"^%YAML.*$", "", text, flags=re.MULTILINE)
    if text.lstrip().startswith("{"):
        text = text.replace("\t", " ")
    documents = (document for document in yaml.load_all(text, yaml.BaseLoader) if document)
    return next(documents, None)


def _parse_ini(text: str) -> list[dict[str, str]]:
    return [match.groupdict() for match in _INI.finditer(text)]


def _parse_colmap(text: str) -> list[dict[str, Any]]:
    return [
        {"camera_id": number, "colmap_model": model, "width": width, "height": height, "params": values}
        for number, model, width, height, values in _COLMAP.findall(text)
    ]


def _parse_assignments(text: str) -> dict[str, str]:
    rows = _ASSIGNMENT.findall(re.sub(r"%.*$", "", text, flags=re.MULTILINE))
    return {name: re.sub(r"[\[\];\n]|\.\.\.", " ", value).strip() for name, value in rows}


def _parse_xml(text: str) -> Any:
    if "<!DOCTYPE" in text:
        raise ValueError("a document type is not read")
    return _contents(ElementTree.fromstring(text))  # without a document type, no entity expands


def _contents(element: ElementTree.Element) -> Any:
    children: Mapping[str, Any] = {child.tag: _contents(child) for child in element}
    return children or (element.text or "").strip().strip('"')


# The name of each syntax, a test whether a text has it, and its parser; the last one takes any text.
_PARSERS: tuple[tuple[str, Callable[[str], Any], Callable[[str], Any]], ...] = (
    ("ROS .ini", _INI.search, _parse_ini),
    ("COLMAP cameras.txt", _COLMAP.search, _parse_colmap),
    ("XML", lambda text: text.lstrip().startswith("<"), _parse_xml),
    ("JSON", lambda text: text.lstrip().startswith("{"), json.loads),
    ("MATLAB", _MATLAB_LINE.search, _parse_assignments),
    ("TOML", _TOML_LINE.search, tomllib.loads),
    ("YAML", lambda text: True, _parse_yaml),
)
