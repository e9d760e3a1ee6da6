"""The numbers the paper prints, table by table, to stand beside ours."""

from typing import Final

TRAINING_STEPS: Final = 1_500_000

# Table "results": metric key -> (initial, optimized) as printed
DESIGN: Final[dict[str, tuple[str, str]]] = {
    "workspace": ("0.82 ± 0.03", "1.16 ± 0.05"),
    "sigma_min": ("0.08 ± 0.01", "0.22 ± 0.02"),
    "tilt": ("32 ± 1", "40 ± 1"),
    "condition": ("38 ± 2", "12 ± 1"),
    "joint_range": ("[12, 78]", "[18.7, 68.3]"),
}

# Table "performance": metric key -> method -> value as printed
PERFORMANCE: Final[dict[str, dict[str, str]]] = {
    "success": {"rrt_connect": "55 ± 4", "dqn": "68 ± 5", "rainbow": "95 ± 2"},
    "time_first": {"rrt_connect": "12.4 ± 1.2", "dqn": "9.8 ± 0.9", "rainbow": "7.1 ± 0.5"},
    "alignment_error": {"rrt_connect": "1.8 ± 0.3", "dqn": "1.2 ± 0.2", "rainbow": "0.6 ± 0.1"},
    "collisions": {"rrt_connect": "0.5 ± 0.1", "dqn": "0.3 ± 0.1", "rainbow": "0.1 ± 0.05"},
    "energy": {"rrt_connect": "15.4 ± 1.1", "dqn": "13.2 ± 0.8", "rainbow": "12.3 ± 0.6"},
    "trajectory_error": {"rrt_connect": "4.2 ± 0.4", "dqn": "2.8 ± 0.3", "rainbow": "1.5 ± 0.2"},
}

# Table "ablation": ablation -> success rate as printed
ABLATION: Final[dict[str, str]] = {
    "full": "95 ± 2",
    "no_prioritized": "82 ± 3",
    "no_dueling": "85 ± 3",
    "no_n_steps": "88 ± 2",
    "no_noisy": "90 ± 2",
    "no_distributional": "87 ± 3",
    "no_double_q": "89 ± 2",
}

# Table "geo_ablation": metric key -> (initial, optimized) as printed
GEOMETRY_ABLATION: Final[dict[str, tuple[str, str]]] = {
    "steps_to_75": ("11.2 ± 1.1", "7.6 ± 0.8"),
    "success": ("82 ± 4", "95 ± 2"),
    "singular_per_1000": ("41 ± 7", "0"),
}

# Section "Robustness": observation noise -> Rainbow's success rate as printed
ROBUSTNESS: Final[dict[float, str]] = {0.0: "95 ± 2", 0.01: "88 ± 3"}
