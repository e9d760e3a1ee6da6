"""The results of README.md and of two pages of docs/: sentences, tables and figures of a store."""

from typing import Final

from benchmarks.protocol.paper_values import PERFORMANCE
from benchmarks.reporting.blocks import provenance
from benchmarks.reporting.results import AS_TRAINED, Group, Results
from benchmarks.reporting.tables.beyond import build_tables
from benchmarks.reporting.tables.table import MISSING, Number, Table, TableCell
from benchmarks.reporting.verdicts import sentences

PAPER: Final = ("Performance", "Ablation", "Geometry", "As printed")  # docs/results.md
SHORT: Final = ("in_short", "performance", "components", "geometry", "printed")  # README's
# sections of the page: heading, sentences, tables, figures with their captions
SECTIONS: Final[tuple[tuple[str, tuple[str, ...], tuple[str, ...], dict[str, str]], ...]] = (
    ("Performance", ("performance",), ("performance", "controls"),
     {"performance_profile": "Share of test episodes above a score, all acting greedily"}),
    ("Ablation", ("components",), ("ablation",),
     {"ablation_comparison": "Success with one component removed"}),
    ("Geometry", ("geometry",), ("geometry", "design"), {}),
    ("As printed", ("printed",), (), {}),
    ("All methods", (), ("leaderboard",), {}),
    ("Noise on the observation", (), ("robustness",), {"robustness": "Success over noise"}),
)  # fmt: skip


def short(results: Results) -> str:
    """README's block: one word, four verdicts, a table of six rows, how many runs are complete."""
    report = sentences(results)
    parts = [report[topic].partition("\n\n")[0] for topic in SHORT if topic in report]
    done = len(results.all())
    whole = max(done, results.planned)
    count = f"All {done} runs" if done == whole else f"So far {done} of {whole} runs"
    count += " are complete."
    parts += [six(results).markdown(), count]
    return "\n\n".join(part.strip() for part in parts)


def six(results: Results) -> Table:
    """The README's table of six rows: success rates, the paper's and ours."""
    track, printed = results.scored, PERFORMANCE["success"]
    ours = results.group("rainbow", track).as_trained()
    dqn, ppo = (results.group(name, track).as_trained() for name in ("dqn", "maskable_ppo"))
    methods: list[tuple[str, str, Group | None]] = [
        ("Rainbow", printed["rainbow"], ours),
        ("Vanilla DQN (SB3's, without masks)", printed["dqn"], dqn),
        ("RRT-Connect, the paper's planner", printed["rrt_connect"], results.group("rrt_connect")),
        ("MaskablePPO", "-", ppo),
        ("Best script, with the same masks", "-", results.control_of(ours)),
        ("Exact optimum, which needs a model", "-", results.group("optimum")),
    ]
    made: list[list[TableCell]] = [
        [name, paper, Number(row.success(), suffix=row.lead) if row and row.n else MISSING]
        for name, paper, row in methods
    ]
    trained = ", learners as trained" * (ours.level == AS_TRAINED)
    title = f"Success rate (%) on the test episodes{trained}"
    return Table("six", title, ["Method", "Paper", "Ours"], made)


def science(results: Results, beyond: bool = False) -> str:
    """Sentences, tables and figures by question: the paper's, or those beyond the paper."""
    store, report = results.store, sentences(results)
    by_name = {table.name: table for table in build_tables(results)}
    parts = []
    for heading, topics, names, figures in SECTIONS:
        if beyond is (heading in PAPER):
            continue
        shown = [report[topic] for topic in topics if topic in report]
        shown += [by_name[name].markdown() for name in names if name in by_name]
        if not shown:
            continue
        parts += [f"## {heading}", *shown]
        parts += [
            f"![{alt}](../results/{store.folder.name}/figures/{name}.png)"
            for name, alt in figures.items()
            if (store.figures / f"{name}.png").is_file()
        ]
    if not beyond:
        preset, folders = store.folder.name, [run.folder for run in results.all()]
        again = (
            f"Every number is recomputed from `results/{preset}` by `python -m benchmarks verify`."
        )
        origin = provenance(preset, folders, max(0, results.planned - len(folders)))
        parts.insert(0, f"{origin} {again}" if folders else origin)
    return "\n\n".join(part.strip() for part in parts if part.strip())
