"""``verify``: green on the committed results, red after one digit anywhere."""

import random
import re
import shutil
import subprocess
from pathlib import Path

import pandas as pd
import pytest

from benchmarks.cli import main
from benchmarks.protocol.plan import expand
from benchmarks.protocol.presets import load_preset
from benchmarks.reporting import blocks
from benchmarks.reporting.results import Results
from benchmarks.reporting.tables.beyond import build_tables
from benchmarks.reporting.verify import check_runs, check_tables
from benchmarks.runs.store import RunFolder, Store
from benchmarks.studies import catalogue
from benchmarks.studies.design.study import Design
from benchmarks.studies.insertion import Insertion
from tests.benchmarks.conftest import Command
from tests.benchmarks.fabricated_store import make_store, write_tables
from tests.process import ROOT, tracked

RESULTS = ROOT / "results"
Capture = pytest.CaptureFixture[str]
BEGIN = "<!-- results:begin results/quick -->"
END = "<!-- results:end -->"
SCIENCE = "<!-- science:begin results/quick -->"
PAGES = {
    "README.md": f"# Title\n\n{BEGIN}\n{END}\n\nThe end.\n",
    "docs/results.md": f"# Results\n\n{SCIENCE}\n<!-- science:end -->\n",
}


def verify(store: Store) -> list[str]:
    return check_tables(store.tables, build_tables(Results(store)))


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of preset quick, pages about them, the committed design and its page."""
    folder = tmp_path_factory.mktemp("original")
    results, unneeded = folder / "results", shutil.ignore_patterns("figures")
    shutil.copytree(RESULTS / "design", results / "design", ignore=unneeded)
    (folder / "docs").mkdir()
    shutil.copy(ROOT / "docs" / "design.md", folder / "docs")
    write_tables(make_store(results, [0], episodes=load_preset("quick").evaluation.episodes))
    for name, text in PAGES.items():
        (folder / name).write_text(text, encoding="utf-8")
    blocks.rewrite(results, catalogue.all_blocks(results))
    return folder


@pytest.fixture
def copy(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path, dirs_exist_ok=True))


@pytest.fixture
def store(copy: Path) -> Store:
    return Store.open(copy / "results", "quick")


def words(folder: Path, verb: str = "verify") -> list[str]:
    return [verb, "--results", str(folder / "results")]


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


@pytest.mark.slow
def test_the_committed_results_are_what_their_episodes_say(done: Command) -> None:
    out = done(*words(ROOT))
    for name, folder in catalogue.stores(RESULTS).items():
        assert f"{folder}: tables of" in out, name
    for page in ("README.md", "docs/results.md", "docs/design.md", "docs/shield.md"):
        assert f"{ROOT / page}: its blocks" in out


def test_one_digit_of_any_table_is_seen_and_a_file_that_nothing_makes(store: Store) -> None:
    rng = random.Random(0)
    tables = sorted(store.tables.iterdir())
    assert len(tables) >= 21
    wanted = build_tables(Results(store))
    for path in tables:
        kept = path.read_bytes()
        line = change_digit(path, rng)
        (problem,) = check_tables(store.tables, wanted)
        assert problem.startswith(f"{path} differs from the stored episodes (line {line}: stored ")
        path.write_bytes(kept)
    assert verify(store) == []
    (store.tables / "old.md").write_text("95", encoding="utf-8")
    (store.tables / "ablation.csv").unlink()
    missing, old = verify(store)
    assert "ablation.csv is missing" in missing
    assert "old.md is made by no table" in old


def test_one_digit_of_a_page_is_seen(copy: Path, capsys: Capture, done: Command) -> None:
    path = copy / "docs" / "results.md"
    text = path.read_text(encoding="utf-8")
    line = change_digit(path, random.Random(1), SCIENCE)
    assert main(words(copy)) == 1
    err = capsys.readouterr().err
    assert f"{path} differs from stored data (line {line}: stored " in err
    assert "1 difference found" in err
    # what stands outside the block is free
    path.write_text(f"1 2 3\n{text}4 5 6\n", encoding="utf-8")
    done(*words(copy))


def test_the_designs_table_must_follow_from_its_runs(copy: Path) -> None:
    path = copy / "results" / "design" / "runs.csv"
    runs = pd.read_csv(path)
    runs.assign(a_w=runs["a_w"] + 0.01).to_csv(path, index=False)
    (problem,) = Design.problems(copy / "results")
    wanted = runs["a_w"].mean() + 0.01
    assert f"as the optimized workspace, the mean of runs.csv is {wanted:.7g}" in problem
    (path.parent / "meta.json").unlink()
    (problem,) = Design.problems(copy / "results")
    assert "design is not complete" in problem


def test_rows_that_are_not_the_test_episodes_are_named(store: Store) -> None:
    assert check_runs(store) == []
    path = store.completed()[-1].path / "episodes.csv"
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines(keepends=True)
    number, seed, start, rest = lines[1].split(",", 3)
    for changed, message in (
        (lines[:5] + lines[6:], "rows at noise 0.0, error 0 mm, acting greedy, not one for each"),
        ([lines[0], f"{number},{int(seed) + 1},{start},{rest}", *lines[2:]],
         "other than the test seeds"),
        ([lines[0], f"{number},{seed},0000000000,{rest}", *lines[2:]],
         f"of seed {seed} began at"),
    ):  # fmt: skip
        path.write_text("".join(changed), encoding="utf-8")
        (problem,) = check_runs(store)
        assert message in problem
    path.write_text(text, encoding="utf-8")
    learner = learners(store)[0]
    rows = learner.rows("episodes")
    last = rows.index[-1]
    rows.assign(reset_seed=rows["reset_seed"] + (rows.index == last)).to_csv(
        learner.path / "episodes.csv", index=False
    )
    (result,) = check_runs(store)
    assert f"rows at noise {rows['noise'][last]}, error 0 mm, acting greedy of other than" in result
    rows[rows["noise"] == 0.0].to_csv(learner.path / "episodes.csv", index=False)
    (result,) = check_runs(store)
    assert "episodes.csv has noise [0.0], not [0.0, " in result
    rows.assign(acting="exploring").to_csv(learner.path / "episodes.csv", index=False)
    (result,) = check_runs(store)
    assert "episodes.csv has acting ['exploring'], not ['greedy']" in result


def test_an_uncertain_machine_is_tested_at_each_error(tmp_path: Path) -> None:
    store = make_store(
        tmp_path, [0], "cut", episodes=2,
        keep=lambda cell: cell.track == "uncertain" and cell.method == "rainbow",
    )  # fmt: skip
    assert check_runs(store) == []
    (run,) = store.completed()
    rows = run.rows("episodes")
    errors = sorted(map(float, rows["error"].unique()))
    rows[rows["error"] < errors[-1]].to_csv(run.path / "episodes.csv", index=False)
    (problem,) = check_runs(store)
    assert f"episodes.csv has error {errors[:-1]}, not {errors}" in problem


def test_a_policy_that_is_not_its_runs_is_named(store: Store) -> None:
    first, second, third = learners(store)[:3]
    for run, data in ((first, b"one"), (second, b"two")):
        run.policy.write_bytes(data)
        meta = run.meta()
        meta["training"]["policy_sha256"] = run.policy_digest()
        run.write_meta(meta)
    assert check_runs(store) == []
    first.policy.write_bytes(b"two")
    second.policy.write_bytes(b"one")
    third.policy.write_bytes(b"of nobody")  # its meta.json has no digest
    wanted = "policy.zip is not the policy whose digest its meta.json has"
    assert check_runs(store) == [f"{run.path}: {wanted}" for run in (first, second, third)]


def test_a_damaged_or_foreign_run_is_named(store: Store) -> None:
    run = learners(store)[0].path
    curve = (run / "curve.csv").read_text("utf-8")
    episodes, meta = ((run / name).read_text("utf-8") for name in ("episodes.csv", "meta.json"))
    config = (run / "config.yaml").read_text("utf-8")
    missing = ("commit", "dirty", "machine", "cpu_seconds")
    lines = curve.splitlines(keepends=True)
    cut = [lines[0], "".join(lines[:-1]), curve[:-1], curve[:-5]]
    for name, text, message in (
        ("meta.json", '{"schema": 99}', "has results schema 99, this version reads 1"),
        ("meta.json", "{", "cannot be read"),
        ("meta.json", "[]", "cannot be read (no mapping)"),
        ("config.yaml", "cell: [", "cannot be read"),
        ("meta.json", '{"schema": 1, "training": null}', "'training' is no mapping"),
        ("config.yaml", "{}", "lacks 'cell'"),
        ("config.yaml", "cell: a", "'cell' is no mapping"),
        ("config.yaml", config.replace("seed: 0", "seed: 7"), "-s7' by its config.yaml"),
        ("meta.json", meta.replace(run.name, "other"), "'other' by its meta.json"),
        ("meta.json", meta.replace("60.0", '"many"'), "lacks 'wall_seconds', a number"),
        ("episodes.csv", "", "cannot be read"),
        ("episodes.csv", "episode,success\n0,1\n", "episodes.csv lacks the column 'noise'"),
        ("episodes.csv", episodes.replace(",1,", ",5,"), "values in column 'success'"),
        ("episodes.csv", episodes.replace(",25,", ",many,"), "values in column 'moves_first'"),
        ("curve.csv", "timesteps\n500\n", "curve.csv lacks the column 'duration'"),
        *(("meta.json", meta.replace(key, "x"), f"lacks '{key}'") for key in missing),
        *(("curve.csv", text, "cut off before the training's end, step 500") for text in cut),
        ("curve.csv", curve.replace("0.5", "a", 1), "curve.csv holds what is no number"),
    ):
        kept = (run / name).read_bytes()
        (run / name).write_text(text, encoding="utf-8")
        (problem,) = check_runs(store)
        assert str(run) in problem
        assert message in problem
        (run / name).write_bytes(kept)
    run.rename(run.with_name("aaa"))
    (problem,) = check_runs(store)
    assert f"holds the run '{run.name}'" in problem
    store.entries.mkdir()
    run.with_name("aaa").rename(store.entries / "aaa")
    assert check_runs(store) == [problem.replace("/runs/", "/entries/")]


def test_a_setting_changed_by_hand_is_named(copy: Path, store: Store, capsys: Capture) -> None:
    config = learners(store)[0].path / "config.yaml"
    text = config.read_text("utf-8")
    config.write_text(re.sub("gamma: .*", "gamma: 0.5", text), encoding="utf-8")
    assert main(words(copy)) == 1
    (line, total) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"{config.parent} holds a run with other settings (track.hyperparam")
    assert total == "1 difference found"


def test_each_damaged_file_is_a_line(copy: Path, store: Store, capsys: Capture) -> None:
    results, run = copy / "results", store.completed()[-1]
    rows = run.rows("episodes").astype({"noise": object})
    rows.loc[0, "noise"] = "none"
    rows.to_csv(run.path / "episodes.csv", index=False)
    files = {
        "contact/scripts.json": "{",
        "codesign/codesign.json": "{",
        "data/data.json": "{",
        "audit/scripted.csv": "",
        "quick/failures/rainbow-safe.csv": "",
        "trajectory/trajectory.json": "[]",
        "design/runs.csv": "",
    }
    for name, text in files.items():
        (results / name).parent.mkdir(exist_ok=True)
        (results / name).write_text(text, encoding="utf-8")
    for name in ("config.yaml", "chosen.csv"):
        shutil.copy(RESULTS / "codesign" / name, results / "codesign")
    assert main(words(copy)) == 1
    out, err = capsys.readouterr()
    for path in (run.path, *(results / name for name in files)):
        assert len([line for line in err.splitlines() if line.startswith(str(path))]) == 1, err
    assert "Study transfer: its text against its data" in out
    assert "Pages: not looked at until these differences are fixed" in out
    assert main([*words(copy, "tables"), "--preset", "quick"]) == 2
    assert f"error: {run.path / 'episodes.csv'} has values in column" in capsys.readouterr().err


def test_a_store_of_a_preset_of_ones_own_is_named(copy: Path, done: Command) -> None:
    folder = Store.open(copy / "results", "my2", create=True).folder
    assert f"{folder}: not looked at; --preset FILE" in done(*words(copy))
    alone = Store.open(copy / "other", "my2", create=True).folder
    for command, message in (("verify", "not looked at"), ("report", "left out")):
        out = done(command, "--results", str(copy / "other"))
        assert f"{alone}: {message}; --preset FILE says what is in it" in out


def test_a_report_rewrites_the_readme(
    copy: Path, monkeypatch: pytest.MonkeyPatch, done: Command
) -> None:
    monkeypatch.setattr(Insertion, "pictures", lambda *_: [])  # nobody looks at them here
    shutil.rmtree(copy / "results" / "design")
    readme = copy / "README.md"
    before = readme.read_bytes()
    change_digit(readme, random.Random(0), BEGIN, END)
    done(*words(copy, "report"))
    assert readme.read_bytes() == before


def test_the_public_tasks_tables_must_follow_from_their_runs(tmp_path: Path) -> None:
    store = Store.open(tmp_path / "results" / "classic", "public", create=True)
    for table in catalogue.experiment("public").tables(store):  # no run yet: dashes
        table.write(store.tables)
    ((_, problems),) = catalogue.verify(tmp_path / "results", ["public"])  # what is looked at
    assert problems == []
    change_digit(store.tables / "scores.md", random.Random(4))
    _, (_, (problem,)) = catalogue.verify(tmp_path / "results", ["public"])
    assert "scores.md differs" in problem


def test_the_policies_in_git_are_few() -> None:
    """Those of the headline methods; a renewed run adds no file, and quick is not tracked."""
    names = tracked("results/**/policy.zip")
    assert 0 < sum((ROOT / name).stat().st_size for name in names) < 8_000_000
    made = [f"results/cut/runs/{cell.id}/policy.zip" for cell in expand(load_preset("cut"))]
    made = [*({*made} - {*names}), "results/quick/tables/performance.md"]
    ignored = ["git", "check-ignore", "--no-index", *names, *made]
    done = subprocess.run(ignored, cwd=ROOT, capture_output=True, text=True)
    assert sorted(done.stdout.split()) == sorted(made)
