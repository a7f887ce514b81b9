"""What the site adds to the pages of this folder: the project's texts, the reference, formulas.

The Markdown files stay as they are read in the repository. Links that leave the folder are turned
to where the site has the same text; formulas become MathML, so that a page loads no script.
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
# Texts above this folder, by the page that they are on the site.
TEXTS = {
    "readme.md": "README.md",
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "third-party-notices.md": "THIRD_PARTY_NOTICES.md",
}
# Files that pages link to, copied as they are.
FILES = (
    "LICENSE",
    "CITATION.cff",
    *(f"notebooks/{path.name}" for path in sorted((ROOT / "notebooks").glob("*.ipynb"))),
)
_LINK = re.compile(r"(!?\[[^\]]*\]\()([^)\s#]+)(#[^)\s]*)?\)")
_CODE = re.compile(r"(^```.*?^```|`[^`\n]+`)", re.DOTALL | re.MULTILINE)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """List the reference's pages under its first one."""
    for item in config.nav or []:
        if "Reference" in item:
            pages = sorted(name for name in reference_pages() if name != "api/index.md")
            item["Reference"] = ["api/index.md", *pages]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the project's texts, the files beside them and the reference."""
    for page, source in TEXTS.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=text))
    for name in FILES:
        files.append(File.generated(config, _place(name), abs_src_path=str(ROOT / name)))
    for name, text in reference_pages().items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, *, page: Page, **_: Any) -> str:
    """Turn links that leave the folder to where the site has their text."""
    uri = page.file.src_uri
    where = Path(TEXTS[uri]).parent if uri in TEXTS else Path("docs") / Path(uri).parent

    def turned(match: re.Match[str]) -> str:
        head, target, anchor = match[1], match[2], match[3] or ""
        if re.match(r"[a-z]+:", target):
            return match[0]
        path = os.path.normpath(where / target).replace(os.sep, "/")
        on_site = _place(path)
        here = os.path.dirname(uri) or "."
        return f"{head}{os.path.relpath(on_site, here).replace(os.sep, '/')}{anchor})"

    # Code is left alone: what looks like a link there is an index or a call.
    parts = _CODE.split(markdown)
    return "".join(p if k % 2 else _LINK.sub(turned, p) for k, p in enumerate(parts))


def on_page_content(content: str, **_: Any) -> str:
    """Formulas as MathML."""
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


def _place(path: str) -> str:
    """Where the site has a file of the repository."""
    for page, source in TEXTS.items():
        if path == source:
            return page
    return path.removeprefix("docs/")


def public_names() -> dict[str, dict[str, str]]:
    """Public names of the package and of each subpackage, by the module that has them.

    They are what an `__init__.py` imports `as` itself.
    """
    folders = [PACKAGE, *(p.parent for p in sorted(PACKAGE.glob("*/__init__.py")))]
    found = {}
    for folder in folders:
        dotted = ".".join(folder.relative_to(PACKAGE.parent).parts)
        names = {}
        for node in ast.parse((folder / "__init__.py").read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and node.level == 1:
                for alias in node.names:
                    if alias.asname == alias.name and not alias.name.startswith("_"):
                        names[alias.name] = f"{dotted}.{node.module}"
        found[dotted] = names
    return found


def first_sentence(module: str, name: str) -> str:
    """How the docstring of a function or class begins, read without importing anything."""
    path = PACKAGE.parent.joinpath(*module.split("."))
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == name:
            text = " ".join((ast.get_docstring(node) or "").split("\n\n")[0].split())
            return re.split(r"(?<=\w)[.;:] ", text)[0].rstrip(".").replace("|", "\\|") + "."
        if isinstance(node, ast.ImportFrom) and any(a.name == name for a in node.names):
            above = node.level - path.is_dir()  # packages to climb from this module
            base = module.split(".")[: len(module.split(".")) - above]
            return first_sentence(".".join([*base, node.module or ""]), name)
    return ""


def reference_pages() -> dict[str, str]:
    """Markdown of the reference: a page for each subpackage, and one that leads to them."""
    every = public_names()
    pages = {}
    front = every.pop("xavatar_jax")
    lines = [
        "# Reference",
        "",
        "Every public name, from its docstring. `import xavatar_jax as xa` has those of the first",
        "table; the rest are imported from their package.",
        "",
        "| Name | Package | What it is |",
        "|---|---|---|",
    ]
    for name, module in sorted(front.items(), key=lambda item: item[0].lower()):
        package = module.removeprefix("xavatar_jax.").split(".")[0]
        target = f"{every[f'xavatar_jax.{package}'][name]}.{name}"
        what = first_sentence(*target.rsplit(".", 1))
        lines.append(f"| [`xa.{name}`][{target}] | [`{package}`]({package}.md) | {what} |")
    lines += ["", "| Package | What it holds |", "|---|---|"]
    for dotted, names in every.items():
        package = dotted.split(".")[1]
        source = (PACKAGE / package / "__init__.py").read_text(encoding="utf-8")
        summary = (ast.get_docstring(ast.parse(source)) or "").strip()
        lines.append(f"| [`{package}`]({package}.md) | {summary.splitlines()[0]} |")
        body = [f"# {package}", "", summary, ""]
        if names:
            some = ", ".join(sorted(names, key=str.lower)[:2])
            body += ["```python", f"from {dotted} import {some}", "```", ""]
        # By the module that defines it: `avatar.fit` is a module as well as a function.
        body += [f"::: {names[name]}.{name}\n" for name in sorted(names, key=str.lower)]
        pages[f"api/{package}.md"] = "\n".join(body)
    pages["api/index.md"] = "\n".join(lines) + "\n"
    return pages
