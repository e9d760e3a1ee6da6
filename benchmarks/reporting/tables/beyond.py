"""Tables beyond the paper's: leaderboard, comparisons, uncertain machine, tasks, teams."""

from collections.abc import Iterator
from operator import attrgetter
from typing import Final

from benchmarks.protocol import labels
from benchmarks.protocol.metrics import HOLES, JOINTS_TIME, METRICS, SUCCESS
from benchmarks.protocol.plan import METHODS, OPTIMUM_AT_ONCE
from benchmarks.reporting.compared import comparisons, differences
from benchmarks.reporting.results import AS_TRAINED, Group, Level, Result, Results, complete
from benchmarks.reporting.stats import measured
from benchmarks.reporting.tables import paper
from benchmarks.reporting.tables.table import Number, Table, TableCell, p_text

KNOWS: Final = ("Masks", "Memory")  # headers of what stands behind a method's name
# of the tasks: column -> method, geometry
PLAYERS: Final[dict[str, tuple[str, str]]] = {
    "Optimum, initial geometry": ("optimum", "initial"),
    "Optimum": ("optimum", "optimized"),
    "RRT-Connect": ("rrt_connect", "optimized"),
    "Greedy script": ("greedy", "optimized"),
    "Lookahead": ("lookahead", "optimized"),
    "Rainbow": ("rainbow", "optimized"),
}
IN_TURN: Final = "in_turn"  # the track of one robot at a time with the settings of the teams
TEAM_METRICS: Final = (METRICS["time_first"], JOINTS_TIME, HOLES, METRICS["collisions"])
TEAMS: Final = {
    "central": "Rainbow on 49 joint moves",
    "vdn": "VDN, a sum of two Rainbows",
    "shared": "Rainbow with shared parameters",
    "independent": "Independent Rainbows",
}


def build_tables(results: Results) -> list[Table]:
    """The tables for which a store has runs, the paper's first."""
    if tasks(results):  # a preset about the task has no headline
        return [difficulty(results)]
    ablations, geometries = ({key[i] for key in results.groups} for i in (1, 2))
    made = [paper.performance(results), paper.controls(results)]
    made += [] if ablations <= labels.ALL_OR_NONE else [paper.ablation(results)]
    made += [paper.geometry(results)] if "initial" in geometries else []
    made += [paper.design(results), leaderboard(results), paper.robustness(results)]
    made += [uncertain(results), *team(results)]
    compared = significance(results)
    return [table for table in made if table.holds_results] + [compared] * bool(compared.rows)


def leaderboard(results: Results) -> Table:
    """Table "leaderboard": a row per method of the nominal machine, and per entry of others.

    Ranked by greedy success rate, then by holes; the optimum stands above them all.
    """
    entries: dict[str, list[Result]] = {}
    for folder in results.store.entered():
        result = Result.read(folder)
        entries.setdefault(result.config["cell"]["method"], []).append(result)
    shown = [row for row in complete(results.rows()) if row.method != "random"]
    shown += complete(_removals(results))
    brought = []
    for name, runs in entries.items():
        entry = runs[0].config["entry"]
        models = len({run.config["entry"]["sha256"] for run in runs} - {""})
        brought.append(f"{name} ({entry['algorithm']}{f', models: {models}' if models else ''})")
        by_seed = tuple(sorted(runs, key=attrgetter("seed")))
        shown.append(Group(name, settings=entry, runs=by_seed))
    shown.sort(key=lambda row: (-row.success().mean, -row.value(HOLES).mean, row.name))
    shown.sort(key=lambda row: row.method != "optimum")
    made: list[list[TableCell]] = []
    rank = 0
    for row in shown:
        rank += row.method != "optimum"
        trained = row.at(AS_TRAINED).success()
        made.append([
            "-" if row.method == "optimum" else str(rank), *_head(row, _entry(row)),
            Number(row.success(), 1), Number(trained, 1) if trained.n else "-",
            Number(row.value(HOLES), HOLES.digits),
        ])  # fmt: skip
    header = ["Rank", "Method", *KNOWS, "Success (%)", "Exploring (%)", HOLES.label]
    notes = [
        "Optimized geometry, all methods on the same initial states; success and holes of greedy "
        "acting. Exploring: learners as they were trained, scripts with 5 % of random moves.",
        *paper.seeds_notes(shown, [_entry(row) for row in shown]),
        *([f"Brought: {', '.join(brought)}."] if brought else []),
        "Join with one command: python -m benchmarks evaluate --model FILE --name NAME",
    ]
    return Table("leaderboard", "Leaderboard", header, made, notes, left=(1, 2, 3))


def _removals(results: Results) -> Iterator[Group]:
    """Rainbow without a component, on the tracks that have no table of removals."""
    for track in results.tracks():
        if track != results.scored and not results.uncertain(track):
            for key in labels.ABLATIONS:
                if key.startswith("no_"):
                    yield results.group("rainbow", track, ablation=key)


def _entry(row: Group) -> str:
    """What a row is called on the board."""
    if not row.ablation.startswith("no_"):
        return row.name
    return labels.on_track(f"{row.title} {labels.ABLATIONS[row.ablation]}", row.track)


def _head(row: Group, name: str = "") -> list[TableCell]:
    """The first cells of a row: the method, its masks and memory."""
    return [name or row.name, row.knows.masks, row.knows.memory]


def significance(results: Results) -> Table:
    """Table "significance": every comparison that a sentence rests on, by question."""
    header = ["Question", "Method", "Against", "Difference (points)", "p", "p (Holm)", "Seeds"]
    result = comparisons(results)
    # one seed tests nothing: it is shown only where there is nothing else
    result = [each for each in result if each.difference.n > 1] or result
    made: list[list[TableCell]] = [
        [each.question, f"{each.name}, {each.ours.acting}",
         f"{each.theirs.name}, {each.theirs.acting}", each.difference.signed(), p_text(each.p),
         p_text(each.p_holm), str(each.difference.n)]
        for each in result
    ]  # fmt: skip
    notes = [
        "Success rates, one difference per seed on the same starts (of the geometries: on their "
        "own): mean with Student's 95 % interval, two-sided paired t-test, Holm within a question.",
    ]
    return Table("significance", "Comparisons", header, made, notes, left=(0, 1, 2))


def error_levels(results: Results) -> list[float]:
    """Bounds of the base's displacement, mm, that any run was tested at."""
    tested = [run for row in results.rows(uncertain=True) for run in row.runs]
    errors = {level.error for run in tested for level in run.levels}
    return sorted(error for error in errors if error is not None)


def uncertain(results: Results) -> Table:
    """Table "uncertain": each method at its track's own bound, then at the ends."""
    levels = error_levels(results)
    ends = [levels[0], levels[-1]] if levels else []
    header = ["Method", *KNOWS, "Success (%)", HOLES.label]
    header += [f"Success (%) at {level:g} mm" for level in ends]
    made: list[list[TableCell]] = []
    result = results.rows(uncertain=True)
    for row in result:
        there = [row.at(Level(error=level)) for level in ends]
        cells = [row.cell(each.success()) for each in (row, *there)]
        cells.insert(1, row.cell(row.value(HOLES), HOLES.digits))
        made.append([*_head(row), *cells])
    notes = [
        f"The base of the 3-RRS is displaced by up to {bound:g} mm along each axis and tilted in "
        "proportion, drawn anew each episode; masks, observations and plans are those of the "
        "nominal model."
        for bound in sorted({run.error for row in result for run in row.runs})
    ]
    notes = [*paper.seeds_notes(result), *notes]
    title = "Success on the uncertain machine"
    return Table("uncertain", title, header, made, notes, left=(0, 1, 2))


def tasks(results: Results) -> list[str]:
    """Tracks that change the task and nothing else, in the preset's order."""
    return [track for track in results.tracks() if results.settings.get(track, {}).get("task")]


def difficulty(results: Results) -> Table:
    """Table "difficulty": success rate (%) by task, one row for each track that changes it."""
    made: list[list[TableCell]] = []
    result: list[Group] = []
    for track in tasks(results):
        rows = [results.group(method, track, geometry) for method, geometry in PLAYERS.values()]
        result += rows
        cells = [row.cell(row.as_trained().success()) for row in rows]
        made.append([track.replace("_", " "), *cells])
    notes = [
        *paper.seeds_notes(result, [f"{row.name}, {row.geometry} geometry" for row in result]),
        *_gains(results),
        "As stated: 10 mm and 5 degrees, moves of 20 mm and 0.03 rad, holes at 30 degrees, "
        "colliding moves are refused. Scripts act with 5 % of random moves, Rainbow as trained, "
        "all under the paper's masks.",
    ]
    return Table("difficulty", "Success rate (%) by task", ["Task", *PLAYERS], made, notes)


def _gains(results: Results) -> list[str]:
    """How the design stage changes the optimum's success, task by task."""
    gains = []
    for track in tasks(results):
        before, after = (results.group("optimum", track, end).success() for end in paper.ENDS)
        if before.n and after.n:
            gains.append(f"{track.replace('_', ' ')} {after.mean - before.mean:+.1f}")
    return [f"The design stage changes the optimum's points: {', '.join(gains)}."] if gains else []


def team(results: Results) -> list[Table]:
    """Table "team", where a store has such runs: who moves, who decides in sight of what."""
    tracks = [*results.tracks(teams=True), ""]
    groups = [row for row in results.groups.values() if row.geometry == "optimized"]
    groups = [row for row in groups if row.method != "random"]  # who never inserts
    at_once = [row for t in tracks for row in groups if row.track == t and _at_once(row)]
    if not at_once:
        return []
    ablations = [name for name in labels.ABLATIONS if name in {row.ablation for row in at_once}]
    in_turn = [row for row in results.rows() if row.method != "random"]
    for name in ablations:
        row = results.group("rainbow", IN_TURN, ablation=name)
        in_turn += [row] if row.known and row not in in_turn else []
    result = sorted([*in_turn, *at_once], key=_order)
    optimum = results.group(OPTIMUM_AT_ONCE)
    header = ["Method", "Components", "Robots move", "Decided by", "Success (%)"]
    metrics = [m for m in TEAM_METRICS if m != JOINTS_TIME or paper.timed(result)]
    header += [*(metric.label for metric in metrics), "Ticks over the optimum at once (%)"]
    made: list[list[TableCell]] = []
    for row in result:
        cells = [row.measure(metric) for metric in (SUCCESS, *metrics)]
        made.append([*_form(row), *cells, row.cell(row.excess(optimum))])
    notes = [
        *paper.seeds_notes(result, [f"{row.name}, {row.ablation}" for row in result]),
        "In turn a tick moves one robot, at once both. Ticks over the optimum: up to the first "
        "insertion, on starts that both solved.",
        *(answer for name in ablations for answer in _answer(at_once, name)),
    ]
    title = "Two robots: both at once or in turn, one agent or two"
    return [Table("team", title, header, made, notes, left=(0, 1, 2, 3))]


def _of(row: Group) -> str:
    return str((row.settings or {}).get("team") or "")


def _sees(row: Group) -> bool:
    return bool((row.settings or {}).get("sight"))


def _at_once(row: Group) -> bool:
    return bool(_of(row)) or row.method == OPTIMUM_AT_ONCE


def _order(row: Group) -> tuple[int, int, bool]:
    """Learners, the components together, then scripts and planners; in turn before at once."""
    names = list(labels.ABLATIONS)
    return METHODS.index(row.method), names.index(row.ablation), _at_once(row)


def _form(row: Group) -> list[TableCell]:
    """Method, its components, whether both robots move at once, and who decides."""
    kind, learns = _of(row), row.method == "rainbow"
    name = TEAMS.get(kind, "Rainbow") if learns else labels.METHODS[row.method]
    sees = ", in sight" if _sees(row) else ", without sight"
    return [
        name.removesuffix(", both at once"),
        labels.ABLATIONS[row.ablation] if learns else "-",
        "at once" if _at_once(row) else "in turn",
        f"each robot{sees}" if kind not in ("", "central") else "one for both",
    ]


def _answer(at_once: list[Group], ablation: str) -> list[str]:
    """What decentralization costs the best learner with and without sight; empty without runs."""
    learned = [r for r in complete(at_once) if (r.method, r.ablation) == ("rainbow", ablation)]
    central = [row for row in learned if _of(row) == "central"]
    parts = []
    for sight, place in ((True, "in sight"), (False, "without sight")):
        seen = [row for row in learned if row not in central and _sees(row) == sight]
        if central and seen:
            best = max(seen, key=lambda row: row.success().mean)
            change = measured(differences("", best, central[0])).signed(" points")
            parts.append(f"{place} {TEAMS[_of(best)]}, the best, changes that by {change}")
    if not parts:
        return []
    rate = f"the central Rainbow has {central[0].success().mean:.1f} %"
    what = labels.ABLATIONS[ablation]
    return [f"{what}, what decentralization costs: {'; '.join([rate, *parts])}."]
