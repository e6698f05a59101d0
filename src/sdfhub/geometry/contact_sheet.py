"""Many pictures on one page: rows with labels, columns with captions."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from sdfhub.whole_file import whole_file

Font = ImageFont.FreeTypeFont | ImageFont.ImageFont
_INK, _FAINT, _TILE = (40, 44, 52), (150, 154, 162), (243, 243, 245)

GAP = 4  # white between pictures, pixels


def contact_sheet(
    rows: Sequence[Sequence[np.ndarray | str]], row_labels: Sequence[str], captions: Sequence[str], path: Path
) -> Path:
    """Lays pictures out as a grid, writes it as one PNG, whole or not at all, and returns its path.

    Args:
        rows: pictures [S, S, 3] uint8 of one size; a text, such as "no surface", fills a tile.
        row_labels: one text per row; [] for none.
        captions: one text per column, or one per picture, of one or two lines; [] for none.
        path: where the PNG goes; its folder is made.
    """
    size = next((len(image) for row in rows for image in row if not isinstance(image, str)), 256)
    columns = max((len(row) for row in rows), default=0)
    font_size = max(11, size // 14)
    font = ImageFont.load_default(font_size)
    left = int(max((font.getlength(label) for label in row_labels), default=0)) + 20 if row_labels else 6
    line = font_size * 1.35
    top = int(line * max(caption.count("\n") + 1 for caption in captions)) + 16 if captions else 6
    between = top if len(captions) > columns else GAP  # room for captions above the other rows
    lefts = [left + j * (size + GAP) for j in range(columns)]
    tops = [top + i * (size + between) for i in range(len(rows))]
    extent = left + columns * (size + GAP) + 2, top + len(rows) * (size + between) + 2
    page = Image.new("RGB", extent, "white")
    draw = ImageDraw.Draw(page)
    for y, row in zip(tops, rows, strict=True):
        for x, image in zip(lefts, row, strict=False):
            if isinstance(image, str):
                _write_tile(draw, image, x, y, size)
            else:
                page.paste(Image.fromarray(image), (x, y))
    for y, label in zip(tops, row_labels, strict=False):
        draw.text((10, y + 0.5 * size), label, fill=_INK, font=font, anchor="lm")
    for number, caption in enumerate(captions):
        i, j = divmod(number, columns)
        for k, text in enumerate(caption.split("\n")):
            place = lefts[j] + size / 2, tops[i] - top + 8 + (k + 0.5) * line
            draw.text(place, _shortened(text, font, size - 8), fill=_INK, font=font, anchor="mm")
    return write_picture(page, path)


def _write_tile(draw: ImageDraw.ImageDraw, text: str, x: int, y: int, size: int) -> None:
    pad, font = size // 16, ImageFont.load_default(max(6, size // 9))
    draw.rectangle((x + pad, y + pad, x + size - pad, y + size - pad), fill=_TILE, outline=_FAINT)
    draw.text((x + size / 2, y + size / 2), text, fill=_FAINT, font=font, anchor="mm")


def _shortened(text: str, font: Font, width: float) -> str:
    end = ""
    while text and font.getlength(text + end) > width:
        text, end = text[:-1], "…"
    return text + end


def write_picture(picture: Image.Image, path: Path, **settings: Any) -> Path:
    """Writes a picture in the format of the path's suffix, whole or not at all; returns the path."""
    with whole_file(path) as file:
        picture.save(file, format=path.suffix[1:], **settings)
    return path
