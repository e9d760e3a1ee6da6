"""How methods, ablations and tracks are called in tables and figures."""

from __future__ import annotations

from typing import Final

from benchmarks.protocol.learners import LEARNERS, algorithm_of
from benchmarks.protocol.presets import SUITE_CONTROLS

METHODS: Final = {
    **{name: learner.title for name, learner in LEARNERS.items() if learner.discrete},
    "rainbow": "Rainbow DQN",
    "dqn": "Vanilla DQN",
    "random": "Random",
    "greedy": "Greedy",
    "lookahead": "Two-move lookahead",
    "greedy_observed": "Greedy, from the observation",
    "lookahead_observed": "Two-move lookahead, from the observation",
    "rrt_connect": "RRT-Connect",
    "rrt_lattice": "RRT-Connect + lattice insertion",
    "optimum": "Exact optimum",
    "optimum_at_once": "Exact optimum, both at once",
    "nominal_plan": "Nominal plan, replanned",
    "plan_search": "Nominal plan, then search",
}
MASKED_DQN: Final = "Masked DQN"
ABLATIONS: Final = {
    "full": "Full Rainbow",
    "no_prioritized": "- Prioritized replay",
    "no_dueling": "- Dueling head",
    "no_n_steps": "- Multi-step returns",
    "no_noisy": "- NoisyNets",
    "no_distributional": "- Distributional head",
    "no_double_q": "- Double Q-learning",
    "double_dueling": "Double Q and dueling alone",
    "none": "All six off (masked DQN)",
}
TRACKS: Final = {
    "printed": "as printed",
    "repaired": "repaired",
    "terminal": "terminal",
    "reward": "reward",
    "safe": "safe",
    "memory": "memory",
    "uncertain": "uncertain",
    "uncertain_nominal": "uncertain, trained nominal",
    "in_turn": "in turn",
    "central": "central",
    "vdn": "VDN",
    "vdn_sight": "VDN in sight",
    "shared": "shared",
    "shared_sight": "shared in sight",
    "independent": "independent",
    "independent_sight": "independent in sight",
}
DESIGN_METRICS: Final = {
    "workspace": "Orientation workspace (rad²)",
    "sigma_min": "Min sigma_min",
    "tilt": "Max roll/pitch (°)",
    "condition": "Condition number variation (%)",
    "joint_range": "Joint angle range (°)",
}


def track(name: str) -> str:
    """A track in words; a track of one's own goes by its name."""
    return TRACKS.get(name, name)


def of_suite(method: str) -> str:
    """A method or control of public tasks in words."""
    if method in SUITE_CONTROLS:
        return SUITE_CONTROLS[method]
    learner = algorithm_of(method)
    variant = method.removeprefix(learner)[1:].replace("_", " ")
    return f"{LEARNERS[learner].title}, {variant}" if variant else LEARNERS[learner].title
