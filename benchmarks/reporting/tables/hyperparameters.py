"""The paper's table of hyperparameters beside each track's settings, from the runs' own records."""

from __future__ import annotations

from typing import Any

from benchmarks.protocol import labels, paper_values
from benchmarks.reporting.results import Results
from benchmarks.reporting.tables.table import Cell, Table


def hyperparameters(results: Results) -> Table:
    """Table "hparams": the paper's settings and each track's."""
    tracks = results.tracks()
    columns = [_track_settings(results, track) for track in tracks]
    rows: list[list[Cell]] = [
        [name, paper, *[column.get(name, "missing") for column in columns]]
        for name, paper in paper_values.HYPERPARAMETERS.items()
    ]
    ours = max(columns, key=len, default={})
    extra = [name for name in ours if name not in paper_values.HYPERPARAMETERS]
    rows += [[name, "not given", *[c.get(name, "missing") for c in columns]] for name in extra]
    header = ["Parameter", "Paper", *[f"Ours, {labels.track(t)}" for t in tracks]]
    return Table("hyperparameters", "Training hyperparameters", header, rows)


def _track_settings(results: Results, track: str) -> dict[str, str]:
    run = next((run for run in results.all() if run.config["cell"]["track"] == track), None)
    if run is None:
        return {}
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
    places = {str(run.meta["training"].get("device", "cpu")) for run in runs}
    place = "1 CPU core" if places == {"cpu"} else " and ".join(sorted(places))
    return f"{place}, {sum(minutes) / len(minutes):.1f} min a run"
