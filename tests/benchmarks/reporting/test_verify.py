"""``verify``: green on the committed results, red after one digit anywhere."""

from __future__ import annotations

import random
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest

from benchmarks.__main__ import main
from benchmarks.protocol.plan import expand
from benchmarks.protocol.presets import load_preset
from benchmarks.reporting.pages.includes import included, rewrite_all
from benchmarks.reporting.pages.readme import BEGIN, END, rewrite
from benchmarks.reporting.tables.paper import build_tables, write_tables
from benchmarks.reporting.verify import Report, check_runs, check_tables, verify, verify_all
from benchmarks.runs.store import RunFolder, Store
from benchmarks.studies.design import docs as design_docs
from tests.benchmarks.fabricated_store import make_store

ROOT = Path(__file__).resolve().parents[3]
RESULTS = ROOT / "results"


PAGES = {
    "README.md": "# Title\n\n<!-- results:begin -->\n<!-- results:end -->\n\nThe end.\n",
    "docs/results.md": "# Results\n\n<!-- science:begin -->\n<!-- science:end -->\n",
}


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """Results of preset quick, two pages about them, the committed design and docs."""
    unneeded = shutil.ignore_patterns("figures", "results.md", "gallery.md")
    shutil.copytree(RESULTS / "design", tmp_path / "results" / "design", ignore=unneeded)
    shutil.copytree(ROOT / "docs", tmp_path / "docs", ignore=unneeded)
    for page in (tmp_path / "docs").glob("*.md"):
        for name in included(page.read_text(encoding="utf-8")):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, tmp_path / name)
    store = make_store(tmp_path / "results", [0])
    write_tables(store)
    for name, text in PAGES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
        rewrite(tmp_path / name, store)
    return tmp_path


def words(folder: Path) -> list[str]:
    places = {"--results": "results", "--readme": "README.md", "--docs": "docs"}
    return ["verify", *(text for k, v in places.items() for text in (k, str(folder / v)))]


def learners(store: Store) -> list[RunFolder]:
    return [run for run in store.completed() if run.has_rows("curve")]


def change_digit(path: Path, rng: random.Random, begin: str = "", end: str = "") -> int:
    """Change one digit of a number between two marks; returns its line, counted from 1."""
    text = path.read_text(encoding="utf-8")
    first = text.index(begin) + len(begin)
    last = text.index(end, first) if end else len(text)
    # digits that stand in a number of a table, not in a heading's marker
    places = [m.start() for m in re.finditer(r"\d", text[first:last])]
    place = first + rng.choice(places)
    digit = rng.choice([d for d in "0123456789" if d != text[place]])
    path.write_text(text[:place] + digit + text[place + 1 :], encoding="utf-8")
    return text[:place].count("\n") + 1


def test_the_committed_results_are_what_their_episodes_say(
    capsys: pytest.CaptureFixture[str],
) -> None:
    code = main(words(ROOT))
    out, err = capsys.readouterr()
    assert code == 0, err
    for name in sorted(path.parent.name for path in RESULTS.glob("*/store.json")):
        assert f"{RESULTS / name}: tables of" in out
    assert f"{ROOT / 'README.md'}: its results" in out
    assert f"{RESULTS / 'design'}: table, and its blocks" in out


def test_one_digit_of_any_table_is_seen(copy: Path) -> None:
    store = Store.open(copy / "results", "quick")
    rng = random.Random(0)
    tables = sorted(store.tables.iterdir())
    assert len(tables) >= 21
    wanted = build_tables(store)
    for path in tables:
        kept = path.read_bytes()
        line = change_digit(path, rng)
        (problem,) = check_tables(store.tables, wanted)
        assert problem.startswith(f"{path} differs from the stored episodes (line {line}: stored ")
        path.write_bytes(kept)
    assert verify(store) == []


@pytest.mark.parametrize(("page", "end"), [("README.md", END), ("docs/results.md", "")])
def test_one_digit_of_a_page_is_seen(
    page: str, end: str, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = copy / page
    rng = random.Random(1)
    begin = next(mark for mark in (BEGIN, "<!-- science:begin -->") if mark in path.read_text())
    for _ in range(3):
        kept = path.read_bytes()
        line = change_digit(path, rng, begin, end)
        assert main(words(copy)) == 1
        err = capsys.readouterr().err
        assert f"{path} differs from the stored episodes (line {line}: stored " in err
        assert "1 difference found" in err
        path.write_bytes(kept)
    assert main(words(copy)) == 0


def test_text_outside_the_readmes_block_is_free(copy: Path) -> None:
    readme = copy / "README.md"
    text = readme.read_text(encoding="utf-8")
    assert text.count(BEGIN) == text.count(END) == 1
    readme.write_text("1 2 3\n" + text + "4 5 6\n", encoding="utf-8")
    assert main(words(copy)) == 0


def check_design(copy: Path) -> list[str]:
    report = Report()
    design_docs.check(report, copy / "results", [], copy / "docs")
    assert len(report.checked) == 1
    return report.problems


def blocks() -> Iterator[tuple[str, str]]:
    for path in sorted((ROOT / "docs").glob("*.md")):
        text = path.read_text(encoding="utf-8")
        for name in design_docs.BLOCKS:
            if f"<!-- {name}:begin" in text:
                yield path.name, name


def test_one_digit_of_any_generated_block_of_the_docs_is_seen(copy: Path) -> None:
    rng = random.Random(2)
    found = list(blocks())
    assert len(found) >= 10
    for page, name in found:
        path = copy / "docs" / page
        kept = path.read_bytes()
        line = change_digit(path, rng, f"<!-- {name}:begin", f"<!-- {name}:end")
        (problem,) = check_design(copy)
        assert problem.startswith(f"{path} differs from the data in")
        assert f"(line {line}: stored" in problem
        path.write_bytes(kept)


def test_the_designs_table_must_follow_from_its_runs(copy: Path) -> None:
    path = copy / "results" / "design" / "runs.csv"
    runs = pd.read_csv(path)
    runs.assign(a_w=runs["a_w"] + 0.01).to_csv(path, index=False)
    (problem,) = check_design(copy)
    wanted = runs["a_w"].mean() + 0.01
    assert f"as the optimized workspace, the mean of runs.csv is {wanted:.7g}" in problem


def test_an_episode_that_changed_makes_the_tables_disagree(copy: Path) -> None:
    store = Store.open(copy / "results", "quick")
    run = learners(store)[0]
    rows = run.rows("episodes")
    rows["success"] = [1 - rows["success"][0], *rows["success"][1:]]
    rows.to_csv(run.path / "episodes.csv", index=False)
    names = " ".join(verify(store))
    for table in ("performance", "robustness"):
        assert f"{table}.md differs" in names


def test_rows_that_are_not_the_test_episodes_are_named(copy: Path) -> None:
    store = Store.open(copy / "results", "quick")
    assert check_runs(store) == []
    path = store.completed()[-1].path / "episodes.csv"
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines(keepends=True)

    def problem(changed: str) -> str:
        path.write_text(changed, encoding="utf-8")
        (found,) = check_runs(store)
        path.write_text(text, encoding="utf-8")
        return found

    assert "rows at noise 0.0, error 0 mm, acting greedy, not one for each" in problem(
        "".join(lines[:5] + lines[6:])
    )
    number, seed, start, rest = lines[1].split(",", 3)
    assert "other than the test seeds" in problem(
        "".join([lines[0], f"{number},{int(seed) + 1},{start},{rest}", *lines[2:]])
    )
    assert f"of seed {seed} began at" in problem(
        "".join([lines[0], f"{number},{seed},0000000000,{rest}", *lines[2:]])
    )
    learner = learners(store)[0]
    rows = learner.rows("episodes")
    rows[rows["noise"] == 0.0].to_csv(learner.path / "episodes.csv", index=False)
    (found,) = check_runs(store)
    assert "episodes.csv has noise [0.0], not [0.0, " in found
    rows.assign(acting="exploring").to_csv(learner.path / "episodes.csv", index=False)
    (found,) = check_runs(store)
    assert "episodes.csv has acting ['exploring'], not ['greedy']" in found


def test_a_policy_that_is_not_its_runs_is_named(copy: Path) -> None:
    store = Store.open(copy / "results", "quick")
    first, second = learners(store)[:2]
    for run, data in ((first, b"one"), (second, b"two")):
        run.policy.write_bytes(data)
        meta = run.meta()
        meta["training"]["policy_sha256"] = run.policy_digest()
        run.write_meta(meta)
    assert check_runs(store) == []
    first.policy.write_bytes(b"two")
    second.policy.write_bytes(b"one")
    wanted = "policy.zip is not the policy whose digest its meta.json has"
    assert check_runs(store) == [f"{run.path}: {wanted}" for run in (first, second)]


def test_a_damaged_or_foreign_run_is_named(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = Store.open(copy / "results", "quick")
    run = learners(store)[0].path
    for name, text, message in (
        ("meta.json", '{"schema": 99}', "has results schema 99, this version reads 1"),
        ("meta.json", "{", "cannot be read"),
        ("meta.json", "[]", "cannot be read (no mapping)"),
        ("config.yaml", "cell: [", "cannot be read"),
        ("config.yaml", "{}", "lacks 'cell'"),
        ("episodes.csv", "", "cannot be read"),
    ):
        kept = (run / name).read_bytes()
        (run / name).write_text(text, encoding="utf-8")
        assert main(words(copy)) == 1
        err = capsys.readouterr().err
        assert str(run) in err
        assert message in err
        (run / name).write_bytes(kept)
    run.rename(run.with_name("aaa"))
    (problem,) = check_runs(store)
    assert f"holds the run '{run.name}'" in problem


def test_a_table_that_nothing_makes_is_named(copy: Path) -> None:
    store = Store.open(copy / "results", "quick")
    (store.tables / "old.md").write_text("95", encoding="utf-8")
    (store.tables / "ablation.csv").unlink()
    missing, old = verify(store)
    assert "ablation.csv is missing" in missing
    assert "old.md is made by no table" in old


def test_the_readme_is_rewritten_for_the_preset_that_it_shows(copy: Path) -> None:
    readme = copy / "README.md"
    before = readme.read_bytes()
    change_digit(readme, random.Random(0), BEGIN, END)
    assert readme.read_bytes() != before
    places = ["--results", str(copy / "results"), "--readme", str(readme)]
    assert main(["readme", *places]) == 0
    assert readme.read_bytes() == before


def test_a_readme_without_its_results_is_named(copy: Path) -> None:
    shutil.move(copy / "results" / "quick", copy / "results" / "slow")
    report = verify_all(copy / "results", [], copy / "README.md", copy / "docs")
    assert any("shows preset 'quick', but" in problem for problem in report.problems)


def test_nothing_to_verify_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words(tmp_path)) == 2
    assert "has no results" in capsys.readouterr().err


def test_the_classic_tables_must_follow_from_their_runs(tmp_path: Path) -> None:
    from benchmarks.studies.classic import docs as block
    from benchmarks.studies.classic.presets import load_preset
    from benchmarks.studies.classic.results import Results
    from benchmarks.studies.classic.tables import build_tables

    store = Store.open(tmp_path / "results" / "classic", "quick", create=True)
    classic = Results(load_preset("quick"), store)  # no run yet: dashes, and the settings
    for table in build_tables(classic):
        table.write(store.tables)
    page = tmp_path / "docs" / "rainbow.md"
    page.parent.mkdir()
    page.write_text(f"{block.begin('quick')}\n<!-- classic-quick:end -->\n", encoding="utf-8")
    (problem,) = block.check_store(store.folder, page.parent)
    assert problem.startswith(f"{page} differs from the runs in")
    block.write(page, classic, "../results/classic/quick")
    assert block.check_store(store.folder, page.parent) == []
    change_digit(store.tables / "settings.md", random.Random(4))
    (problem,) = block.check_store(store.folder, page.parent)
    assert "settings.md differs" in problem


def test_an_included_file_that_changed_is_seen(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    part = copy / "results" / "audit" / "part.md"
    part.parent.mkdir(exist_ok=True)
    part.write_text("95 %\n", encoding="utf-8")
    page = copy / "docs" / "more.md"
    begin = "<!-- include:begin results/audit/part.md (written by: python -m benchmarks readme) -->"
    page.write_text(f"{begin}\n<!-- include:end -->\n", encoding="utf-8")
    rewrite_all(page.parent, copy / "results")
    assert main(words(copy)) == 0
    part.write_text("96 %\n", encoding="utf-8")
    assert main(words(copy)) == 1
    assert f"{page} differs from the files that it includes" in capsys.readouterr().err
    part.unlink()
    assert main(words(copy)) == 1
    assert "which is no file of" in capsys.readouterr().err


def test_the_policies_in_git_are_few(tmp_path: Path) -> None:
    """Those of the headline methods; what else a run leaves is ignored."""
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")

    def git(*words: str, given: str = "") -> list[str]:
        done = subprocess.run(
            ["git", *words], cwd=ROOT, capture_output=True, text=True, input=given
        )
        return done.stdout.split()

    tracked = [ROOT / name for name in git("ls-files", "results/**/policy.zip")]
    assert 0 < sum(path.stat().st_size for path in tracked) < 8_000_000
    names = [str(path) for path in tracked]
    # a renewed run of a preset whose results are tracked adds no file, and quick is not tracked
    assert git("check-ignore", "--no-index", "--stdin", given="\n".join(names)) == []
    made = ["results/quick/tables/performance.md"]
    for preset in ("cut",):
        cells = [f"results/{preset}/runs/{c.id}/policy.zip" for c in expand(load_preset(preset))]
        made += [cell for cell in cells if str(ROOT / cell) not in names]
    assert git("check-ignore", "--no-index", "--stdin", given="\n".join(made)) == made
    assert git("ls-files", "results/quick") == []
