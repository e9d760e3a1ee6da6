"""Presets: YAML files with strict keys that say what is trained, for how long and how often.

Those with ``tracks`` are of the insertion task, those with ``tasks`` of public ones.
``presets/_tracks.yaml`` and ``presets/_tasks.yaml`` hold both in full; a preset names those it uses
and overrides what it must, usually only ``timesteps``. ``base`` names the library's entry to
change; without it, the entry of the same name.
"""

import re
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import yaml
from pydantic import AfterValidator, Field

from benchmarks.errors import BenchmarkError, known
from benchmarks.protocol.learners import LEARNERS, algorithm_of
from benchmarks.protocol.strict import Strict, build, merge
from coop_env.geometry import RRSGeometry
from coop_env.simulation.insertion_task import InsertionTask
from coop_env.simulation.sim_to_real import SimToReal
from coop_env.simulation.task import TRAIL

PRESETS = Path(__file__).parent / "presets"
DEFAULT_PRESET = "quick"
# libyaml's where it is there: `verify` reads thousands of settings
SAFE_LOADER: Final = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _OnceLoader(SAFE_LOADER):  # type: ignore[misc, valid-type]
    """Refuses a key that is given twice, of which YAML takes the last."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        keys = [key.value for key, _ in node.value if isinstance(key.value, str)]
        if twice := sorted({key for key in keys if keys.count(key) > 1} - {"<<"}):
            raise yaml.YAMLError(f"key '{twice[0]}' is given twice")
        return super().construct_mapping(node, deep)


# YAML 1.1 reads 1e-4 as text, and a scientist means a number
_EXPONENT: Final = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$")
_OnceLoader.add_implicit_resolver("tag:yaml.org,2002:float", _EXPONENT, list("-+.0123456789"))

CONTACT: Final = "coop_env:CoopInsertionContact-v0"
#: what plays public tasks without learning
SUITE_CONTROLS: Final = {"random": "Random", "held": "One action", "script": "Script"}


def _differ(values: list[Any]) -> list[Any]:
    if not values or len(set(values)) != len(values):
        raise ValueError("needs one value or more, no two equal")
    return values


Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0.0)]
AtLeast0 = Annotated[Number, Field(ge=0.0)]
Share = Annotated[Number, Field(ge=0.0, le=1.0)]
Arguments = dict[str, Any]  # of a constructor
Count = Annotated[int, Field(gt=0)]
Names = Annotated[list[str], AfterValidator(_differ)]
Seeds = Annotated[list[Annotated[int, Field(ge=0)]], AfterValidator(_differ)]


def _levels(noise: list[float]) -> list[float]:
    if 0.0 not in noise:
        raise ValueError("must hold 0.0")
    return _differ(noise)


def _arguments_of(kind: type[Any]) -> AfterValidator:
    """A check that ``kind`` accepts the arguments; an error with its message if it does not."""

    def check(given: dict[str, Any] | None) -> dict[str, Any] | None:
        try:
            kind(**(given or {}))
        except TypeError as error:
            raise ValueError(str(error)) from error
        return given

    return AfterValidator(check)


def _machine(knobs: dict[str, Any] | None) -> dict[str, Any] | None:
    if knobs is not None and not knobs.get("base_position_error"):
        raise ValueError("must have a base_position_error: test errors are in proportion to it")
    return knobs


def _learners(methods: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    if unknown := methods.keys() - LEARNERS.keys():
        raise ValueError(f"unknown method '{min(unknown)}'; known: {known(LEARNERS)}")
    return methods


@dataclass(frozen=True)
class Hyperparameters(Strict):
    """The learner's settings: the paper's table of hyperparameters, and what it leaves out."""

    learning_rate: Positive
    learning_rate_end: AtLeast0  # linear decay over the run
    gamma: Share
    v_min: Number | None  # without both the head has quantiles
    v_max: Number | None
    batch_size: Count
    tau: Share
    sigma0: AtLeast0
    updates_per_step: Positive  # gradient steps per environment step
    n_steps: Count = 3
    n_atoms: Count = 51
    weight_decay: AtLeast0 = 1e-5
    max_grad_norm: Positive = 5.0
    buffer_size: Count = 1_000_000
    learning_starts: Annotated[int, Field(ge=0)] = 1_000
    alpha: AtLeast0 = 0.6
    beta_start: Share = 0.4
    beta_end: Share = 1.0
    net_arch: list[Count] = field(default_factory=lambda: [256, 128, 64])
    n_envs: Count = 16
    # epsilon-greedy, for vanilla DQN and for Rainbow without noisy layers
    epsilon_start: Share = 1.0
    epsilon_end: Share = 0.05
    epsilon_steps: Count = 10_000

    @property
    def gradient_steps(self) -> int:
        """Updates after each step of all ``n_envs`` environments."""
        return max(1, round(self.updates_per_step * self.n_envs))


@dataclass(frozen=True)
class PPOSettings(Strict):
    """sb3-contrib's MaskablePPO, a further reference; gamma, net and envs are the track's."""

    learning_rate: Positive = 1.0e-3
    learning_rate_end: AtLeast0 = 1.0e-5  # linear decay over the run
    n_steps: Count = 128
    batch_size: Count = 256
    n_epochs: Count = 10
    gae_lambda: Share = 0.95
    ent_coef: AtLeast0 = 0.01
    clip_range: Positive = 0.2


@dataclass(frozen=True)
class Controls(Strict):
    """Weight of the angle, per rad, in the scripts' potentials where a metre weighs 500."""

    greedy_angle: Number = 150.0
    lookahead_angle: Number = 150.0
    greedy_observed_angle: Number = 150.0
    lookahead_observed_angle: Number = 150.0


@dataclass(frozen=True)
class Curriculum(Strict):
    """Stage 0 has the four peripheral holes, stage 1 all six."""

    enabled: bool = True
    threshold: Annotated[Number, Field(le=1.0)] = 0.75  # below 0: after the first episodes
    window: Count = 20


@dataclass(frozen=True)
class Track(Strict):
    """A reward, the settings of the task and the hyperparameters that go together.

    With ``team`` both robots move at once: commanded by one agent (central), by two whose values
    are learned as a sum (vdn), or by two of which each transition is a row of its own (shared: one
    network, independent: one for each).
    """

    description: str
    reward: Literal["paper", "progress"]
    timesteps: Count
    hyperparameters: Hyperparameters
    reward_kwargs: dict[str, Number] = field(default_factory=dict)
    observation: str = "paper"
    mask_singularities: bool = False  # these four as CoopInsertionEnv's
    mask_visited: Annotated[int, Field(ge=0, le=TRAIL)] = 0
    mask_refused: bool = False
    collision: Literal["refuse", "terminate"] = "refuse"
    sim_to_real: Annotated[
        dict[str, Any] | None, _arguments_of(SimToReal), AfterValidator(_machine)
    ] = None
    train_nominal: bool = False  # sim_to_real in tests alone
    task: Annotated[dict[str, Any] | None, _arguments_of(InsertionTask)] = None
    shield: dict[str, Number] | None = None  # fields of ShieldMargin: masks keep these margins
    team: Literal["central", "vdn", "shared", "independent"] | None = None
    sight: bool = False  # of the other robot
    curriculum: Curriculum = field(default_factory=Curriculum)
    ppo: PPOSettings = field(default_factory=PPOSettings)
    controls: Controls = field(default_factory=Controls)
    methods: Annotated[dict[str, Arguments], AfterValidator(_learners)] = field(
        default_factory=dict
    )

    @property
    def rows(self) -> int:
        return rows_of(self.team)


@dataclass(frozen=True)
class Evaluation(Strict):
    """The test protocol: ``episodes`` per seed, at each level of observation noise.

    On tracks with ``sim_to_real``, which has a noise of its own, at each of ``errors`` instead:
    bounds of the base's displacement, mm; its tilt is in proportion. ``stream`` says which starts
    (:mod:`benchmarks.protocol.seeding`): ``final`` is for the preset ``paper`` alone. With
    ``exploring`` learners also act as they were trained, and scripts with 5 % of random moves.
    """

    episodes: Count
    noise: Annotated[list[Share], AfterValidator(_levels)] = field(
        default_factory=lambda: [0.0, 0.01]
    )
    errors: Annotated[list[AtLeast0], AfterValidator(_differ)] = field(
        default_factory=lambda: [0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0]
    )
    stream: Literal["final", "test", "validate"] = "validate"
    exploring: bool = False


@dataclass(frozen=True)
class PlannerSettings(Strict):
    """Limits of one planning call (the paper: 5 s)."""

    time_limit: Positive = 5.0
    max_iterations: Count = 20_000
    node_limit: Count = 2_000_000


@dataclass(frozen=True)
class DesignSettings(Strict):
    """The geometric optimization: independent Nelder-Mead runs, each with its own jitter."""

    runs: Count = 10


@dataclass(frozen=True)
class RunGroup(Strict):
    """A product of methods, ablations, geometries, tracks and seeds."""

    methods: list[str]
    ablations: list[str] = field(default_factory=lambda: ["full"])
    geometries: list[str] = field(default_factory=lambda: ["optimized"])
    tracks: list[str] = field(default_factory=list)
    seeds: Seeds | None = None  # instead of the preset's


@dataclass(frozen=True)
class Preset(Strict):
    """One experiment: what runs, with which settings."""

    name: str
    description: str
    seeds: Seeds
    evaluation: Evaluation
    runs: list[RunGroup]
    tracks: dict[str, Track] = field(default_factory=dict)
    geometries: dict[str, Annotated[dict[str, Number], _arguments_of(RRSGeometry)]] = field(
        default_factory=dict
    )
    planner: PlannerSettings = field(default_factory=PlannerSettings)
    design: DesignSettings | None = None
    checkpoint_seconds: AtLeast0 = 60.0


@dataclass(frozen=True)
class Guide(Strict):
    """In the contact task off-policy learners begin with a script's steps and noise on them."""

    steps: Count
    noise: Number  # standard deviation, of a whole increment
    gains: dict[str, Number] = field(default_factory=dict)  # of the moment-guided search


@dataclass(frozen=True)
class Task(Strict):
    """A public environment, the protocol of its runs, and each method's settings there."""

    title: str
    env: str
    timesteps: Count
    eval_every: Count  # environment steps between two evaluations
    eval_episodes: Count
    methods: dict[str, Arguments]  # constructor arguments, and changes of the guide
    arguments: Arguments = field(default_factory=dict)  # of every method
    skip: Names = field(default_factory=list)  # methods of the preset that do not apply here
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    policy: str = "MlpPolicy"
    n_envs: Count = 1
    goal: Number | None = None  # the mean return at which the task counts as solved
    seeds: Seeds | None = None  # instead of the preset's
    published: dict[str, Number] = field(default_factory=dict)  # published means, by source
    guide: Guide | None = None
    bare: bool = False  # Rainbow's present defaults fill in what the settings leave out

    def arguments_of(self, method: str) -> dict[str, Any]:
        """A method's constructor arguments."""
        return {**self.arguments, **self.methods[method]}


@dataclass(frozen=True)
class SuitePreset(Strict):
    """Methods and controls on public tasks: what runs, with which settings."""

    name: str
    description: str
    seeds: Seeds
    final_episodes: Count
    tasks: dict[str, Task]
    methods: Names = field(default_factory=lambda: ["rainbow", "dqn", "qrdqn"])
    controls: Names = field(default_factory=list)  # a script only where a task has one
    method_seeds: dict[str, Seeds] = field(default_factory=dict)  # instead of those above
    checkpoint_seconds: AtLeast0 = 60.0
    search: bool = False  # compares settings of an algorithm rather than algorithms

    def __post_init__(self) -> None:
        if self.search and self.controls:
            raise ValueError("controls: a search compares settings, it has none")
        if unknown := {*self.controls} - SUITE_CONTROLS.keys():
            raise ValueError(f"controls: unknown '{min(unknown)}'; known: {known(SUITE_CONTROLS)}")
        if unknown := self.method_seeds.keys() - {*self.methods, *self.controls}:
            raise ValueError(f"method_seeds: '{min(unknown)}' is not among methods and controls")
        for method, (key, task) in product(self.methods, self.tasks.items()):
            algorithm_of(method)
            if method not in {*task.methods, *task.skip}:
                raise ValueError(f"tasks: {key}: methods has no settings for '{method}'")


def rows_of(team: str | None) -> int:
    """Transitions that one tick of a team makes: one, or one of each agent."""
    return 2 if team in ("shared", "independent") else 1


def preset_names() -> list[str]:
    """The presets that come with the package."""
    return sorted(p.stem for p in PRESETS.glob("*.yaml") if not p.stem.startswith("_"))


def own_file(name: str) -> Path | None:
    """The file that a preset's name points to; None for a preset of the package."""
    return Path(name) if name.endswith((".yaml", ".yml")) else None


def load(name: str) -> Preset | SuitePreset:
    """A preset by name, or by the path of a ``.yaml`` file; BenchmarkError if it is not valid."""
    own = own_file(name)
    path = own or PRESETS / f"{name}.yaml"
    if own and own.stem in preset_names() and own.resolve().parent != PRESETS.resolve():
        raise BenchmarkError(
            f"preset '{name}': the package has a preset '{own.stem}', whose results it would join: "
            "rename the file"
        )
    if own and not own.is_file():
        raise BenchmarkError(f"preset '{name}': there is no such file")
    if not path.is_file() or (path.parent == PRESETS and path.stem not in preset_names()):
        raise BenchmarkError(
            f"unknown preset '{name}'; known presets: {known(preset_names())} "
            "(or the path of a .yaml file)"
        )
    return parse(read_yaml(path), path.stem, path.name)


def load_preset(name: str) -> Preset:
    """:func:`load` a preset of the insertion task."""
    preset = load(name)
    if not isinstance(preset, Preset):
        raise BenchmarkError(f"preset '{name}' is of public tasks: name one of the insertion task")
    return preset


def load_suite(name: str) -> SuitePreset:
    """:func:`load` a preset of public tasks."""
    preset = load(name)
    if not isinstance(preset, SuitePreset):
        raise BenchmarkError(f"preset '{name}' is of the insertion task: name one of public tasks")
    return preset


def parse(data: dict[str, Any], name: str, where: str) -> Preset | SuitePreset:
    """Check and build a preset from what its file holds; ``where`` is named in errors.

    Its tracks or tasks are laid over what the library has of their names or bases.
    """
    if "name" in data:
        raise BenchmarkError(f"{where}: unknown key 'name'; the file's name is the preset's name")
    kind = "tasks" if "tasks" in data else "tracks"
    library = read_yaml(PRESETS / f"_{kind}.yaml")
    entries = {}
    for key, given in _mapping(data.get(kind), f"{where}: {kind}").items():
        own = _mapping(given, f"{where}: {kind}: {key}")
        base = own.pop("base", key)
        if base not in [*library] and (base != key or not own):  # a list, too
            raise BenchmarkError(
                f"{where}: {kind}: {key}: unknown base '{base}'; known: {known(library)}"
            )
        entries[key] = merge(_from_library(library, base), own)
    cls: type[Preset | SuitePreset] = SuitePreset if kind == "tasks" else Preset
    return build(cls, {**data, "name": name, kind: entries}, where)


def _mapping(value: object, where: str) -> dict[str, Any]:
    """A copy of a mapping that YAML holds; nothing is an empty one."""
    if value is not None and not isinstance(value, dict):
        raise BenchmarkError(f"{where}: expected a mapping, found {value!r}")
    return dict(value or {})


def _from_library(library: dict[str, Any], name: str) -> dict[str, Any]:
    """An entry of the library, laid over its own base; empty if there is none."""
    own = dict(library.get(name, {}))
    base = own.pop("base", None)
    return merge(_from_library(library, base), own) if base else own


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file, without its ``x-...`` keys, which only hold anchors."""
    try:
        data = yaml.load(path.read_text(encoding="utf-8"), _OnceLoader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise BenchmarkError(f"{path.name}: not valid YAML: {reason}") from error
    if not isinstance(data, dict):
        raise BenchmarkError(f"{path.name}: expected a mapping at the top")
    return {key: value for key, value in data.items() if not str(key).startswith("x-")}
