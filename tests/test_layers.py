"""A package imports only those before it: the order is the product's structure."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import xavatar_jax

SOURCE = Path(xavatar_jax.__file__).parent
LAYERS = (
    *("files", "geometry", "kinematics", "body", "motion", "meshing", "render", "export"),
    *("frames", "fields", "correspondence", "sampling", "datasets", "learning", "metrics"),
    *("avatar", "methods", "synthetic", "report", "viewer"),
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


def test_the_training_loop_knows_no_body_field_or_method():
    users = {
        target[0]
        for path in FILES
        if module_of(path)[0] == "learning"
        for target in imported(path, parsed(path))
    }
    assert users <= {"_version", "files", "learning"}


def file_imports(path: Path) -> set[Path]:
    """Files of ours that a file imports anywhere: names come from the modules that define them."""
    found = set()
    here = module_of(path)
    for node in ast.walk(parsed(path)):
        if not isinstance(node, ast.ImportFrom):
            continue
        base = tuple(node.module.split(".")) if node.module else ()
        if node.level:
            base = here[: len(here) - node.level] + base
        elif base[:1] == ("xavatar_jax",):
            base = base[1:]
        else:
            continue
        for alias in node.names:
            for parts in ((*base, alias.name), base):
                module = SOURCE.joinpath(*parts)
                file = module / "__init__.py" if module.is_dir() else module.with_suffix(".py")
                if file.exists():
                    found.add(file)
                    break
    return found - {path}


def cycles(imports: dict[Path, set[Path]]) -> list[list[str]]:
    """Groups of files that import each other, in some order (Tarjan, 1972)."""
    order: dict[Path, int] = {}
    low: dict[Path, int] = {}
    stack: list[Path] = []
    found = []

    def visit(file: Path) -> None:
        order[file] = low[file] = len(order)
        stack.append(file)
        for target in sorted(imports.get(file, ())):
            if target not in order:
                visit(target)
            if target in stack:
                low[file] = min(low[file], low[target])
        if low[file] == order[file]:
            group = stack[stack.index(file) :]
            del stack[stack.index(file) :]
            if len(group) > 1:
                found.append(sorted(str(f) for f in group))

    for file in sorted(imports):
        if file not in order:
            visit(file)
    return found


def test_no_files_import_each_other():
    """Anywhere: at the top, in functions, and for type checkers alone."""
    top = {SOURCE / "__init__.py", SOURCE / "__main__.py"}  # it names everything, when asked
    assert cycles({path: file_imports(path) - top for path in FILES if path not in top}) == []


def test_cycles_are_found():
    a, b, c, d = (Path(name) for name in "abcd")
    assert cycles({a: {b}, b: {c}, c: {b, d}, d: set()}) == [["b", "c"]]
    assert cycles({a: {b, c}, b: {d}, c: {d}, d: set()}) == []


def test_observed_data_enters_as_arguments():
    """Only the command line, `synthetic` and `datasets` itself import `datasets`."""
    users = set()
    for path in FILES:
        if any(target[0] == "datasets" for target in imported(path, parsed(path))):
            users.add(module_of(path)[0])
    assert users <= {"datasets", "synthetic", *OUTSIDE}


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


def test_only_users_of_the_bundled_person_import_it():
    users = {
        module_of(path)[0]
        for path in FILES
        if any(target[0] == "synthetic" for target in imported(path, parsed(path)))
    }
    assert users <= {"synthetic", "cli", "__init__"}
