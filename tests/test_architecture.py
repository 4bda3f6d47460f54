"""The drawing of the layers in the documentation shows the imports of the present source."""

import runpy

from tests.conftest import ROOT

_SCRIPT = runpy.run_path(str(ROOT / "scripts" / "draw-architecture"))
_LAYERS = _SCRIPT["read_layers"](_SCRIPT["LAYERS"])


def test_drawing_equals_the_imports_of_the_source() -> None:
    drawn = _SCRIPT["draw"](_LAYERS, _SCRIPT["read_imports"](_SCRIPT["PACKAGE"]))
    assert drawn == _SCRIPT["TARGET"].read_text(), "run scripts/draw-architecture"
