"""Names of methods, ablations and tracks in tables and figures, and what each method knows.

Besides the observation a method may know masks, and have a memory: any dependence of an action on
what happened earlier in the episode, in the masks, the policy or the observation.
"""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from benchmarks.protocol.learners import LEARNERS, algorithm_of
from benchmarks.protocol.plan import PLANNERS
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
ALL_OR_NONE: Final = frozenset({"full", "none"})  # of the components: nothing single is removed
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
MAIN_TRACK: Final = "repaired"
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


def on_track(name: str, where: str) -> str:
    """A method's name with its track; the main track is left out."""
    return name if where in ("", MAIN_TRACK) else f"{name}, {track(where)}"


def of_suite(method: str) -> str:
    """A method or control of public tasks in words."""
    if method in SUITE_CONTROLS:
        return SUITE_CONTROLS[method]
    learner = algorithm_of(method)
    variant = method.removeprefix(learner)[1:].replace("_", " ")
    return f"{LEARNERS[learner].title}, {variant}" if variant else LEARNERS[learner].title


class Knowledge(NamedTuple):
    """Masks and memory of a row of a table, in words."""

    masks: str
    memory: str


def knowledge(method: str, track: Mapping[str, Any] | None) -> Knowledge:
    """What a method knows on a track.

    Args:
        method: of :data:`benchmarks.protocol.plan.METHODS`; any other is taken to plan.
        track: ``config["track"]`` of a run, where keys at their defaults may be missing, or
            ``config["entry"]`` of one on the leaderboard; None for planners that have no track.
    """
    if method in PLANNERS or track is None:
        return Knowledge("none", "its plan")
    if track.get("sha256") == "":  # a planner of one's own
        return Knowledge("safe" if track.get("mask_singularities") else "none", "its plan")
    brought = "algorithm" in track  # a model on the leaderboard, whatever it is called
    algorithm = track.get("algorithm", method)
    remembered = []
    masks = "none"
    if LEARNERS[algorithm].masks if algorithm in LEARNERS else not brought:
        masks = "safe" if track.get("mask_singularities") else "paper's"
        if visited := track.get("mask_visited"):
            remembered.append(f"{visited} configurations")
        if track.get("mask_refused"):
            remembered.append("refused moves")
    if (brought or method in LEARNERS) and track.get("observation") == "markov":
        remembered.append("filled holes and time")
    return Knowledge(masks, ", ".join(remembered) or "none")
