"""The rules of the house: which way imports point, how files are named, how long they may be."""

import ast
import re
from collections.abc import Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "sdfhub"
FILES = sorted(SOURCE.rglob("*.py"))
FRAMEWORK = ("hydra", "omegaconf", "sdfhub.composition", "sdfhub.tasks", "sdfhub.report", "sdfhub.multirun")
FORBIDDEN_IMPORTS = {
    "procedural": (*FRAMEWORK, "sdfhub.model", "sdfhub.geometry", "sdfhub.data"),
    "geometry": (*FRAMEWORK, "sdfhub.model", "sdfhub.data"),
    "model": (*FRAMEWORK, "sdfhub.geometry", "sdfhub.data", "sdfhub.latent"),
    "data": (*FRAMEWORK, "sdfhub.model", "sdfhub.latent", "sdfhub.scans"),
    "latent": (*FRAMEWORK, "sdfhub.scans", "sdfhub.space", "sdfhub.opening"),
    "scans": (*FRAMEWORK, "sdfhub.space", "sdfhub.opening"),
    "space.py": FRAMEWORK,
    "opening.py": FRAMEWORK,
    "report": ("hydra", "omegaconf", "sdfhub.tasks", "sdfhub.model"),
}
FORBIDDEN_NAMES = {"utils", "util", "helpers", "helper", "manager", "base", "common"}
AT_TOP = (ast.Import, ast.ImportFrom)
MACHINE_PATH = re.compile(r"""["'`(\s=](/(?:home|work|tmp|root|Users|mnt|data|opt|scratch)/\w|[A-Z]:\\\w)""")


def ids(path: Path) -> str:
    return str(path.relative_to(ROOT))


def imported_modules(path: Path) -> set[str]:
    """Absolute names of all that a file imports, wherever in the file it does so."""
    nodes = ast.walk(ast.parse(path.read_text()))
    return imported_by(nodes, list(path.relative_to(SOURCE.parent).parent.parts))


def imported_by(nodes: Iterable[ast.AST], package: list[str]) -> set[str]:
    """Absolute names of what import statements of a package's file import."""
    names = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            start = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*start, *([node.module] if node.module else [])])
            names |= {f"{module}.{alias.name}" for alias in node.names}
    return names


def test_there_are_files_to_judge():
    assert len(FILES) > 10 and all((SOURCE / part).exists() for part in FORBIDDEN_IMPORTS)


def test_imports_point_down():
    wrong = [
        f"{ids(path)} imports {name}"
        for path in FILES
        for name in imported_modules(path)
        for forbidden in FORBIDDEN_IMPORTS.get(path.relative_to(SOURCE).parts[0], ())
        if name == forbidden or name.startswith(f"{forbidden}.")
    ]
    assert not wrong


@pytest.mark.parametrize("name", ["errors", "settings", "shapes"])
def test_the_seams_import_no_part_of_the_house(name):
    assert not [n for n in imported_modules(SOURCE / f"{name}.py") if n.startswith("sdfhub")]


def test_the_import_parser_sees_every_form(tmp_path, monkeypatch):
    monkeypatch.setitem(globals(), "SOURCE", tmp_path / "sdfhub")
    path = tmp_path / "sdfhub" / "data" / "x.py"
    path.parent.mkdir(parents=True)
    path.write_text("import a.b\nfrom c import d\ndef f():\n    from ..model import e\n    from . import g\n")
    assert imported_modules(path) == {"a.b", "c.d", "sdfhub.model.e", "sdfhub.data.g"}


def test_a_module_is_named_for_the_thing_in_it_and_short():
    for path in FILES:
        parts = path.relative_to(SOURCE).parts
        assert not FORBIDDEN_NAMES & {part.removesuffix(".py") for part in parts}, ids(path)
        assert len(path.read_text().splitlines()) <= 350, ids(path)


def imported_at_start(module: str) -> set[str]:
    """All that importing a module of the house imports, as far as the house's own files say so."""
    found, waiting = set(), [module]
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        found.add(name)
        waiting += [name.rpartition(".")[0]] * ("." in name)
        file = SOURCE.parent.joinpath(*name.split("."))
        file = file / "__init__.py" if file.is_dir() else file.with_suffix(".py")
        if name.startswith("sdfhub") and file.is_file():
            top = [node for node in ast.parse(file.read_text()).body if isinstance(node, AT_TOP)]
            waiting += imported_by(top, list(file.relative_to(SOURCE.parent).parent.parts))
    return found


def test_a_training_starts_without_slow_packages():
    """Hydra imports the callback of sweeps whenever it starts."""
    imported = imported_at_start("sdfhub.tasks.train") | imported_at_start("sdfhub.multirun.sweep")
    assert {"torch", "sdfhub.data.store.store", "sdfhub.data.loading"} <= imported
    assert imported.isdisjoint({"trimesh", "tensorboard", "jinja2", "playwright", "viser"})


def test_train_is_at_most_15_lines():
    assert len((ROOT / "train.py").read_text().splitlines()) <= 15


def test_no_file_mentions_a_path_of_one_machine():
    assert not [ids(path) for path in FILES if MACHINE_PATH.search(path.read_text())]
