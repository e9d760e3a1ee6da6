"""The paper's tables from stored data alone: the paper's value beside ours and the optimum's.

Nothing is trained or re-evaluated here, and torch is not imported.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

from benchmarks import labels, paper_values
from benchmarks.metrics import EXTRA_METRICS, PAPER_METRICS
from benchmarks.report import Cell, Number, Table
from benchmarks.results import Group, Results, excess_over_optimum
from benchmarks.stats import holm, interquartile_mean, paired_t_test, stratified_bootstrap
from benchmarks.store import Store

# the five that a run prints; hyperparameters and significance are written beside them
PRINTED: Final = ("design", "performance", "ablation", "geometry", "robustness")
BASELINES: Final = ("rrt_connect", "rrt_lattice")


def build_tables(store: Store) -> list[Table]:
    """All tables of a store, in the paper's order."""
    results = Results(store)
    return [
        hyperparameters(results),
        design(results),
        performance(results),
        significance(results),
        ablation(results),
        geometry(results),
        robustness(results),
    ]


def write_tables(store: Store, tables: list[Table] | None = None) -> list[Path]:
    """Write every table as CSV, Markdown and LaTeX."""
    built = build_tables(store) if tables is None else tables
    return [path for table in built for path in table.write(store.tables)]


def hyperparameters(results: Results) -> Table:
    """Table "hparams": the paper's settings and each track's."""
    tracks = results.tracks()
    columns = [_track_settings(results, track) for track in tracks]
    rows: list[list[Cell]] = [
        [name, paper, *[column.get(name, "-") for column in columns]]
        for name, paper in paper_values.HYPERPARAMETERS.items()
    ]
    ours = columns[0] if columns else {}
    extra = [name for name in ours if name not in paper_values.HYPERPARAMETERS]
    rows += [[name, "not given", *[column[name] for column in columns]] for name in extra]
    header = ["Parameter", "Paper", *[f"Ours, {labels.track(t)}" for t in tracks]]
    return Table("hyperparameters", "Training hyperparameters", header, rows)


def _track_settings(results: Results, track: str) -> dict[str, str]:
    run = next(run for run in results.all() if run.config["cell"]["track"] == track)
    settings = run.config["track"]
    h: dict[str, Any] = settings["hyperparameters"]
    decay = "" if h["learning_rate_end"] == h["learning_rate"] else f" → {h['learning_rate_end']:g}"
    curriculum = settings["curriculum"]
    kwargs = settings["reward_kwargs"]
    return {
        "Optimizer": "Adam",
        "Learning rate": f"{h['learning_rate']:g}{decay}",
        "Weight decay": f"{h['weight_decay']:g}",
        "Gradient clipping": f"{h['max_grad_norm']:g}",
        "Discount factor gamma": f"{h['gamma']:g}",
        "n-step return": str(h["n_steps"]),
        "Replay buffer capacity": str(h["buffer_size"]),
        "PER alpha; beta": f"{h['alpha']:g}; {h['beta_start']:g} → {h['beta_end']:g}",
        "Batch size": str(h["batch_size"]),
        "Target update": f"soft, tau = {h['tau']:g}",
        "Exploration": "NoisyNets",
        "Distributional atoms": f"{h['n_atoms']} in [{h['v_min']:g}, {h['v_max']:g}]",
        "Total environment steps": str(settings["timesteps"]),
        "Curriculum switch": (
            f"{100 * curriculum['threshold']:g} % success over {curriculum['window']} episodes"
            if curriculum["enabled"]
            else "none"
        ),
        "Hardware": _hardware(results, track),
        "Reward": settings["reward"]
        + "".join(f", {key} {value:g}" for key, value in kwargs.items()),
        "Noisy layers' sigma0": f"{h['sigma0']:g}",
        "Environments": str(h["n_envs"]),
        "Updates per environment step": f"{h['updates_per_step']:g}",
        "Random steps before learning": str(h["learning_starts"]),
        "Hidden layers": "-".join(str(width) for width in h["net_arch"]),
    }


def _hardware(results: Results, track: str) -> str:
    runs = [r for r in results.all() if r.config["cell"]["track"] == track]
    minutes = [run.meta["wall_seconds"] / 60.0 for run in runs]
    return f"1 CPU core, {sum(minutes) / len(minutes):.1f} min a run"


def design(results: Results) -> Table:
    """Table "results": the geometric optimization, five metrics."""
    header = ["Metric", "Initial, paper", "Initial, ours", "Optimized, paper", "Optimized, ours"]
    rows: list[list[Cell]] = []
    notes = []
    stored = {}
    if results.design is not None:
        frame = results.design.rows("design").fillna("")
        stored = {str(row["metric"]): row for row in frame.to_dict("records")}
        notes = [str(row["note"]) for row in stored.values() if row["note"]]
        runs = results.design.config()["design"]["runs"]
        notes.insert(0, f"Ours: mean ± std over {runs} Nelder-Mead runs, each with its own jitter.")
    for key, (initial, optimized) in paper_values.DESIGN.items():
        ours = stored.get(key, {"initial": "-", "optimized": "-"})
        label = labels.DESIGN_METRICS[key]
        rows.append([label, initial, str(ours["initial"]), optimized, str(ours["optimized"])])
    return Table("design", "Geometric optimization of the 3-RRS", header, rows, notes)


def _columns(results: Results) -> list[tuple[str, str, Group]]:
    """(header, method, group) of the performance table's own columns."""
    columns = [("RRT-Connect", "rrt_connect", results.group("rrt_connect"))]
    closed = results.group("rrt_lattice")
    if closed.n:
        columns.append((labels.METHODS["rrt_lattice"], "rrt_lattice", closed))
    for method in ("dqn", "rainbow"):
        for track in results.tracks() or ["tuned"]:
            group = results.group(method, track=track)
            columns.append((f"{labels.METHODS[method]}, {labels.track(track)}", method, group))
    columns.append((labels.METHODS["optimum"], "optimum", results.group("optimum")))
    return columns


def performance(results: Results) -> Table:
    """Table "performance": the paper's six metrics and ours beyond them, per method."""
    columns = _columns(results)
    header = ["Metric"]
    seen: set[str] = set()
    layout: list[tuple[str, Group | None]] = []
    for title, method, group in columns:
        if method in paper_values.PERFORMANCE["success"] and method not in seen:
            header.append(f"{labels.METHODS[method]}, paper")
            layout.append((method, None))
            seen.add(method)
        header.append(title)
        layout.append((method, group))
    rows: list[list[Cell]] = []
    for metric in (*PAPER_METRICS, *EXTRA_METRICS):
        row: list[Cell] = [metric.label]
        for method, ours in layout:
            if ours is None:
                row.append(paper_values.PERFORMANCE.get(metric.key, {}).get(method, "-"))
            elif metric.key == "success":
                row.append(Number(ours.success(), metric.digits))
            else:
                row.append(Number(ours.value(metric.reduce), metric.digits))
        rows.append(row)
    rows.append(_excess_row(results, layout))
    if any(group is not None and group.n > 1 for _, group in layout):
        rows.append(_iqm_row(layout))
    notes = [_seeds_note([group for _, _, group in columns]), *_failure_notes(results)]
    return Table("performance", "Performance on the test episodes", header, rows, notes)


def _excess_row(results: Results, layout: list[tuple[str, Group | None]]) -> list[Cell]:
    optimum = results.group("optimum")
    row: list[Cell] = ["Moves to first insertion over the optimum (%)"]
    for _, group in layout:
        row.append("-" if group is None else Number(excess_over_optimum(group, optimum), 1))
    return row


def _iqm_row(layout: list[tuple[str, Group | None]]) -> list[Cell]:
    row: list[Cell] = ["Success rate, IQM over seeds [95 % interval]"]
    for _, group in layout:
        if group is None or group.n < 2:
            row.append("-")
            continue
        rates = [[100.0 * float(run.test()["success"].mean())] for run in group.runs]
        low, high = stratified_bootstrap(rates)
        row.append(f"{interquartile_mean(rates):.1f} [{low:.1f}, {high:.1f}]")
    return row


def _seeds_note(groups: list[Group]) -> str:
    seeds = sorted({group.n for group in groups if group.n})
    lengths = sorted({len(run.test()) for group in groups for run in group.runs})
    if not seeds:
        return "No run of this preset is complete."
    episodes = "/".join(str(n) for n in lengths)
    if seeds == [1]:
        return f"Ours: n = 1 seed x {episodes} test episodes, so no spread can be given."
    counts = "/".join(str(n) for n in seeds)
    return f"Ours: mean ± std over n = {counts} seeds x {episodes} test episodes."


def _failure_notes(results: Results) -> list[str]:
    notes = []
    for method in BASELINES:
        rows = results.group(method).pooled()
        if not len(rows) or "failure" not in rows:
            continue
        failed = rows[rows["success"] == 0]
        causes = failed["failure"].value_counts()
        text = ", ".join(f"{cause} {count}" for cause, count in sorted(causes.items()))
        notes.append(
            f"{labels.METHODS[method]}: {len(failed)} of {len(rows)} episodes without an insertion"
            + (f" ({text})" if text else "")
            + f"; median planning time {1000 * rows['plan_seconds'].median():.1f} ms."
        )
    return notes


def significance(results: Results) -> Table:
    """Paired t-tests of Rainbow against each baseline on the common initial states."""
    header = ["Comparison", "Metric", "Difference", "t", "p (Holm)", "Effect d_z", "Pairs"]
    rows: list[list[Cell]] = []
    for track in results.tracks():
        ours = results.group("rainbow", track=track).pooled()
        for method, theirs_group in (
            ("dqn", results.group("dqn", track=track)),
            ("rrt_connect", results.group("rrt_connect")),
            ("rrt_lattice", results.group("rrt_lattice")),
            ("optimum", results.group("optimum")),
        ):
            theirs = theirs_group.pooled()
            if not len(ours) or not len(theirs):
                continue
            common = ours.index.intersection(theirs.index)
            tests = [
                paired_t_test(
                    metric.scale * ours.loc[common, metric.column],
                    metric.scale * theirs.loc[common, metric.column],
                )
                for metric in PAPER_METRICS
            ]
            corrected = holm([test.p for test in tests])
            title = f"Rainbow ({labels.track(track)}) - {labels.METHODS[method]}"
            for metric, test, p in zip(PAPER_METRICS, tests, corrected, strict=True):
                rows.append([
                    title,
                    metric.label,
                    _signed(test.difference, metric.digits),
                    _signed(test.t, 2),
                    "-" if math.isnan(p) else f"{p:.2g}",
                    _signed(test.effect, 2),
                    str(test.n),
                ])  # fmt: skip
    notes = [
        "Two-sided paired t-tests over test episodes with the same initial state; metrics that "
        "need an insertion pair only episodes in which both inserted. Holm over the six metrics."
    ]
    return Table("significance", "Rainbow against each method", header, rows, notes)


def _signed(number: float, digits: int) -> str:
    return "-" if math.isnan(number) else f"{number:+.{digits}f}"


def ablation(results: Results) -> Table:
    """Table "ablation": success rate with one component removed at a time."""
    tracks = results.tracks() or ["tuned"]
    header = ["Configuration", "Success (%), paper"]
    for track in tracks:
        name = labels.track(track)
        header += [f"Success (%), {name}", "95 % interval", f"Steps to 75 % (1e5), {name}"]
    rows: list[list[Cell]] = []
    groups: list[Group] = []
    for key, paper in paper_values.ABLATION.items():
        row: list[Cell] = [labels.ABLATIONS[key], paper]
        for track in tracks:
            group = results.group("rainbow", track=track, ablation=key)
            groups.append(group)
            success = group.success()
            row += [Number(success, 1), success.interval_text(1), _steps_to_75(group)]
        rows.append(row)
    best = results.group("optimum").success()
    optimum: list[Cell] = [labels.METHODS["optimum"], "-"]
    for _ in tracks:
        optimum += [Number(best, 1), best.interval_text(1), "-"]
    rows.append(optimum)
    notes = [_seeds_note(groups), _interval_note(groups)]
    return Table("ablation", "Rainbow with one component removed", header, rows, notes)


def _interval_note(groups: list[Group]) -> str:
    if max((group.n for group in groups), default=0) > 1:
        return "Intervals: stratified bootstrap over seeds."
    return "Intervals: Wilson's, over the test episodes of the one seed."


def _steps_to_75(group: Group) -> Cell:
    value = group.meta("steps_to_75", 1e-5)
    if not group.n:
        return "-"
    if not value.n:
        return "not reached"
    missed = group.n - value.n
    return Number(value, 2, f" ({missed} of {group.n} never)" if missed else "")


def geometry(results: Results) -> Table:
    """Table "geo_ablation": the full Rainbow on the initial and on the optimized geometry."""
    tracks = results.tracks() or ["tuned"]
    header = ["Metric", "Initial, paper"]
    header += [f"Initial, {labels.track(t)}" for t in tracks]
    header += ["Optimized, paper"] + [f"Optimized, {labels.track(t)}" for t in tracks]
    groups = {
        name: [results.group("rainbow", name, track) for track in tracks]
        for name in ("initial", "optimized")
    }
    paper = paper_values.GEOMETRY_ABLATION

    def row(label: str, key: str, cell: Any) -> list[Cell]:
        initial, optimized = paper.get(key, ("-", "-"))
        ours = [[cell(group) for group in groups[name]] for name in ("initial", "optimized")]
        return [label, initial, *ours[0], optimized, *ours[1]]

    singular = next(metric for metric in EXTRA_METRICS if metric.key == "singular")
    rows = [
        row("Env. steps to 75 % success (1e5)", "steps_to_75", _steps_to_75),
        row("Final success rate (%)", "success", lambda g: Number(g.success(), 1)),
        row(
            "Singularity terminations / 1000 training ep.",
            "singular_per_1000",
            lambda g: Number(g.meta("singular_per_1000"), 1),
        ),
        row(
            "Singularity terminations / 1000 test ep.",
            "",
            lambda g: Number(g.value(singular.reduce), 1),
        ),
    ]
    ceiling: list[Cell] = ["Exact optimum's success rate (%)"]
    for name in ("initial", "optimized"):
        best = results.group("optimum", name).success()
        ceiling += ["-", *[Number(best, 1) for _ in tracks]]
    rows.append(ceiling)
    notes = [_seeds_note([*groups["initial"], *groups["optimized"]])]
    return Table("geometry", "Full Rainbow before and after the optimization", header, rows, notes)


def robustness(results: Results) -> Table:
    """Section "Robustness": success under Gaussian noise on the normalized observation."""
    levels = results.noise_levels() or [0.0, 0.01]
    header = ["Method", *[f"Noise {level:g}" for level in levels], "Change at 0.01 (points)"]
    paper = paper_values.ROBUSTNESS
    rows: list[list[Cell]] = [
        ["Rainbow DQN, paper", *[paper.get(level, "-") for level in levels], "-7.0"]
    ]
    groups = []
    for method in ("rainbow", "dqn"):
        for track in results.tracks():
            group = results.group(method, track=track)
            groups.append(group)
            values = [group.success(level) for level in levels]
            title = f"{labels.METHODS[method]}, {labels.track(track)}"
            rows.append([title, *[Number(value, 1) for value in values], _change(group)])
    best = results.group("optimum").success()
    rows.append(
        [f"{labels.METHODS['optimum']} (true state)", *[Number(best, 1)] * len(levels), "-"]
    )
    notes = [_seeds_note(groups), "Noise: standard deviation as a share of the normalized range."]
    return Table("robustness", "Success rate (%) under observation noise", header, rows, notes)


def _change(group: Group) -> str:
    clean, noisy = group.success(), group.success(0.01)
    if not noisy.n or not clean.n:
        return "-"
    return _signed(noisy.mean - clean.mean, 1)
