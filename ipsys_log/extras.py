"""Optional libraries: the extras of the package that install each, and the error if one is missing."""

from importlib.util import find_spec
from typing import NamedTuple

from ipsys_log.errors import IpsysError


class Library(NamedTuple):
    """An optional library: its name in texts, and the extras of ``ipsys_log`` that install it."""

    name: str
    extras: tuple[str, ...]


# By the name of the module.
LIBRARIES = {
    "pandas": Library("pandas", ("table",)),
    "pyarrow": Library("PyArrow", ("table",)),
    "rerun": Library("Rerun", ("view",)),
    "matplotlib": Library("Matplotlib", ("report",)),
    "jinja2": Library("Jinja2", ("report",)),
    "av": Library("PyAV", ("video",)),
    "starlette": Library("Starlette", ("web",)),
    "uvicorn": Library("Uvicorn", ("web",)),
    "h11": Library("h11", ("web",)),
    "pymavlink": Library("pymavlink", ("mavlink",)),
    "zenoh": Library("Zenoh", ("nodes", "ros2")),
    "rosbags": Library("rosbags", ("ros2",)),
    "xxhash": Library("xxhash", ("ros2",)),
    "c3d": Library("c3d", ("mocap",)),
    "websockets": Library("websockets", ("foxglove",)),
    "fsspec": Library("fsspec", ("remote",)),
    "dask": Library("Dask", ("batch",)),
    "distributed": Library("Dask distributed", ("batch",)),
    "bokeh": Library("Bokeh", ("batch",)),
    "cryptography": Library("cryptography", ("batch",)),
}


def check_installed(subject: str, *modules: str) -> None:
    """Check that the optional libraries of a command, an option or a function are installed.

    The check does not import them. It comes before any work, so a command without its libraries writes
    nothing.

    Parameters
    ----------
    subject : the beginning of the error, with its verb, such as ``view needs``.
    modules : names of modules in ``LIBRARIES``. The error names the first extra that has all of them.
    """
    missing = [LIBRARIES[module] for module in modules if find_spec(module) is None]
    if missing:
        names = " and ".join(library.name for library in missing)
        first, *others = (LIBRARIES[module].extras for module in modules)
        extra = next(name for name in first if all(name in extras for extras in others))
        raise IpsysError(f"{subject} {names}: pip install 'ipsys_log[{extra}]'")
