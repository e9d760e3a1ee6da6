"""The gallery shows every committed picture under a command that exists; captions have an owner."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
from PIL import Image

from benchmarks.__main__ import _parser
from benchmarks.commands import DELEGATED
from benchmarks.reporting.pages import gallery
from benchmarks.runs.store import write_text

ROOT = Path(__file__).resolve().parents[3]


def test_every_committed_picture_is_shown() -> None:
    listed = subprocess.run(
        ["git", "ls-files", "results/*.png", "results/*.gif"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    page = (ROOT / "docs" / gallery.PAGE).read_text(encoding="utf-8")
    shown = re.findall(r"\]\(\.\./(results/[^)]+)\)", page)
    assert sorted(shown) == sorted(listed.stdout.split())


@pytest.mark.parametrize("command", [command for _, command, _ in gallery.PICTURES])
def test_its_commands_exist(command: str) -> None:
    words = command.split()
    assert words[0] in DELEGATED or _parser().parse_args(words)


def test_captions_come_from_the_pages_and_names_stand_in(tmp_path: Path) -> None:
    for name in ("scene", "long_name"):
        path = tmp_path / "results" / "media" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (4, 4)).save(path)
    write_text(tmp_path / "README.md", "![Both robots](results/media/scene.png)\n")
    page = tmp_path / "docs" / gallery.PAGE
    write_text(page, "# G\n\n<!-- gallery:begin -->\n<!-- gallery:end -->\n\nEnd.\n")
    assert gallery.rewrite(page, tmp_path / "results")
    text = page.read_text(encoding="utf-8")
    assert (
        "| ![Long name](../results/media/long_name.png)<br>Long name "
        "| ![Both robots](../results/media/scene.png)<br>Both robots |"
    ) in text
    assert text.endswith("End.\n")
    assert not gallery.rewrite(page, tmp_path / "results")
