"""Pictures one after another: an animated GIF that goes there and back."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from sdfhub.geometry.contact_sheet import write_picture


def animation(images: Sequence[np.ndarray], path: Path, seconds: float = 2.0) -> Path:
    """Writes pictures as a GIF that runs to the last and back again, for ever; whole or not at all.

    Args:
        images: [S, S, 3] uint8, of one size; at least one.
        path: where the GIF goes; its folder is made.
        seconds: from the first to the last.

    Returns:
        The path written.
    """
    there = [Image.fromarray(image) for image in images]
    frames = there + there[-2:0:-1]
    palette = Image.fromarray(np.hstack(list(images))).quantize(256)  # one for all, or colours flicker
    frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    duration = round(1000 * seconds / max(1, len(images) - 1))
    rest = {"save_all": True, "append_images": frames[1:], "duration": duration, "loop": 0}
    return write_picture(frames[0], path, **rest)
