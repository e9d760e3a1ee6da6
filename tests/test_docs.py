"""The site builds without a warning and without the network; every Python block of a page runs."""

import os
import re
from pathlib import Path
from typing import Any

import pytest

from docs.screens import LONGEST, browser, measure
from tests.process import ROOT, python

PAGES = sorted((ROOT / "docs").glob("*.md"))
WHOLE = "WHOLE" in os.environ  # as `make examples` runs them: trainings whole, scores compared
if WHOLE:
    PAGES.append(ROOT / "README.md")
STEPS = 300  # of a training: past its first updates
SCORE = re.compile(r"^print\(.*\)  # (-?[\d.]+)", re.MULTILINE)  # what a page says that is printed
NEAR = 0.95  # of the score, on another machine
SHORTER = (
    ()
    if WHOLE
    else (
        (r"learn\([\d_]+", f"learn({STEPS}"),
        (r"range\(500\)", "range(2)"),  # episodes
        (r"n_envs=8", "n_envs=2"),
    )
)


def python_blocks(page: str) -> list[tuple[str, str]]:
    """Each Python block, its trainings shortened, and why it is not to run, if it is not.

    Such a block stands after the line ``<!-- not run: the reason -->``.
    """
    result = re.findall(r"(?:<!-- not run: (.*?) -->\n\n)?^```python\n(.*?)^```", page, re.M | re.S)
    for pattern, less in SHORTER:
        result = [(reason, re.sub(pattern, less, block)) for reason, block in result]
    assert len(result) == page.count("```python\n")
    return [(block, reason) for reason, block in result]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the built site."""
    folder = tmp_path_factory.mktemp("site")
    nowhere = "http://127.0.0.1:9"  # an inventory or a font from elsewhere would fail
    argv = ["-W", "--keep-going", "-q", str(ROOT / "docs"), str(folder)]
    proxies = {"http_proxy": nowhere, "https_proxy": nowhere}
    python("-m", "sphinx", *argv, env={**os.environ, **proxies})
    return folder


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_site_builds(site: Path) -> None:
    for page in PAGES:
        assert (site / page.with_suffix(".html").name).is_file()
    parameters = (site / "api" / "rainbow.html").read_text(encoding="utf-8")
    assert "learning rate, or a function of the remaining progress" in parameters
    gallery = (site / "gallery.html").read_text(encoding="utf-8")
    pictures = re.findall(r'<img[^>]* src="([^"]+)"', gallery)
    assert len(pictures) > 20
    assert all((site / name).is_file() for name in pictures)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_pages_are_short_and_fit_a_window_and_a_phone(site: Path) -> None:
    chromium = browser()
    if chromium is None:
        pytest.skip("no Chromium here")
    pages = measure(site, chromium)
    assert {page.name for page in pages} >= {page.with_suffix(".html").name for page in PAGES}
    assert [page for page in pages if max(page.wide) > 0 or page.box > 0] == []
    # another browser breaks some lines elsewhere
    assert [page for page in pages if page.screens > 1.05 * LONGEST] == []


@pytest.mark.parametrize(
    "page", [p for p in PAGES if "```python" in p.read_text("utf-8")], ids=lambda page: page.stem
)
def test_the_blocks_of_a_page_run(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each alone, as a script; those of the README, `test_install` runs."""
    if page.stem in ("contact", "physics_task"):
        pytest.importorskip("mujoco", reason="needs the extra physics")
    blocks = python_blocks(page.read_text(encoding="utf-8"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", "")  # a page sets it; it is as it was afterwards
    Path("results").mkdir()
    Path("results/data").symlink_to(ROOT / "results" / "data")  # what pages read
    reasons = []
    for number, (block, reason) in enumerate(blocks, start=1):
        if reason:
            reasons.append(f"block {number}: {reason}")
        else:
            names: dict[str, Any] = {"__name__": "__main__"}
            capsys.readouterr()
            exec(compile(block, f"{page.name}, block {number}", "exec"), names)
            printed = re.findall(r"^-?[\d.]+", capsys.readouterr().out, re.MULTILINE)
            for score, wanted in zip(printed, SCORE.findall(block), strict=False):
                assert not WHOLE or float(score) >= NEAR * float(wanted)
    if reasons:
        pytest.skip("; ".join(reasons))
