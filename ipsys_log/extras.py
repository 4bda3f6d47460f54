"""Optional libraries: the extra of the package that installs each, and the error if one is missing."""

from __future__ import annotations

from importlib.util import find_spec
from typing import NamedTuple

from ipsys_log.errors import IpsysError

__all__ = ["LIBRARIES", "Library", "check_installed"]


class Library(NamedTuple):
    """An optional library: its name in texts, and the extra of ``ipsys_log`` that installs it."""

    name: str
    extra: str


# By the name of the module.
LIBRARIES = {
    "pandas": Library("pandas", "table"),
    "pyarrow": Library("PyArrow", "table"),
    "rerun": Library("Rerun", "view"),
    "matplotlib": Library("Matplotlib", "report"),
    "jinja2": Library("Jinja2", "report"),
    "starlette": Library("Starlette", "web"),
    "uvicorn": Library("Uvicorn", "web"),
    "pymavlink": Library("pymavlink", "mavlink"),
    "zenoh": Library("Zenoh", "ros2"),
    "rosbags": Library("rosbags", "ros2"),
    "xxhash": Library("xxhash", "ros2"),
    "websockets": Library("websockets", "foxglove"),
    "fsspec": Library("fsspec", "remote"),
    "dask": Library("Dask", "batch"),
    "distributed": Library("Dask distributed", "batch"),
    "bokeh": Library("Bokeh", "batch"),
    "cryptography": Library("cryptography", "batch"),
}


def check_installed(subject: str, *modules: str) -> None:
    """Check that the optional libraries of a command, an option or a function are installed.

    The check does not import them. It comes before any work, so a command without its libraries writes
    nothing.

    Parameters
    ----------
    subject : the beginning of the error, with its verb, such as ``view needs``.
    modules : names of modules in ``LIBRARIES``, all of one extra.

    Raises
    ------
    IpsysError
        A library is missing.
    """
    missing = [LIBRARIES[module] for module in modules if find_spec(module) is None]
    if missing:
        names = " and ".join(library.name for library in missing)
        raise IpsysError(f"{subject} {names}: pip install 'ipsys_log[{missing[0].extra}]'")
