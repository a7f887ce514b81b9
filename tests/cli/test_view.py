"""`xavatar view`: the page, and what it says of bad input. The viewer itself: tests/viewer."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.usefixtures("coarse")


def test_a_page_is_written(call, avatar_file, motion_file, tmp_path):
    out = tmp_path / "avatar.html"
    code, said, _ = call("view", avatar_file, motion_file, "--html", out, "--end", 0.2)
    assert code == 0
    assert str(out) in said
    page = out.read_text(encoding="utf-8")
    assert page.lstrip().lower().startswith("<!doctype html>")
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert "https://" not in page


def test_other_names_and_missing_files_are_named(call, avatar_file, tmp_path):
    code, _, error = call("view", avatar_file, "--html", tmp_path / "avatar.pdf")
    assert code == 2
    assert "avatar.pdf" in error
    code, _, error = call("view", tmp_path / "none.npz")
    assert code == 2
    assert "none.npz" in error
