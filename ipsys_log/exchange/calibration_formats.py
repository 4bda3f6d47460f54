"""Readers of the camera intrinsics of other programs: one table of forms, each recognised by its keys.

References
----------
https://docs.ros.org/en/api/sensor_msgs/html/msg/CameraInfo.html, https://colmap.github.io/cameras.html,
https://github.com/ethz-asl/kalibr/wiki/yaml-formats,
https://www.mathworks.com/help/vision/ref/cameraintrinsics.html
"""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.exchange.calibration_texts import ParsedText, line_of, parse_text, read_text
from ipsys_log.log.contents import parse_foreign_camera
from ipsys_log.messages import CameraCalibration
from ipsys_log.vision.lenses import DISTORTION_MODELS, check_calibration

_WIDEST_PX = 65_535
_MOST_NUMBERS = 100
_MOST_LEVELS = 3
# Names of keys without case, "_" and " ". Each program has its own.
_MATRIX = ("cameramatrix", "mtx", "k", "matrix", "intrinsicmatrix", "intrinsicsmatrix")
_COEFFICIENTS = (
    *("distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoeff", "dist", "d", "distortions"),
    *("distortion", "distcoefficients"),
)
_WIDTH, _HEIGHT = ("imagewidth", "imgwidth", "width"), ("imageheight", "imgheight", "height")
_SIZE = ("resolution", "size", "imagesize", "imgsize")
_MODEL = ("distortionmodel", "distortiontype", "intrinsictype", "colmapmodel", "lensmodel")
# Names of models without case, "_", "-" and " ", and the model in a log. An empty name states no model.
_MODEL_OF_NAME = {
    **dict.fromkeys(("equidistant", "equi", "fisheye", "kannalabrandt", "kb4"), "kannala_brandt"),
    **dict.fromkeys(("opencvfisheye", "simpleradialfisheye", "radialfisheye"), "kannala_brandt"),
    **dict.fromkeys(("plumbbob", "radtan", "radialtangential", "brownconrady"), "plumb_bob"),
    **dict.fromkeys(("opencv", "pinhole", "simplepinhole", "simpleradial", "radial"), "plumb_bob"),
    **dict.fromkeys(("pinholeradialtangential", "none"), "plumb_bob"),
    **dict.fromkeys(("rationalpolynomial", "rational", "fullopencv"), "rational_polynomial"),
    **dict.fromkeys(("", "unknown"), ""),
}
# The pinhole models of OpenCV by the number of coefficients; 12 and 14 have thin prisms and a tilted sensor.
_MODEL_OF_COUNT = {4: "kannala_brandt", 5: "plumb_bob", 8: "rational_polynomial"}
_MODEL_OF_COUNT |= dict.fromkeys((12, 14), "rational_polynomial")
_ORDER = {
    "kannala_brandt": ("k1", "k2", "k3", "k4"),
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational_polynomial": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
# The parameters of a camera in COLMAP.
_COLMAP = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
}
# The pixel coordinates of the centre of the first pixel; it is (0, 0) in OpenCV.
_COLMAP_ORIGIN_PX, _MATLAB_ORIGIN_PX = 0.5, 1.0


class CalibrationFile(NamedTuple):
    """The intrinsics of a camera in a file, and a remark on the lens model if the file names none."""

    lens: CameraCalibration
    remark: str


@dataclass(frozen=True, slots=True)
class _Entry:
    """One camera of a file: its names, and its values by key without case, ``_`` and spaces.

    ``keys`` are the same keys as in the file.
    """

    file: ParsedText
    path: Path
    names: tuple[str, ...]
    values: Mapping[str, Any]
    keys: Mapping[str, str]

    def key(self, names: Iterable[str]) -> str | None:
        """Return the first of these keys that the camera has."""
        return next((name for name in names if self.values.get(name) not in (None, "")), None)

    def text(self, names: Iterable[str]) -> str:
        key = self.key(names)
        return str(self.values[key]).strip() if key is not None else ""

    def fault(self, text: str, key: str | None = None) -> IpsysError:
        """Return an error with the file, its form and the line of a key."""
        line = line_of(self.file.text, *self.names[:1], self.keys.get(key or "", ""))
        name = f", {self.names[0]}" if self.names else ""
        return IpsysError(f"{self.path}, line {line}: {_form_of(self).name}{name}: {text}")

    def numbers(self, key: str, counts: Iterable[int]) -> NDArray[np.float64]:
        """Return the numbers of a key, in rows or not."""
        try:
            found = _flatten(self.values[key])
        except ValueError as error:
            raise self.fault(
                f"{self.keys[key]} is not a list of numbers; write it like [1.0, 2.0]", key
            ) from error
        wanted = sorted(counts)
        if wanted and len(found) not in wanted:
            advice = (
                "write decimal points, not commas" if len(found) == 2 * wanted[-1] else "correct the list"
            )
            text = f"{self.keys[key]} needs {wanted[0]} numbers, but has {len(found)}; {advice}"
            raise self.fault(text, key)
        return np.array(found)


class _Lens(NamedTuple):
    """Camera matrix, coefficients and the stated model, as a form has read them."""

    K: NDArray[np.float64]
    D: NDArray[np.float64]
    model: str


def read_calibration(path: Path, camera: str, time_ns: int = 0) -> CalibrationFile:
    """Read the intrinsics of a camera from a file of OpenCV, ROS, Kalibr, COLMAP, MATLAB and others.

    If a file has several cameras, one is taken whose name, key or topic (``rostopic``) is the name of the
    camera. A file with one camera may have another name.

    Raises
    ------
    IpsysError
        The file cannot be read, or lacks the matrix, the coefficients, the image size or the camera; it has
        another lens model; or its values are not those of a camera.
    """
    file = parse_text(read_text(path), str(path))
    entry = _select(file, path, camera)
    K, D, stated = _form_of(entry).read(entry)
    width, height = _read_size(entry)
    if not K.any():
        raise entry.fault("the camera matrix is zero: this camera was not calibrated", entry.key(_MATRIX))
    model, D, remark = _with_model(entry, D, stated)
    lens = CameraCalibration(time_ns, camera, width, height, model, D, K)
    where = entry.fault("", entry.key((*_MATRIX, "intrinsics"))).args[0].removesuffix(": ")
    return CalibrationFile(check_calibration(lens, where), remark)


def _flatten(value: Any) -> list[float]:
    """Return the numbers in lists of lists, in a matrix of OpenCV, or in a text with spaces or commas."""
    if isinstance(value, Mapping):
        value = value.get("data", ())
    parts = re.split(r"[\s,;]+", value.strip(" []\n;")) if isinstance(value, str) else value
    if isinstance(parts, bool | None):
        raise ValueError("no number")
    if isinstance(parts, int | float):
        return [float(parts)]
    numbers: list[float] = []
    for part in parts:
        # YAML of OpenCV has ".Nan" and "-.Inf".
        is_text = isinstance(part, str) and not re.search(r"[\s,]", part)
        numbers += [float(part.replace(".Nan", "nan").replace(".Inf", "inf"))] if is_text else _flatten(part)
        if len(numbers) > _MOST_NUMBERS:
            raise ValueError("too many numbers")
    return numbers


def _entries(file: ParsedText, path: Path) -> list[_Entry]:
    """Return the cameras of a file: the outermost mappings that have intrinsics."""
    levels: list[tuple[tuple[str, ...], Any]] = [((), file.contents)]
    for _ in range(_MOST_LEVELS):
        mappings = [_entry(file, path, names, value) for names, value in levels if isinstance(value, Mapping)]
        entries = [entry for entry in mappings if any(form.matches(entry) for form in _FORMS)]
        if entries:
            return entries
        levels = [inner for _, value in levels for inner in _inner(value)]
    contents = file.contents if isinstance(file.contents, Mapping) else {}
    return [_entry(file, path, (), contents)] if contents else []


def _inner(value: Any) -> list[tuple[tuple[str, ...], Any]]:
    if isinstance(value, Mapping):
        return [((str(key),), inner) for key, inner in value.items()]
    return [((), inner) for inner in value] if isinstance(value, list) else []


def _entry(file: ParsedText, path: Path, names: tuple[str, ...], values: Mapping[Any, Any]) -> _Entry:
    keys = {re.sub(r"[_ ]", "", str(key)).lower(): str(key) for key in values}
    plain = {name: values[key] for key in values for name in [re.sub(r"[_ ]", "", str(key)).lower()]}
    stated = [
        str(plain[key]) for key in ("name", "cameraname", "cameraid") if plain.get(key) not in (None, "")
    ]
    topic = [parse_foreign_camera(str(plain["rostopic"]))] if plain.get("rostopic") else []
    return _Entry(file, path, (*names, *topic, *stated), plain, keys)


def _select(file: ParsedText, path: Path, camera: str) -> _Entry:
    entries = _entries(file, path)
    if any("dictionary" in entry.values for entry in entries):
        raise IpsysError(f"{path}: is a rig file; name the calibration file of the camera")
    if not entries:
        raise IpsysError(f"{path}: is not a calibration file: this {file.syntax} has no camera matrix")
    matches = [entry for entry in entries if camera in entry.names] or entries
    if len(matches) != 1:
        known = ", ".join(" or ".join(dict.fromkeys(entry.names)) for entry in entries)
        raise IpsysError(
            f"{path}: has the cameras {known}, but not one {camera}; name the camera like one of them, or "
            "keep only its part of the file"
        )
    return matches[0]


def _read_size(entry: _Entry) -> tuple[int, int]:
    """Return width and height in px."""
    width, height, size = entry.key(_WIDTH), entry.key(_HEIGHT), entry.key(_SIZE)
    key = width or size
    if key is None or (width and not height):
        missing = "image_height" if width else "image_width and image_height"
        raise entry.fault(f"the image size is missing; add {missing} in px")
    if width and height:
        sides = [entry.numbers(width, (1,))[0], entry.numbers(height, (1,))[0]]
    else:
        sides = entry.numbers(key, (2,)).tolist()
        if entry.keys[key] == "ImageSize":  # MATLAB has rows and columns
            sides.reverse()
    if not all(1 <= side <= _WIDEST_PX and side == int(side) for side in sides):
        raise entry.fault(f"the image width and height must be 1 to {_WIDEST_PX} pixels", key)
    return int(sides[0]), int(sides[1])


def _read_matrix(entry: _Entry) -> _Lens:
    """Read the form of OpenCV and ROS: a camera matrix, coefficients, and the name of a model."""
    key, coefficients = entry.key(_MATRIX), entry.key(_COEFFICIENTS)
    if key is None:
        raise entry.fault("the camera matrix is missing; add camera_matrix with 9 numbers")
    K = entry.numbers(key, (9,)).reshape(3, 3)
    if coefficients is None:
        raise entry.fault("the distortion coefficients are missing; add distortion_coefficients", key)
    return _Lens(K, entry.numbers(coefficients, ()), _stated_model(entry))


def _read_kalibr(entry: _Entry) -> _Lens:
    """Read the form of Kalibr and EuRoC: fx, fy, cx, cy as ``intrinsics``."""
    projection, model = entry.text(("cameramodel",)), entry.text(("distortionmodel",)) or "none"
    if projection not in ("", "pinhole") or _plain(model) not in _MODEL_OF_NAME:
        raise entry.fault(
            f"the model {projection}-{model} is not read; calibrate with pinhole-equi or pinhole-radtan",
            "cameramodel" if projection not in ("", "pinhole") else "distortionmodel",
        )
    fx, fy, cx, cy = entry.numbers("intrinsics", (4,))
    key = entry.key(_COEFFICIENTS)
    if key is None and model != "none":
        raise entry.fault("the distortion coefficients are missing; add distortion_coeffs", "intrinsics")
    D = np.zeros(5) if key is None or model == "none" else entry.numbers(key, (4, 5))
    return _Lens(np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), D, model)


def _read_colmap(entry: _Entry) -> _Lens:
    model = entry.text(("colmapmodel",))
    if model not in _COLMAP:
        raise entry.fault(f"the model {model} is not read; use one of {', '.join(_COLMAP)}")
    names = _COLMAP[model].split()
    values = dict(zip(names, entry.numbers("params", (len(names),)).tolist(), strict=True))
    return _named_lens(values, model, _COLMAP_ORIGIN_PX)


def _read_openicc(entry: _Entry) -> _Lens:
    inner = _entry(entry.file, entry.path, entry.names, entry.values["intrinsics"])
    values = {key: float(inner.numbers(key, (1,))[0]) for key in inner.values}
    for key, name in (("focallength", "focal_length"), ("principalptx", "principal_pt_x")):
        if key not in values:
            raise inner.fault(f"{name} is missing in intrinsics; add it")
    named = {f"k{number}": values.get(f"radialdistortion{number}", 0.0) for number in range(1, 5)}
    named |= {f"p{number}": values.get(f"tangentialdistortion{number}", 0.0) for number in (1, 2)}
    named |= {"fx": values["focallength"], "fy": values["focallength"] * values.get("aspectratio", 1.0)}
    named |= {
        "cx": values["principalptx"],
        "cy": values.get("principalpty", 0.0),
        "skew": values.get("skew", 0.0),
    }
    return _named_lens(named, entry.text(("intrinsictype",)), 0.0)


def _read_matlab(entry: _Entry) -> _Lens:
    """Read the properties of ``cameraParameters`` and ``cameraIntrinsics``.

    ``IntrinsicMatrix`` is the transpose of the camera matrix, ``K`` is the camera matrix.
    """
    key = entry.key(("k", "intrinsicmatrix"))
    if key is not None:
        K = entry.numbers(key, (9,)).reshape(3, 3)
        K = K.T if key == "intrinsicmatrix" and K[2, :2].any() else K
        values = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "skew": K[0, 1]}
    else:
        values = {"skew": 0.0}
        for key, names in (("focallength", ("fx", "fy")), ("principalpoint", ("cx", "cy"))):
            if key not in entry.values:
                raise entry.fault("IntrinsicMatrix or K is missing; add it")
            values |= zip(names, entry.numbers(key, (2,)).tolist(), strict=True)
    for key, letter, counts in (("radialdistortion", "k", (2, 3)), ("tangentialdistortion", "p", (2,))):
        numbers = entry.numbers(key, counts).tolist() if key in entry.values else []
        values |= {f"{letter}{number}": value for number, value in enumerate(numbers, 1)}
    if "k1" not in values:
        raise entry.fault("the distortion is missing; add RadialDistortion")
    return _named_lens(values, "plumb_bob", _MATLAB_ORIGIN_PX)


def _refuse_scaramuzza(entry: _Entry) -> _Lens:
    raise entry.fault("the model of Scaramuzza is not read; run: ipsys calibrate", "mappingcoefficients")


def _named_lens(values: Mapping[str, float], stated: str, origin_px: float) -> _Lens:
    """Return a lens from its parameters by name, ``f`` or ``fx`` to ``k6``."""
    fx, fy = (values.get(name, values.get("f", 0.0)) for name in ("fx", "fy"))
    cx, cy = values["cx"] - origin_px, values["cy"] - origin_px
    K = np.array([[fx, values.get("skew", 0.0), cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    order = _ORDER.get(_MODEL_OF_NAME.get(_plain(stated), ""), ("k1", "k2", "p1", "p2", "k3"))
    return _Lens(K, np.array([values.get(name, 0.0) for name in order]), stated)


def _stated_model(entry: _Entry) -> str:
    """Return the name of the lens model in a file; empty if it states none."""
    is_fisheye = {"true": "fisheye", "false": "pinhole"}.get(str(entry.values.get("fisheye")).lower(), "")
    return entry.text(_MODEL) or is_fisheye or entry.text(("cameramodel", "cameratype"))


def _with_model(entry: _Entry, D: NDArray[np.float64], stated: str) -> tuple[str, NDArray[np.float64], str]:
    """Return the model in a log, its coefficients, and a remark if the file does not state the model."""
    model, remark = _MODEL_OF_NAME.get(_plain(stated), stated), ""
    key = entry.key(_COEFFICIENTS)
    if not model:
        model = _MODEL_OF_COUNT.get(D.size, "")
        if not model:
            text = f"{D.size} coefficients are those of no known model; add distortion_model"
            raise entry.fault(text, key)
        if D.size == 4:
            remark = (
                f"{entry.path.name} does not state its lens model: its 4 coefficients are read as fisheye "
                "(k1 k2 k3 k4); state it in the file: distortion_model: equidistant, or plumb_bob for "
                "k1 k2 p1 p2"
            )
    elif model not in DISTORTION_MODELS:
        known = "equidistant (fisheye), plumb_bob, rational_polynomial"
        raise entry.fault(
            f"distortion model {stated!r} is not known; known are {known}: "
            "convert the file, or use ipsys calibrate",
            entry.key(_MODEL),
        )
    elif model == "plumb_bob" and D.size in (8, 12, 14) and _plain(stated) == "pinhole":
        model = "rational_polynomial"
    if model == "plumb_bob" and D.size == 4:
        D = np.append(D, 0.0)  # many files leave out k3
    count = DISTORTION_MODELS[model]
    if D.size != count and (D.size < count or D[count:].any()):
        more = " (thin prism or tilted sensor)" if D.size in (12, 14) else ""
        text = f"{stated or model} takes {count} coefficients, found {D.size}{more}; correct the model"
        raise entry.fault(text, key)
    return model, D[:count], remark


def _plain(name: str) -> str:
    return re.sub(r"[-_ ]", "", name).lower()


class _Form(NamedTuple):
    """A form of intrinsics: its name in errors, its keys (all of one tuple), and its reader."""

    name: str
    keys: tuple[tuple[str, ...], ...]
    read: Callable[[_Entry], _Lens]

    def matches(self, entry: _Entry) -> bool:
        return any(all(key in entry.values for key in keys) for keys in self.keys)


_FORMS = (
    _Form("COLMAP cameras.txt", (("colmapmodel",),), _read_colmap),
    _Form("OpenICC", (("intrinsictype", "intrinsics"),), _read_openicc),
    _Form(
        "MATLAB camera parameters",
        (("intrinsicmatrix",), ("focallength", "principalpoint"), ("radialdistortion",)),
        _read_matlab,
    ),
    _Form("MATLAB fisheyeIntrinsics", (("mappingcoefficients",),), _refuse_scaramuzza),
    _Form("EuRoC sensor.yaml", (("sensortype", "intrinsics"),), _read_kalibr),
    _Form("Kalibr camchain", (("intrinsics", "resolution"), ("intrinsics", "cameramodel")), _read_kalibr),
    _Form("Anipose", (("matrix", "distortions"),), _read_matrix),
    _Form("ROS camera_info", (("k", "d"), ("cameraname", "cameramatrix")), _read_matrix),
    _Form("OpenCV", tuple((key,) for key in _MATRIX), _read_matrix),
)


def _form_of(entry: _Entry) -> _Form:
    return next((form for form in _FORMS if form.matches(entry)), _FORMS[-1])
