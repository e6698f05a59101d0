"""The name rules of every category, as conf/category states them."""

from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]
NAMES = ("chairs", "lamps", "planes", "sofas", "tables")
CATEGORIES = {
    name: settings
    for file in NAMES
    for name, settings in yaml.safe_load((ROOT / "conf" / "category" / f"{file}.yaml").read_text()).items()
}
