"""Screenshots against references: mean colours of blocks, which fonts and rasterisers keep.

A screenshot leaves its blocks in out/browser/blocks. Who has looked at it and finds it right copies
them to tests/browser/references.
"""

import io
from pathlib import Path

import numpy as np
from PIL import Image

REPOSITORY = Path(__file__).resolve().parents[2]
PICTURES = REPOSITORY / "out" / "browser"
REFERENCES = Path(__file__).parent / "references"
BLOCK = 32  # pixels
APART = 30.0  # of 255: what blocks of one view may differ by, elsewhere


def blocks(screenshot: Image.Image) -> Image.Image:
    """Mean colours of blocks; what is left over at the ends is cut off."""
    size = screenshot.width // BLOCK, screenshot.height // BLOCK
    whole = screenshot.convert("RGB").crop((0, 0, size[0] * BLOCK, size[1] * BLOCK))
    return whole.resize(size, Image.Resampling.BOX)


def difference(seen: Image.Image, name: str) -> float:
    """Of the block and the colour that differ most from the reference of a name."""
    file = REFERENCES / f"{name}.png"
    assert file.exists(), f"no reference: look at out/browser, and copy blocks/{name}.png"
    wanted = Image.open(file).convert("RGB")
    assert seen.size == wanted.size
    return float(np.abs(np.asarray(seen, float) - np.asarray(wanted, float)).max())


def apart(png: bytes, name: str) -> float:
    """How far a screenshot is from the reference of a name; its blocks are kept under that name."""
    seen = blocks(Image.open(io.BytesIO(png)))
    (PICTURES / "blocks").mkdir(exist_ok=True, parents=True)
    seen.save(PICTURES / "blocks" / f"{name}.png", optimize=True)
    return difference(seen, name)
