"""Pictures [S, S, 3] uint8 as files: many on one page, or one after another."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from sdfhub.whole_file import whole_file

_INK, _FAINT, _TILE = (40, 44, 52), (150, 154, 162), (243, 243, 245)
_GAP = 4  # white between pictures, pixels


def contact_sheet(
    rows: Sequence[Sequence[np.ndarray | str]], row_labels: Sequence[str], captions: Sequence[str], path: Path
) -> Path:
    """Writes pictures of one size as a grid, one PNG; a text, such as "no surface", stands for a missing one.

    Row labels and captions may be left out; captions are one text per column, or one per picture.
    """
    size = next((len(image) for row in rows for image in row if not isinstance(image, str)), 256)
    columns, font_size = max(map(len, rows), default=0), max(11, size // 14)
    font, large = ImageFont.load_default(font_size), ImageFont.load_default(max(6, size // 9))
    left = int(max(map(font.getlength, row_labels), default=-14)) + 20
    tall = int(1.35 * font_size * max((caption.count("\n") + 1 for caption in captions), default=0)) + 16
    bands = [tall if any(captions[i * columns :][:columns]) else _GAP for i in range(len(rows))]
    page = Image.new("RGB", (left + columns * (size + _GAP), sum(bands) + len(rows) * size + _GAP), "white")
    top = 0
    for i, (row, band) in enumerate(zip(rows, bands, strict=True)):
        for j, content in enumerate(row):
            tile = Image.new("RGB", (size, band + size), "white")  # cuts long captions off
            draw, pad = ImageDraw.Draw(tile), size // 16
            caption = "".join(captions[i * columns + j :][:1])
            draw.text((4, band / 2), caption, fill=_INK, font=font, anchor="lm")
            if isinstance(content, str):
                draw.rectangle((pad, band + pad, size - pad, band + size - pad), fill=_TILE, outline=_FAINT)
                draw.text((size / 2, band + size / 2), content, fill=_FAINT, font=large, anchor="mm")
            else:
                tile.paste(Image.fromarray(content), (0, band))
            page.paste(tile, (left + j * (size + _GAP), top))
        if row_labels:
            place = 10, top + band + size / 2
            ImageDraw.Draw(page).text(place, row_labels[i], fill=_INK, font=font, anchor="lm")
        top += band + size
    with whole_file(path) as file:
        page.save(file, "PNG")
    return path


def animation(images: Sequence[np.ndarray], path: Path, seconds: float = 2.0) -> Path:
    """Writes pictures as a GIF that takes `seconds` to the last one and back, for ever."""
    palette = Image.fromarray(np.hstack(list(images))).quantize(256)  # one for all, or colours flicker
    frames = [Image.fromarray(image).quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    frames += frames[-2:0:-1]
    duration = round(1000 * seconds / max(1, len(images) - 1))
    with whole_file(path) as file:
        frames[0].save(file, "GIF", save_all=True, append_images=frames[1:], duration=duration, loop=0)
    return path
