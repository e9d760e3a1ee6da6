"""The paper's table of hyperparameters beside each track's settings, from the runs' own records."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benchmarks.protocol import labels, paper_values
from benchmarks.protocol.knowledge import knowledge
from benchmarks.protocol.plan import LEARNERS
from benchmarks.reporting.results import Result, Results
from benchmarks.reporting.tables.table import Cell, Table


def hyperparameters(results: Results) -> Table:
    """Table "hparams": the paper's settings and each track's, masks and memory among them."""
    tracks = [*results.tracks(), *results.teams()]
    columns = [_track_settings(results, track) for track in tracks]
    names = dict.fromkeys([*paper_values.HYPERPARAMETERS, *(n for c in columns for n in c)])
    rows: list[list[Cell]] = [
        [
            name,
            paper_values.HYPERPARAMETERS.get(name, "not given"),
            *[column.get(name, "missing") for column in columns],
        ]
        for name in names
    ]
    header = ["Parameter", "Paper", *[f"Ours, {labels.track(t)}" for t in tracks]]
    return Table("hyperparameters", "Training hyperparameters", header, rows)


def _track_settings(results: Results, track: str) -> dict[str, str]:
    """What Rainbow of a track is given: of its runs, or where there is none of the preset."""
    runs = [run for _, group in results.methods(track, LEARNERS) for run in group.runs]
    settings = runs[0].config["track"] if runs else results.settings(track)
    if settings is None or "hyperparameters" not in settings:
        return {}
    h: dict[str, Any] = settings["hyperparameters"]
    constant = h["learning_rate_end"] == h["learning_rate"]
    decay = "" if constant else f" → {h['learning_rate_end']:g}"
    curriculum = settings["curriculum"]
    kwargs = settings["reward_kwargs"]
    knows = knowledge("rainbow", settings)
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
        "Distributional atoms": f"{h['n_atoms']} quantiles"
        if h["v_min"] is None
        else f"{h['n_atoms']} in [{h['v_min']:g}, {h['v_max']:g}]",
        "Total environment steps": str(settings["timesteps"]),
        "Curriculum switch": (
            f"{100 * curriculum['threshold']:g} % success over {curriculum['window']} episodes"
            if curriculum["enabled"]
            else "none"
        ),
        "Hardware": _hardware(runs),
        "Reward": settings["reward"]
        + "".join(f", {key} {value:g}" for key, value in kwargs.items()),
        "Masks": knows.masks,
        "Memory": knows.memory,
        "Machine": _machine(settings),
        "Learning rate's schedule": "constant" if constant else "linear in the steps",
        "Noisy layers' sigma0": f"{h['sigma0']:g}",
        "Environments": str(h["n_envs"]),
        "Updates per environment step": f"{h['updates_per_step']:g}",
        "Random steps before learning": str(h["learning_starts"]),
        "Hidden layers": "-".join(str(width) for width in h["net_arch"]),
    }


def _machine(settings: dict[str, Any]) -> str:
    knobs = settings.get("sim_to_real")
    if not knobs:
        return "as the model"
    trained = ", trained on the nominal one" if settings.get("train_nominal") else ""
    return f"base displaced by up to {1000 * knobs['base_position_error']:g} mm{trained}"


def _hardware(runs: Sequence[Result]) -> str:
    if not runs:
        return "missing"
    minutes = [run.meta["wall_seconds"] / 60.0 for run in runs]
    places = {str(run.meta["training"].get("device", "cpu")) for run in runs}
    place = "1 CPU core" if places == {"cpu"} else " and ".join(sorted(places))
    return f"{place}, {sum(minutes) / len(minutes):.1f} min a run"
