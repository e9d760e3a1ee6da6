"""The one-page report: all tables and pictures in a real browser, self-contained, without torch."""

from __future__ import annotations

import html
import html.parser
import io
import json
import re
import resource
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from benchmarks.__main__ import main
from benchmarks.reporting.figures.learning import pictures
from benchmarks.reporting.figures.style import canvas, flat_png
from benchmarks.reporting.pages.html_report import DESIGN, report_path, write_report
from benchmarks.reporting.results import Results
from benchmarks.reporting.tables import deviations
from benchmarks.reporting.tables.paper import build_tables
from benchmarks.runs.store import Store
from tests.benchmarks import fabricated_store

ROOT = Path(__file__).resolve().parents[3]
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
PAPER_FIGURES = {
    "cumulative_reward",
    "exploration",
    "holes",
    "success",
    "max_q",
    "loss",
    "duration",
}


class Page(html.parser.HTMLParser):
    """Tables, pictures and what the page points at."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sections: list[str] = []
        self.pictures: dict[str, dict[str, str]] = {}
        self.targets: list[str] = []
        self.cells: list[str] = []
        self._figure = ""
        self._cell: list[str] | None = None
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {key: value or "" for key, value in attrs}
        self.targets += [given[key] for key in ("src", "href") if key in given]
        if tag == "section":
            self.sections.append(given["id"])
        if tag == "figure":
            self._figure = given["id"].removeprefix("figure-")
        if tag == "img":
            self.pictures[self._figure] = given
        if tag in ("td", "th"):
            self._cell = []

    def handle_data(self, data: str) -> None:
        if self._cell is not None:
            self._cell.append(data)

    def handle_endtag(self, tag: str) -> None:
        if tag in ("td", "th") and self._cell is not None:
            self.cells.append("".join(self._cell))
            self._cell = None


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a fabricated store with three seeds, with the design study's pictures."""
    root = tmp_path_factory.mktemp("results")
    store = fabricated_store.make_store(root, [0, 1, 2])
    figures = ROOT / "results" / "design" / "figures"
    shutil.copytree(figures, root / "design" / "figures")
    assert main(["report", "--preset", "quick", "--results", str(root)]) == 0
    return report_path(store)


def test_every_table_and_figure_is_on_the_page(report: Path) -> None:
    page = Page(report.read_text(encoding="utf-8"))
    store = Store.open(report.parent.parent, "quick")
    tables = build_tables(store)
    assert sorted(page.sections) == sorted(table.name for table in tables)
    for table in tables:
        for row in table.texts():
            assert set(row) <= set(page.cells), table.name
    stored = {path.stem for path in store.figures.iterdir()}
    assert {f"safe_{name}" for name in PAPER_FIGURES} <= stored
    assert {"robustness", "performance_profile", "ablation_comparison"} <= stored
    assert set(page.pictures) == stored | {f"design_{name}" for name, _, _ in DESIGN}


def test_the_page_needs_no_other_file_and_describes_its_pictures(report: Path) -> None:
    page = Page(report.read_text(encoding="utf-8"))
    assert all(target.startswith(("data:", "#")) for target in page.targets)
    anchors = set(re.findall(r' id="([^"]+)"', report.read_text(encoding="utf-8")))
    assert {t[1:] for t in page.targets if t.startswith("#")} <= anchors
    alts = [picture["alt"] for picture in page.pictures.values()]
    assert all(len(alt) > 40 for alt in alts)
    assert len(set(alts)) == len(alts)
    reward = page.pictures["safe_cumulative_reward"]["alt"]
    # the mean of all ten episodes, in five rows of two: 30, and 0, 1, 2 more by seed
    assert "Rainbow DQN (3 seeds) ends at 31" in reward
    assert "switches at 300 steps" in reward


def test_a_flag_gives_the_paper_s_number_and_the_reason(report: Path) -> None:
    hints = re.findall(r'class="flagged" title="([^"]+)"', report.read_text(encoding="utf-8"))
    path = Path(deviations.__file__).with_name("reasons.yaml")
    reasons = [" ".join(r["reason"].split()) for r in yaml.safe_load(path.read_text("utf-8"))]
    told = [html.unescape(hint) for hint in hints]
    assert len(told) > 5
    assert all(re.match(r"The paper: \[?-?\d", hint) for hint in told)
    assert sum(hint.endswith(tuple(reasons)) for hint in told) > 5


def test_the_report_repeats(report: Path) -> None:
    store = Store.open(report.parent.parent, "quick")
    first = report.read_bytes()
    drawn = [(each, store.figures / f"{each.name}.png") for each in pictures(Results(store))]
    assert write_report(store, build_tables(store), drawn) == report
    assert report.read_bytes() == first


def test_a_small_picture_keeps_its_colours() -> None:
    figure, (axes,) = canvas()
    for i in range(8):
        axes.plot([0, 1], [i, i], color=f"C{i}", linewidth=0.6)
        axes.fill_between([0, 1], i - 0.3, i + 0.3, color=f"C{i}", alpha=0.2)
    raw = io.BytesIO()
    figure.savefig(raw, format="png")
    small = flat_png(raw.getvalue())
    assert len(small) < 0.7 * len(raw.getvalue())
    before, after = (
        np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), dtype=np.int64)
        for data in (raw.getvalue(), small)
    )
    assert np.abs(before - after).max() < 25


def test_markup_in_results_stays_text(tmp_path: Path) -> None:
    store = fabricated_store.make_store(tmp_path, [0], keep=lambda cell: cell.method == "optimum")
    meta = store.run("optimum-optimized-s0").path / "meta.json"
    text = meta.read_text(encoding="utf-8").replace('"test"', '"<script>alert(1)</script>"')
    meta.write_text(text, encoding="utf-8")
    assert main(["report", "--preset", "quick", "--results", str(tmp_path)]) == 0
    page = report_path(store).read_text(encoding="utf-8")
    assert "<script" not in page
    assert "&lt;script&gt;" in page


LOOK = """
<script>addEventListener('load', () => {
  const seen = {
    pictures: [...document.images].map(i => [i.parentElement.id, i.complete, i.naturalWidth,
      i.getBoundingClientRect().width, i.alt.length]),
    tables: [...document.querySelectorAll('section.table')].map(s => [s.id,
      s.querySelectorAll('tbody tr').length,
      s.querySelector('table').getBoundingClientRect().height]),
    overflow: document.documentElement.scrollWidth - innerWidth,
  };
  document.documentElement.setAttribute('data-seen', JSON.stringify(seen));
});</script></body>"""


def look(page: Path, folder: Path, width: int) -> dict[str, Any]:
    """What headless Chromium makes of the page."""
    copy = folder / "page.html"
    text = page.read_text(encoding="utf-8")
    copy.write_text(text.replace("</body>", LOOK), encoding="utf-8")
    assert CHROMIUM is not None
    done = subprocess.run(
        [
            CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
            f"--user-data-dir={folder / 'profile'}", f"--window-size={width},900",
            "--virtual-time-budget=20000", "--dump-dom", copy.as_uri(),
        ],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    match = re.search(r'data-seen="([^"]+)"', done.stdout)
    assert match is not None, done.stderr[-2000:]
    seen: dict[str, Any] = json.loads(match.group(1).replace("&quot;", '"'))
    return seen


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_a_browser_shows_every_table_and_picture(report: Path, tmp_path: Path) -> None:
    seen = look(report, tmp_path, 1300)
    page = Page(report.read_text(encoding="utf-8"))
    assert [name for name, *_ in seen["pictures"]] == [f"figure-{n}" for n in page.pictures]
    for name, complete, natural, shown, alt in seen["pictures"]:
        assert complete, name
        assert natural > 300, name
        assert shown > 300, name
        assert alt > 40, name
    rows = {table.name: len(table.rows) for table in build_tables(
        Store.open(report.parent.parent, "quick"))}  # fmt: skip
    assert {name: count for name, count, _ in seen["tables"]} == rows
    assert all(height > 20 for *_, height in seen["tables"])
    assert seen["overflow"] <= 0  # wide tables scroll on their own


def test_tables_figures_and_report_need_no_torch_and_little_time(tmp_path: Path) -> None:
    store = fabricated_store.make_store(tmp_path, range(5))
    code = (
        "import sys; from benchmarks.__main__ import main;"
        "assert main(['report', '--preset', 'quick', '--results', sys.argv[1]]) == 0;"
        "heavy = {'torch', 'stable_baselines3', 'sb3_contrib', 'tensorboard'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, cwd=ROOT
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().endswith("\n[]")
    # of one core: what else the machine does is not ours
    assert after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime < 60
    page = Page(report_path(store).read_text(encoding="utf-8"))
    assert {f"safe_{name}" for name in PAPER_FIGURES} <= set(page.pictures)


def test_a_store_without_any_run_has_a_report_of_what_is_missing(tmp_path: Path) -> None:
    Store.open(tmp_path, "cut", create=True)
    assert main(["report", "--preset", "cut", "--results", str(tmp_path)]) == 0
    page = Page((tmp_path / "cut" / "report.html").read_text(encoding="utf-8"))
    assert "missing" in page.cells
    assert page.pictures == {}
