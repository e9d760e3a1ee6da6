"""How long and how wide the built pages are, in Chromium: ``python docs/screens.py build/docs``.

Each page is laid out in frames of 1280 and 390 pixels. A screen is 800 pixels high.
"""

import html
import json
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final, NamedTuple

BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome", "chrome")
WIDE, NARROW, SCREEN, LONGEST = 1280, 390, 800, 6  # px, px, px, screens
INDEXES: Final = {"genindex.html", "py-modindex.html", "search.html"}

# The theme wraps its tables after it has loaded; a page is measured once that is done.
# The text's own height: the frame's is that of the side bar where that is longer. What scrolls
# inside its own box, such as a wide table, does not make the page scroll.
MEASURE: Final = """
const found = {}, waiting = [];
const TABLES = 'table.docutils:not(.field-list):not(.footnote):not(.citation)';
for (const page of PAGES) for (const width of WIDTHS) {
  const frame = document.createElement('iframe');
  frame.style.cssText = `width: ${width}px; height: 800px; border: 0`;
  frame.src = page;
  waiting.push(new Promise(done => { frame.onload = function look() {
    const raw = [...frame.contentDocument.querySelectorAll(TABLES)];
    const root = frame.contentDocument, text = root.querySelector('[itemprop=articleBody]');
    if (root.fonts.status !== 'loaded' || raw.some(table => !table.closest('.wy-table-responsive')))
      return setTimeout(look, 200);
    const boxes = [...text.querySelectorAll('.wy-table-responsive, pre, div.math')];
    found[`${page} ${width}`] = [
      text.getBoundingClientRect().height,
      Math.max(root.documentElement.scrollWidth, root.body.scrollWidth, text.scrollWidth) - width,
      Math.max(0, ...boxes.map(box => box.scrollWidth - box.clientWidth)),
    ];
    done();
  }; }));
  document.body.append(frame);
}
Promise.all(waiting).then(() => document.body.textContent = JSON.stringify(found));
"""


class Page(NamedTuple):
    """One page as Chromium lays it out."""

    name: str
    screens: float
    """Height of its text at 1280 px, in screens."""
    wide: tuple[int, int]
    """Pixels by which the page is wider than 1280 and than 390: more than 0 scrolls sideways."""
    box: int
    """Pixels by which its widest table or block of code is wider than the column, at 1280."""


def browser() -> str | None:
    """The path of a Chromium, if there is one."""
    return next((found for name in BROWSERS if (found := shutil.which(name))), None)


def measure(site: Path, chromium: str) -> list[Page]:
    """All pages of a built site, without its index pages and the sources it shows.

    Args:
        site: the folder with ``index.html``.
        chromium: the browser's path.

    Raises:
        RuntimeError: if the browser measured nothing.
    """
    names = sorted({path.name for path in site.glob("*.html")} - INDEXES)
    pages = [(site / name).resolve().as_uri() for name in names]
    script = f"const PAGES = {json.dumps(pages)}, WIDTHS = [{WIDE}, {NARROW}];{MEASURE}"
    with tempfile.TemporaryDirectory() as folder:
        frames = Path(folder) / "frames.html"
        frames.write_text(f"<body><script>{script}</script></body>", encoding="utf-8")
        words = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
                 "--disable-web-security",
                 "--allow-file-access-from-files", f"--user-data-dir={folder}/profile",
                 "--virtual-time-budget=600000", "--dump-dom", frames.as_uri()]  # fmt: skip
        done = subprocess.run([chromium, *words], capture_output=True, text=True, check=False)
    text = re.search(r"<body>(\{.*\})</body>", done.stdout, re.DOTALL)
    if not text:
        raise RuntimeError(f"{chromium} measured nothing: {done.stderr[-500:]}")
    found = json.loads(html.unescape(text[1]))
    measured = []
    for name, page in zip(names, pages, strict=True):
        (height, wide, box), (_, narrow, _) = (found[f"{page} {w}"] for w in (WIDE, NARROW))
        measured.append(Page(name, height / SCREEN, (wide, narrow), box))
    return measured


def main() -> None:
    """Print a line for each page, the longest first."""
    chromium = browser()
    if chromium is None:
        sys.exit("no Chromium here")
    for page in sorted(measure(Path(sys.argv[1]), chromium), key=lambda page: -page.screens):
        print(f"{page.screens:5.1f} screens  {page.wide} {page.box} px  {page.name}")


if __name__ == "__main__":
    main()
