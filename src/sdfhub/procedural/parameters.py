"""How a design's parameters are declared and drawn.

A category is a frozen dataclass: a field is a `continuous` number within a range or a `choice` of options.
"""

from dataclasses import field, fields

import numpy as np


def continuous(low: float, high: float):
    """A float field drawn uniformly from [low, high)."""
    return field(metadata={"range": (low, high)})


def choice(*options):
    """A field drawn from `options`, each as likely as the others; repeat one to favour it."""
    return field(metadata={"options": options})


def draw(design: type, rng: np.random.Generator):
    """One design with every field drawn in the order of declaration."""
    values = {}
    for f in fields(design):
        options = f.metadata.get("options", ())
        number = rng.integers(len(options)) if options else rng.uniform(*f.metadata["range"])
        values[f.name] = options[int(number)] if options else float(number)
    return design(**values)
