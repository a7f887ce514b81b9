"""A package imports only those before it: the order is the product's structure."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import xavatar_jax

SOURCE = Path(xavatar_jax.__file__).parent
LAYERS = (
    *("files", "geometry", "kinematics", "body", "frames", "fields", "correspondence"),
    *("sampling", "losses", "training", "meshing", "export", "metrics", "avatar", "motion"),
    *("baselines", "datasets", "render", "report", "viewer"),
)
# Not packages of the library's stages: they may import everything.
OUTSIDE = {"__init__", "__main__", "cli", "_version"}
# Loaded by the functions that use them, since each takes long to import.
HEAVY = {
    *("trimesh", "scipy", "igl", "embreex", "PIL", "pygltflib", "viser", "torch"),
    *("tyro", "matplotlib"),
}
FILES = sorted(SOURCE.rglob("*.py"))


def module_of(path: Path) -> tuple[str, ...]:
    """Dotted parts below `xavatar_jax`; a package's `__init__` counts as a member of it."""
    return path.relative_to(SOURCE).with_suffix("").parts


def imported(path: Path, tree: ast.AST) -> set[tuple[str, ...]]:
    """Modules of our own that a file imports anywhere, as dotted parts below `xavatar_jax`."""
    found: set[tuple[str, ...]] = set()
    here = module_of(path)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name.split(".") for alias in node.names]
            found |= {tuple(name[1:]) for name in names if name[0] == "xavatar_jax" and name[1:]}
        elif isinstance(node, ast.ImportFrom):
            base = tuple((node.module or "").split(".")) if node.module else ()
            if node.level:
                base = here[: len(here) - node.level] + base
            elif base[:1] == ("xavatar_jax",):
                base = base[1:]
            else:
                continue
            # `from . import x` and `from xavatar_jax import body` name modules by their aliases.
            found |= {base or (alias.name,) for alias in node.names}
    return found


def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def test_every_package_has_a_layer():
    packages = {path.name for path in SOURCE.iterdir() if (path / "__init__.py").exists()}
    assert packages - OUTSIDE == set(LAYERS)


@pytest.mark.parametrize("layer", LAYERS)
def test_a_package_imports_only_earlier_ones(layer):
    wrong = []
    for path in FILES:
        if module_of(path)[0] != layer:
            continue
        for target in imported(path, parsed(path)):
            package = target[0]
            if package in ("_version", layer):
                continue
            if package not in LAYERS or LAYERS.index(package) > LAYERS.index(layer):
                wrong.append(f"{path.relative_to(SOURCE)} imports {'.'.join(target)}")
    assert not wrong, wrong


def test_observed_data_enters_as_arguments():
    """Only the command line and `datasets` itself import `datasets`."""
    users = set()
    for path in FILES:
        if any(target[0] == "datasets" for target in imported(path, parsed(path))):
            users.add(module_of(path)[0])
    assert users <= {"datasets", *OUTSIDE}


def test_heavy_packages_are_imported_inside_functions():
    wrong = []
    for path in FILES:
        for node in parsed(path).body:  # the statements that run on import
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level:
                names = [node.module or ""]
            wrong += [
                f"{path.relative_to(SOURCE)}: {name}"
                for name in names
                if name.split(".")[0] in HEAVY
            ]
    allowed = {name for name in wrong if name.startswith("cli")}
    assert set(wrong) <= allowed, wrong


def test_relative_and_absolute_imports_are_both_understood():
    source = (
        "from ..body import load_body\nfrom . import grids\nfrom .mlp import MLPShape\n"
        "import xavatar_jax.files.meshes\nfrom xavatar_jax.frames import Frame\n"
        "from xavatar_jax import motion\nimport numpy\nfrom numpy import array\n"
        "def f():\n    from ..datasets import grab\n"
    )
    found = imported(SOURCE / "fields" / "skinning.py", ast.parse(source))
    assert found == {
        ("body",), ("fields",), ("fields", "mlp"), ("files", "meshes"), ("frames",),
        ("motion",), ("datasets",),
    }  # fmt: skip
