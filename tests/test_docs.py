"""Checks of the documentation: links, names, commands, options, tables, figures, versions."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
import json
import re
import sys
from dataclasses import fields, is_dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import xavatar_jax as xa
from xavatar_jax.body import SMPLX_TREE, STANDARD_PARTS, canonical_pose, pose_groups
from xavatar_jax.cli import COMMANDS
from xavatar_jax.cli.options import option_names
from xavatar_jax.motion import FORMATS
from xavatar_jax.motion.registry import WRITERS

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted(
    [
        *(ROOT / n for n in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")),
        ROOT / "THIRD_PARTY_NOTICES.md",
        *(ROOT / "docs").glob("*.md"),
    ]
)
SCRIPTS = sorted([*(ROOT / "examples").glob("*.py"), *(ROOT / "benchmarks").glob("*.py")])

# Pages whose code is run, each block after the previous ones.
RUN_IN_ORDER = ("derivations.md", "extending.md")

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)


def read(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def blocks(page: Path, language: str) -> list[str]:
    """Fenced code blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", read(page), re.DOTALL | re.MULTILINE)


def without_blocks(page: Path) -> str:
    return re.sub(r"^```.*?^```", "", read(page), flags=re.DOTALL | re.MULTILINE)


def headings(page: Path) -> set[str]:
    """Anchors of the headings, as GitHub generates them."""
    titles = re.findall(r"^#+ (.+)$", without_blocks(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", t.lower()).replace(" ", "-") for t in titles}


def table(page: str, heading: str) -> list[list[str]]:
    """Body rows of the first table after a heading, without code marks."""
    text = read(ROOT / "docs" / page).split(f"\n{heading}\n", 1)[1]
    lines = re.search(r"(?:^\|.*\n)+", text, re.MULTILINE)
    assert lines is not None
    rows = [[cell.strip(" `") for cell in line.split("|")[1:-1]] for line in lines[0].splitlines()]
    return rows[2:]


def numbers(text: str) -> set[int]:
    """Parse `0 to 2, 4` to a set."""
    found: set[int] = set()
    for part in filter(str.strip, text.split(",")):
        first, _, last = part.strip().partition(" to ")
        found |= set(range(int(first), int(last or first) + 1))
    return found


def command_options(command: str) -> set[str]:
    """Options of a subcommand of `xavatar`."""
    module = importlib.import_module(f"xavatar_jax.cli.{command}")
    return {"--help", "--debug", *option_names(module.Options).values()}


def config_options() -> set[str]:
    """Options of `xavatar fit` for entries of the config."""

    def entries(config, path):
        for entry in fields(config):
            name = f"{path}.{entry.name.replace('_', '-')}"
            value = getattr(config, entry.name)
            yield from entries(value, name) if is_dataclass(value) else (name,)

    return {"--config.help", *entries(xa.quick(), "--config")}


def script_options(script: Path) -> set[str]:
    """Options of a script: fields of its `Options` dataclass and `add_argument` calls.

    Benchmarks also have the options of benchmark modules they import.
    """
    if script.name == "fit_grab.py":
        return command_options("fit")
    tree = ast.parse(read(script))
    options = {"--help"}
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef) and node.name == "Options":
            fields = [n.target for n in node.body if isinstance(n, ast.AnnAssign)]
            options |= {f"--{f.id.replace('_', '-')}" for f in fields if isinstance(f, ast.Name)}
        if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "add_argument":
            options |= {str(a.value) for a in node.args if isinstance(a, ast.Constant)}
        if isinstance(node, ast.ImportFrom) and script.parent.name == "benchmarks":
            beside = script.parent / f"{node.module}.py"
            options |= script_options(beside) if beside.is_file() else set()
    return options


@each_page
def test_relative_links_have_targets(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", without_blocks(page)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name} links to {target}"
        if anchor:
            assert anchor in headings(file), f"{page.name} links to {target}"


@each_page
def test_named_parts_of_the_library_exist(page):
    names = set(re.findall(r"\bxa\.(\w+)", read(page)))
    assert not [name for name in names if not hasattr(xa, name)]


@each_page
def test_named_modules_exist(page):
    for dotted in set(re.findall(r"`(xavatar_jax(?:\.\w+)+)`", read(page))):
        parent, _, name = dotted.rpartition(".")
        is_module = importlib.util.find_spec(parent) and importlib.util.find_spec(dotted)
        assert is_module or hasattr(importlib.import_module(parent), name), dotted


@each_page
def test_python_blocks_parse_and_import_what_they_use(page):
    imported: set[str] = set()
    for block in blocks(page, "python"):
        tree = ast.parse(block)
        # On other pages each block must be self-contained.
        imported = imported if page.name in RUN_IN_ORDER else set()
        imported |= {
            alias.asname or alias.name.split(".")[0]
            for node in ast.walk(tree)
            if isinstance(node, ast.Import)
            for alias in node.names
        }
        used = {node.value.id for node in ast.walk(tree) if _is_module_use(node)}
        assert used & {"xa", "np", "jnp", "jax"} <= imported


def _is_module_use(node: ast.AST) -> bool:
    return isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)


@each_page
def test_commands_name_files_and_options_that_exist(page):
    for line in "".join(blocks(page, "bash")).splitlines():
        for script in re.findall(r"(?:examples|benchmarks|docs)/[\w/]+\.py", line):
            assert (ROOT / script).is_file(), line
            options = set(re.findall(r"\s(--[\w-]+)", line.split(script, 1)[1]))
            assert options <= script_options(ROOT / script), line


@each_page
def test_commands_of_xavatar_exist_with_their_options(page):
    for line in "".join(blocks(page, "bash")).splitlines():
        found = re.search(r"\bxavatar (\w+)(.*)", line)
        if found is None:
            continue
        assert found[1] in COMMANDS, line
        options = set(re.findall(r"\s(--[\w.-]+)", found[2]))
        assert options <= command_options(found[1]) | config_options(), line


@each_page
def test_options_named_in_sentences_exist(page):
    known = set().union(*(script_options(script) for script in SCRIPTS), config_options())
    known |= set().union(*map(command_options, COMMANDS))
    named = set(re.findall(r"`(--[\w.-]+)", without_blocks(page)))
    assert named <= known


def test_command_page_shows_every_command():
    page = ROOT / "docs" / "command-line.md"
    rows = table("command-line.md", "## Commands")
    assert [row[0] for row in rows] == list(COMMANDS)
    shown = set(re.findall(r"xavatar (\w+)", "".join(blocks(page, "bash"))))
    assert shown == set(COMMANDS)


def test_option_page_names_every_option_of_the_example():
    page = read(ROOT / "docs" / "options.md")
    options = script_options(ROOT / "examples" / "fit_grab.py") - {"--preset", "--quiet", "--debug"}
    assert not [option for option in sorted(options) if option not in page]


def test_readme_has_two_self_contained_commands():
    commands = [b for b in blocks(ROOT / "README.md", "bash") if b.startswith("python3 -m venv")]
    assert [c.split(" && ")[-1].strip() for c in commands] == [
        ".venv/bin/python examples/fit_grab.py",
        ".venv/bin/python -m pytest",
    ]
    # CI finds the second command by this pattern.
    assert "grep -E '^python3 .*-m pytest$' README.md" in read(ROOT / ".ci" / "run")
    assert re.search(r"^python3 .*-m pytest$", read(ROOT / "README.md"), re.MULTILINE)


def test_joint_table_is_the_tree():
    rows = table("conventions.md", "## Joints")
    assert [int(r[0]) for r in rows] == list(range(SMPLX_TREE.num_joints))
    assert tuple(r[1] for r in rows) == SMPLX_TREE.names
    assert tuple(int(r[2]) for r in rows) == SMPLX_TREE.parents
    groups = pose_groups(SMPLX_TREE)
    assert all(int(r[0]) in groups[r[3]] for r in rows)


def test_pose_table_is_the_parameter_names():
    rows = table("conventions.md", "## Body parameters")
    assert [r[0] for r in rows] == ["pose", "betas", "expression", "transl"]
    text = read(ROOT / "docs" / "conventions.md")
    listed = re.findall(r"^\| `(\w+)` \| (\d+) \| ([\d to,]+) \|$", text, re.MULTILINE)
    groups = pose_groups(SMPLX_TREE)
    assert {name for name, _, _ in listed} == set(groups)
    for name, count, joints in listed:
        assert int(count) == 3 * len(groups[name])
        assert numbers(joints) == set(groups[name])


def test_part_table_is_the_start_groups():
    rows = table("conventions.md", "## Parts")
    groups = xa.part_groups(SMPLX_TREE)
    assert [r[1] for r in rows] == [*(part.name for part in STANDARD_PARTS), "full"]
    assert [r[0] for r in rows] == [*map(str, range(len(STANDARD_PARTS))), ""]
    paper = xa.part_groups(SMPLX_TREE, "paper")
    for _, part, bones, more, joints, count in rows:
        assert numbers(bones) == set(paper[part].bones)
        assert numbers(bones) | numbers(more) == set(groups[part].bones)
        assert numbers(joints) == set(groups[part].joints)
        assert int(count) == len(groups[part].bones) + len(groups[part].joints)


def test_canonical_table_is_the_canonical_pose(family):
    rows = table("conventions.md", "## Canonical space")
    pose = np.zeros((SMPLX_TREE.num_joints, 3))
    for joint, vector in [(r[0], r[1]) for r in rows if r[0] in SMPLX_TREE.names]:
        values = vector.strip("()").replace("π/6", str(np.pi / 6))
        pose[SMPLX_TREE.index(joint)] = [float(v) for v in values.split(",")]
    np.testing.assert_allclose(canonical_pose(family["smplx"]), pose, atol=1e-7)


def test_motion_tables_are_the_formats():
    rows = table("motion.md", "## Formats that are read")
    assert [row[0] for row in rows] == list(FORMATS)
    rows = table("motion.md", "## Formats that are written")
    assert [row[0] for row in rows] == list(WRITERS)


def test_packages_import_only_those_above_them():
    order = [row[0] for row in table("how-it-works.md", "## Where things are")]
    order = [name for cell in order for name in re.findall(r"\w+", cell)]
    source = ROOT / "src" / "xavatar_jax"
    assert sorted(order) == sorted(p.name for p in source.iterdir() if (p / "__init__.py").exists())
    for name in order:
        for file in (source / name).rglob("*.py"):
            allowed = {*order[: order.index(name) + 1], "_version"}
            assert _imported_packages(file, source) <= allowed, file.relative_to(ROOT)


def _imported_packages(file: Path, source: Path) -> set[str]:
    """Packages of this project that a file imports, also inside functions."""
    inside = ("xavatar_jax", *file.relative_to(source).parent.parts)
    found: set[str] = set()
    for node in ast.walk(ast.parse(read(file))):
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = inside[: len(inside) - node.level + 1] if node.level else ()
            modules = [".".join([*base, *(node.module.split(".") if node.module else [])])]
            if modules == ["xavatar_jax"]:
                modules = [f"xavatar_jax.{alias.name}" for alias in node.names]
        else:
            continue
        found |= {m.split(".")[1] for m in modules if m.startswith("xavatar_jax.")}
    return found


def test_generated_tables_match_the_stored_results():
    spec = importlib.util.spec_from_file_location(
        "figures_update", ROOT / "docs" / "figures" / "update.py"
    )
    assert spec is not None
    assert spec.loader is not None
    update = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(update)
    for name in update.TEXTS:
        text = read(ROOT / name)
        assert "<!-- figures: " in text
        assert update.filled(text) == text, f"{name}: run docs/figures/update.py"


@pytest.mark.parametrize("file", sorted((ROOT / "docs" / "figures").glob("*.json")), ids=str)
def test_stored_results_contain_no_paths(file):
    def strings(value):
        if isinstance(value, dict):
            value = value.values()
        if isinstance(value, str):
            yield value
        elif not isinstance(value, int | float | None):
            for item in value:
                yield from strings(item)

    assert not [s for s in strings(json.loads(read(file))) if "/" in s and "points/s" not in s]


@pytest.mark.parametrize("name", RUN_IN_ORDER)
def test_code_of_pages_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for k, block in enumerate(blocks(ROOT / "docs" / name, "python")):
        exec(compile(block, f"{name}, block {k + 1}", "exec"), names)


NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def cells(notebook: Path, kind: str) -> list[str]:
    document = json.loads(read(notebook))
    return ["".join(c["source"]) for c in document["cells"] if c["cell_type"] == kind]


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebooks_are_small_and_use_public_names_only(notebook):
    assert notebook.stat().st_size < 30_000
    document = json.loads(read(notebook))
    assert document["nbformat"] == 4
    assert not [c for c in document["cells"] if c.get("outputs") or c.get("execution_count")]
    tree = ast.parse("\n".join(cells(notebook, "code")))
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "xa":
            assert node.attr in PUBLIC["xavatar_jax"], node.attr
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("xavatar_jax"):
            assert {a.name for a in node.names} <= PUBLIC[str(node.module)], node.module
    for target in re.findall(r"\]\(([^)]+)\)", "\n".join(cells(notebook, "markdown"))):
        assert (notebook.parent / target).exists(), target


def test_notebooks_are_listed_and_run():
    page, runner = (read(ROOT / p) for p in ("docs/notebooks.md", ".ci/run_notebooks.py"))
    for notebook in NOTEBOOKS:
        assert f"(../notebooks/{notebook.name})" in page
        assert f'"{notebook.stem}"' in runner


def public_names() -> dict[str, set[str]]:
    """Names that the package and its subpackages, at any depth, import `as` themselves."""
    source = ROOT / "src" / "xavatar_jax"
    found = {}
    for file in sorted(source.rglob("__init__.py")):
        dotted = ".".join(file.parent.relative_to(source.parent).parts)
        aliases = [
            alias.name
            for node in ast.walk(ast.parse(read(file)))  # some are inside `if TYPE_CHECKING`
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
            if alias.asname == alias.name and not alias.name.startswith("_")
        ]
        found[dotted] = set(aliases)
    return found


PUBLIC = public_names()


def constant_docstrings(package: str) -> set[str]:
    """Constants of a package's modules that are documented by a string below them."""
    folder = Path(str(sys.modules[package].__file__)).parent
    found = set()
    for file in folder.rglob("*.py"):
        body = ast.parse(read(file)).body
        for node, after in pairwise(body):
            target = node.targets[0] if isinstance(node, ast.Assign) else None
            target = node.target if isinstance(node, ast.AnnAssign) else target
            text = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            if isinstance(target, ast.Name) and text:
                found.add(target.id)
    return found


@pytest.mark.parametrize("package", [p for p in PUBLIC if p != "xavatar_jax"])
def test_every_public_name_has_a_docstring(package):
    module = importlib.import_module(package)
    assert (module.__doc__ or "").strip()
    constants = constant_docstrings(package)
    missing = []
    for name in sorted(PUBLIC[package]):
        value = getattr(module, name)
        if name in constants:
            continue
        if inspect.isfunction(value):
            missing += [] if value.__doc__ else [name]
        elif inspect.isclass(value):
            # A dataclass without a docstring gets its signature as one.
            own = value.__doc__ and not value.__doc__.startswith(f"{name}(")
            missing += [] if own else [name]
            missing += [f"{name}.{member}" for member in _undocumented_members(value)]
        elif not (hasattr(value, "__wrapped__") and value.__doc__):
            missing.append(name)
    assert not missing


def _undocumented_members(kind: type) -> list[str]:
    """Public methods and properties without a docstring, inherited ones included."""
    found = []
    # The docstring of a protocol may describe its members.
    described = set()
    if getattr(kind, "_is_protocol", False):
        described = set(re.findall(r"`(\w+)`", kind.__doc__ or ""))
    defaults = {field.name for field in fields(kind)} if is_dataclass(kind) else set()
    for name, member in vars(kind).items():
        if name in defaults | described:  # the default of a field may be a function
            continue
        function = getattr(member, "fget", None) or getattr(member, "func", None) or member
        function = getattr(function, "__func__", function)
        written_here = inspect.isfunction(function) and function.__module__ == kind.__module__
        if not name.startswith("_") and written_here and not inspect.getdoc(getattr(kind, name)):
            found.append(name)
    return found


def test_top_level_names_are_in_the_reference():
    elsewhere = set().union(*(names for p, names in PUBLIC.items() if p != "xavatar_jax"))
    assert PUBLIC["xavatar_jax"] <= elsewhere


def test_the_site_lists_every_page():
    listed = set(re.findall(r"[\w/-]+\.md\b", read(ROOT / "mkdocs.yml").split("\nnav:", 1)[1]))
    pages = {p.name for p in (ROOT / "docs").glob("*.md")}
    made = {"readme.md", "changelog.md", "contributing.md", "third-party-notices.md"}
    assert listed == pages | made | {"api/index.md"}


def test_command_runner_has_no_stale_commands():
    spec = importlib.util.spec_from_file_location("commands", ROOT / ".ci" / "run_commands.py")
    assert spec is not None
    assert spec.loader is not None
    runner = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(runner)
    assert not sorted(set(runner.HOW) - set(runner.commands()))


def test_versions_agree():
    cited = re.search(r"^version: (\S+)$", read(ROOT / "CITATION.cff"), re.MULTILINE)
    assert cited is not None
    assert cited[1] == xa.__version__
    changes = read(ROOT / "CHANGELOG.md")
    assert "## [Unreleased]" in changes or f"## [{xa.__version__}]" in changes


def test_notices_list_every_dependency():
    project = re.search(r"^dependencies = \[\n(.*?)^\]", read(ROOT / "pyproject.toml"), re.M | re.S)
    assert project is not None
    names = re.findall(r'^\s*"([\w-]+)', project[1], re.MULTILINE)
    assert len(names) > 10
    notices = read(ROOT / "THIRD_PARTY_NOTICES.md")
    assert not [name for name in names if not re.search(rf"^\| .*\b{name}\b", notices, re.M)]
