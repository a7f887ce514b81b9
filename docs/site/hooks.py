"""MkDocs hooks: add README and other project files, generate the reference, render formulas.

The Markdown files stay readable in the repository. Links to files outside docs/ are rewritten to
the corresponding page of the site. Formulas become MathML, so pages load no scripts.
"""

from __future__ import annotations

import ast
import html
import os
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "src" / "xavatar_jax"
# Project files outside docs/, by their page on the site.
TEXTS = {
    "readme.md": "README.md",
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "third-party-notices.md": "THIRD_PARTY_NOTICES.md",
}
# Linked files that are copied unchanged.
FILES = (
    "LICENSE",
    "CITATION.cff",
    *(f"notebooks/{path.name}" for path in sorted((ROOT / "notebooks").glob("*.ipynb"))),
)
_LINK = re.compile(r"(!?\[[^\]]*\]\()([^)\s#]+)(#[^)\s]*)?\)")
_CODE = re.compile(r"(^```.*?^```|`[^`\n]+`)", re.DOTALL | re.MULTILINE)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the reference pages to the navigation."""
    for item in config.nav or []:
        if "Reference" in item:
            pages = sorted(name for name in reference_pages() if name != "api/index.md")
            item["Reference"] = ["api/index.md", *pages]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the project files, linked files and the reference."""
    for page, source in TEXTS.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=text))
    for name in FILES:
        files.append(File.generated(config, _site_path(name), abs_src_path=str(ROOT / name)))
    for name, text in reference_pages().items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, *, page: Page, **_: Any) -> str:
    """Rewrite links to files outside docs/ to their page on the site."""
    uri = page.file.src_uri
    where = Path(TEXTS[uri]).parent if uri in TEXTS else Path("docs") / Path(uri).parent

    def rewritten(match: re.Match[str]) -> str:
        head, target, anchor = match[1], match[2], match[3] or ""
        if re.match(r"[a-z]+:", target):
            return match[0]
        path = os.path.normpath(where / target).replace(os.sep, "/")
        on_site = _site_path(path)
        here = os.path.dirname(uri) or "."
        return f"{head}{os.path.relpath(on_site, here).replace(os.sep, '/')}{anchor})"

    # Skip code, where indexing followed by a call looks like a link.
    parts = _CODE.split(markdown)
    return "".join(p if k % 2 else _LINK.sub(rewritten, p) for k, p in enumerate(parts))


def on_page_content(content: str, **_: Any) -> str:
    """Convert formulas to MathML."""
    content = re.sub(
        r'<div class="arithmatex">\\\[(.*?)\\\]</div>',
        lambda m: convert(html.unescape(m[1]).strip(), display="block"),
        content,
        flags=re.DOTALL,
    )
    return re.sub(
        r'<span class="arithmatex">\\\((.*?)\\\)</span>',
        lambda m: convert(html.unescape(m[1]).strip()),
        content,
        flags=re.DOTALL,
    )


def _site_path(path: str) -> str:
    """Path on the site of a file of the repository."""
    for page, source in TEXTS.items():
        if path == source:
            return page
    return path.removeprefix("docs/")


def packages() -> list[str]:
    """The package and its subpackages at any depth, as dotted names."""
    folders = [path.parent for path in sorted(PACKAGE.rglob("__init__.py"))]
    return [".".join(folder.relative_to(PACKAGE.parent).parts) for folder in folders]


def source_of(module: str) -> tuple[ast.Module, bool]:
    """The parsed source of a module, and whether it is a package."""
    path = PACKAGE.parent.joinpath(*module.split("."))
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return ast.parse(file.read_text(encoding="utf-8")), path.is_dir()


def imported_names(package: str) -> dict[str, str]:
    """Names that a package imports `as` themselves, which are public, and their modules."""
    found = {}
    # Those of the top-level package are inside `if TYPE_CHECKING`.
    for node in ast.walk(source_of(package)[0]):
        if isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            base = parts[: len(parts) - node.level + 1]
            for alias in node.names:
                if alias.asname == alias.name and not alias.name.startswith("_"):
                    found[alias.name] = ".".join([*base, node.module or ""])
    return found


def defining_module(module: str, name: str) -> str:
    """The module that defines a name, following imports of packages."""
    if source_of(module)[1]:
        names = imported_names(module)
        if name in names:
            return defining_module(names[name], name)
    return module


def first_sentence(module: str, name: str) -> str:
    """First sentence of the docstring of a function or class, read without importing it."""
    for node in source_of(module)[0].body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == name:
            text = " ".join((ast.get_docstring(node) or "").split("\n\n")[0].split())
            return re.split(r"(?<=\w)[.;:] ", text)[0].rstrip(".").replace("|", "\\|") + "."
    return ""


def reference_pages() -> dict[str, str]:
    """Markdown of the reference: an index, and a page for each subpackage.

    A name is documented on the page of the innermost package that defines it; other packages that
    export it link there.
    """
    top, *inner = packages()
    where = {
        package: {n: defining_module(m, n) for n, m in imported_names(package).items()}
        for package in (top, *inner)
    }

    def home(module: str) -> str:
        """The innermost package of a module."""
        return max((p for p in inner if f"{module}.".startswith(f"{p}.")), key=len)

    def page(package: str) -> str:
        return package.removeprefix(f"{top}.")

    def ordered(names: dict[str, str]) -> list[tuple[str, str]]:
        return sorted(names.items(), key=lambda item: item[0].lower())

    lines = [
        "# Reference",
        "",
        "All public names, documented from their docstrings. The names of the first table are",
        "available from `import xavatar_jax as xa`; others are imported from their package.",
        "",
        "| Name | Package | Description |",
        "|---|---|---|",
    ]
    for name, module in ordered(where[top]):
        own = page(home(module))
        what = first_sentence(module, name)
        lines.append(f"| [`xa.{name}`][{module}.{name}] | [`{own}`]({own}.md) | {what} |")
    lines += ["", "| Package | Contents |", "|---|---|"]
    pages = {}
    for package in inner:
        names = where[package]
        if not names and package.count(".") > 1:
            continue
        own = page(package)
        summary = (ast.get_docstring(source_of(package)[0]) or "").strip()
        lines.append(f"| [`{own}`]({own}.md) | {summary.splitlines()[0]} |")
        body = [f"# {own}", "", summary, ""]
        if names:
            some = ", ".join(sorted(names, key=str.lower)[:2])
            body += ["```python", f"from {package} import {some}", "```", ""]
        others = [(n, m) for n, m in ordered(names) if home(m) != package]
        if others:
            links = ", ".join(f"[`{name}`][{module}.{name}]" for name, module in others)
            body += [f"Also exported: {links}.", ""]
        body += [f"::: {m}.{n}\n" for n, m in ordered(names) if home(m) == package]
        pages[f"api/{own}.md"] = "\n".join(body)
    pages["api/index.md"] = "\n".join(lines) + "\n"
    return pages
