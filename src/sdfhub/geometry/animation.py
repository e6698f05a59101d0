"""Animated GIFs that run forth and back."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from sdfhub.geometry.contact_sheet import write_picture


def animation(images: Sequence[np.ndarray], path: Path, seconds: float = 2.0) -> Path:
    """Writes pictures [S, S, 3] uint8 as a GIF that takes `seconds` to the last one and back, for ever."""
    palette = Image.fromarray(np.hstack(list(images))).quantize(256)  # one for all, or colours flicker
    frames = [Image.fromarray(image).quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    frames += frames[-2:0:-1]
    duration = round(1000 * seconds / max(1, len(images) - 1))
    return write_picture(frames[0], path, save_all=True, append_images=frames[1:], duration=duration, loop=0)
