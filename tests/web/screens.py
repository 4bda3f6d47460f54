"""Pictures of pages for the documentation: the first screen, with fewer colours, so that files are small."""

from pathlib import Path

from PIL import Image

from tests.web.phone import Phone

_COLOURS = 256


def save_screen(browser: Phone, path: Path, most_px: int) -> str:
    """Save the present page as PNG, at most ``most_px`` high; return a line with its size."""
    browser.picture(path)
    with Image.open(path) as image:
        shown = (
            image.convert("RGB")
            .crop((0, 0, image.width, min(image.height, most_px)))
            .quantize(_COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        )
    shown.save(path, optimize=True)
    return f"{path} written: {path.stat().st_size / 1000:.0f} kB"
