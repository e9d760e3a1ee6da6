"""What reproduced, what did not, and why: sentences that say only what the stored runs say."""

from __future__ import annotations

import math

from benchmarks.protocol import labels
from benchmarks.protocol.metrics import HOLES, METRICS
from benchmarks.protocol.paper_values import PERFORMANCE
from benchmarks.protocol.plan import ABLATIONS
from benchmarks.reporting.results import Group, Results, excess_over_optimum, tail_mean
from benchmarks.reporting.stats import Value, over_seeds

NEAR = 0.98  # of the optimum's success counts as reaching it
TIME = METRICS["time_first"]


def sentences(results: Results) -> list[str]:
    """At most five sentences; one is left out where its runs are missing."""
    found = [
        _ceiling(results),
        _ranking(results),
        _printed(results),
        _components(results),
        _geometry(results),
    ]
    return [sentence for sentence in found if sentence]


def best_track(results: Results) -> str:
    """The last track of the usual order that Rainbow was run on: tuned before repaired."""
    tracks = [t for t in results.tracks() if t != "printed" and results.group("rainbow", track=t).n]
    return tracks[-1] if tracks else ""


def _show(value: Value, digits: int = 1) -> str:
    return "none" if math.isnan(value.mean) else value.text(digits)


def _ceiling(results: Results) -> str:
    track = best_track(results)
    ours, optimum = results.group("rainbow", track=track), results.group("optimum")
    if not track or not optimum.n:
        return ""
    success, ceiling = _show(ours.success()), _show(optimum.success())
    paper, seconds = (PERFORMANCE[key]["rainbow"] for key in ("success", "time_first"))
    verdict = "reproduces" if _reaches(ours, optimum) else "falls short"
    return (
        f"**The success rate {verdict}**: Rainbow ({labels.track(track)}) inserts in {success} % "
        f"of the test episodes (paper {paper}, exact optimum {ceiling}), after "
        f"{_show(ours.value(TIME), 2)} s (paper {seconds}), with "
        f"{_show(excess_over_optimum(ours, optimum))} % more moves than the optimum, and fills "
        f"{_show(ours.value(HOLES), 2)} of six holes."
    )


def _reaches(ours: Group, optimum: Group) -> bool:
    """Whether success is at least 95 % and at least 0.98 of the optimum's."""
    mean = ours.success().mean
    return mean >= 95.0 and mean >= NEAR * optimum.success().mean


def _ranking(results: Results) -> str:
    track = best_track(results)
    rivals = [
        ("RRT-Connect", results.group("rrt_connect")),
        ("RRT-Connect with an exact last stretch", results.group("rrt_lattice")),
        ("SB3's DQN, which knows no masks,", results.group("dqn", track=track)),
        ("MaskablePPO", results.group("maskable_ppo", track=track)),
    ]
    masked = results.group("rainbow", track=track, ablation="none")
    rivals.append(("masked DQN, all six components off,", masked))
    shown = [f"{name} {_show(group.success())} %" for name, group in rivals if group.n]
    if not shown:
        return ""
    return f"**Beside it** stand {', '.join(shown)}, on the same starts."


def _printed(results: Results) -> str:
    ours = results.group("rainbow", track="printed")
    if not ours.n:
        return ""
    dqn = results.group("dqn", track="printed")
    also = f", DQN in {_show(dqn.success())} %" if dqn.n else ""
    success = f"Rainbow inserts in {_show(ours.success())} %{also}"
    if ours.success().mean >= 50.0:
        return f"**As printed** {success}."
    reward, holes = _last_episodes(ours, "episode_reward"), _last_episodes(ours, "holes")
    why = ""
    if reward.mean > 0.0 and holes.mean < 0.5:
        why = ": the reward pays for moving to and fro and for hovering (docs/learning.md)"
    return (
        f"**As printed the method does not learn the task**: {success}. Its last training episodes "
        f"earn {_show(reward, 0)} each and fill {_show(holes, 2)} holes{why}."
    )


def _last_episodes(group: Group, column: str) -> Value:
    return over_seeds([tail_mean(run.folder.rows("curve"), column) for run in group.runs])


def _components(results: Results) -> str:
    for track in ("repaired", "tuned"):
        full = results.group("rainbow", track=track)
        groups = {
            name: results.group("rainbow", "optimized", track, name)
            for name in ABLATIONS
            if name not in ("full", "none")
        }
        if not full.n or not all(group.n for group in groups.values()):
            continue
        base = full.success()
        worse, better, same = [], [], []
        for name, group in groups.items():
            value = group.success()
            text = f"{labels.ABLATIONS[name].removeprefix('- ').lower()} {_show(value)}"
            if value.high < base.low:
                worse.append(text)
            elif value.low > base.high:
                better.append(text)
            else:
                same.append(text)
        parts = [f"with all six on {labels.track(track)} {_show(base)} %"]
        for word, names in (
            ("less", worse),
            ("more", better),
            ("no clear difference, under masks that leave little to do,", same),
        ):
            if names:
                parts.append(f"{word} without {', '.join(names)}")
        verdict = "reproduces in part" if worse else "does not reproduce"
        return f"**The ablation {verdict}**: {'; '.join(parts)}."
    return ""


def _geometry(results: Results) -> str:
    track = best_track(results)
    pairs = [
        (results.group(method, geometry=end, track=t).success())
        for method, t in (("rainbow", track), ("optimum", ""))
        for end in ("initial", "optimized")
    ]
    if any(value.n == 0 for value in pairs):
        return ""
    before, after, low, high = pairs
    figures = (
        f"from the initial to the optimized 3-RRS the optimum goes from {_show(low)} to "
        f"{_show(high)} %, Rainbow from {_show(before)} to {_show(after)} %"
    )
    if before.mean >= NEAR * low.mean and after.mean >= NEAR * high.mean:
        return (
            f"**The design stage's effect reproduces**: {figures}; the learner is at the ceiling "
            "with both, so that it gains what the geometry makes reachable."
        )
    verdict = "reproduces in part" if after.mean > before.mean else "does not reproduce"
    return f"**The design stage's effect {verdict}**: {figures}."
