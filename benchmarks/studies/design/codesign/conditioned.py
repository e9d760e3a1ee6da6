"""One policy for all designs: it sees the design, meets another in each episode, and scores them.

The policy is central Rainbow, one agent that moves both robots in the same tick. Its cell trains it
on random designs that can be assembled, then plays the candidates from the search's own starts.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from rich.console import Console
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from benchmarks.evaluation.evaluate import Policy, model_policy
from benchmarks.methods.episodes import env_arguments
from benchmarks.methods.learners import build_model
from benchmarks.protocol import plan
from benchmarks.protocol.presets import Preset, parse_preset
from benchmarks.protocol.seeding import derive, episode_seeds
from benchmarks.runs.callbacks import CurriculumCallback, CurveRecorder
from benchmarks.runs.cell import Teller
from benchmarks.runs.checkpoint import Watch, learn
from benchmarks.runs.experiment import Experiment, StopRequested
from benchmarks.runs.store import RunFolder, Store
from benchmarks.studies.design.codesign.spaces import (
    STREAM,
    STUDIES,
    TRACK,
    Machine,
    Unbuilt,
    begin,
    build,
    machine_of,
    summary,
)
from coop_env.env import Observation
from coop_env.geometry import RRSGeometry
from coop_env.team.joint_env import CoopInsertionJointEnv
from sb3_rainbow import Rainbow
from sb3_rainbow.learner.denormals import flush_denormals

POOL: Final = 1_000  # designs of the training
NAMES: Final = ("success", "ticks", "ticks_all")
CELL: Final = plan.Cell("rainbow", "full", "conditioned", TRACK, 0)


class DesignsEnv(gym.Env[Any, Any]):
    """The team's task, in each episode on another one of these machines, which is observed too.

    Args:
        machine: says what of a geometry is observed.
        geometries: to draw from.
        arguments: of :class:`~coop_env.team.joint_env.CoopInsertionJointEnv`.
    """

    def __init__(
        self, machine: Machine, geometries: Sequence[RRSGeometry], **arguments: Any
    ) -> None:
        self.machine, self.geometries, self.arguments = machine, geometries, arguments
        self.stage = int(arguments.pop("stage", 1))
        self._take(geometries[0])
        size = len(self._features) + int(np.prod(self.env.observation_space.shape))
        self.observation_space = spaces.Box(0.0, 1.0, (size,), np.float32)
        self.action_space = self.env.action_space

    def _take(self, geometry: RRSGeometry) -> None:
        self.env = CoopInsertionJointEnv(geometry=geometry, stage=self.stage, **self.arguments)
        self._features = self.machine.features(geometry)

    def set_stage(self, stage: int) -> None:
        """Choose the active holes from the next reset on."""
        self.stage = stage

    def action_masks(self) -> np.ndarray:
        """(49,), as the machine's own environment gives them."""
        return self.env.action_masks()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Draw a machine and start an episode on it."""
        super().reset(seed=seed)
        while True:
            self._take(self.geometries[int(self.np_random.integers(len(self.geometries)))])
            try:
                row = begin(self.env, int(self.np_random.integers(2**31)))
            except Unbuilt:  # has few start states, and found none this time
                continue
            return self._seen(row), {}

    def step(self, action: int) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move both robots in one tick."""
        row, reward, terminated, truncated, info = self.env.step(action)
        return self._seen(row), reward, terminated, truncated, info

    def _seen(self, row: Observation) -> Observation:
        return np.concatenate([row, self._features])


class _Designs(DummyVecEnv):
    """Of a checkpoint the episodes under way are not kept: new ones begin."""

    def get_state(self) -> None:
        return None

    def set_state(self, state: Any) -> None:
        raise NotImplementedError  # None is no state


def pool(machine: Machine, size: int, seed: int) -> list[RRSGeometry]:
    """Random designs that can be assembled, of all studies in turn."""
    rng = np.random.default_rng(derive("fresh", 16, seed))
    found: list[RRSGeometry] = []
    while len(found) < size:
        study = list(STUDIES)[len(found) % len(STUDIES)]
        try:
            found.append(build(machine, machine.draw(study, rng)))
        except Unbuilt:
            continue
    return found


def play(
    policy: Policy, machine: Machine, geometry: RRSGeometry, seeds: Sequence[int],
    arguments: dict[str, Any],
) -> list[float]:  # fmt: skip
    """Ticks to the first insertion from each start, NaN without one; all are played side by side.

    Raises:
        Unbuilt: a start found no pose.
    """
    envs = [CoopInsertionJointEnv(geometry=geometry, **arguments) for _ in seeds]
    rows = np.stack([begin(env, seed) for env, seed in zip(envs, seeds, strict=True)])
    features = np.tile(machine.features(geometry), (len(envs), 1))
    lengths, running, tick = np.full(len(envs), math.nan), np.arange(len(envs)), 0
    while len(running):
        tick += 1
        masks = np.stack([envs[i].action_masks() for i in running])
        actions = policy(np.concatenate([rows[running], features[running]], axis=1), masks)
        over = np.zeros(len(running), bool)
        for k, (i, action) in enumerate(zip(running, actions, strict=True)):
            rows[i], _, terminated, truncated, info = envs[i].step(int(action))
            if info["inserted"]:
                lengths[i] = tick
            over[k] = terminated or truncated or info["inserted"]
        running = running[~over]
    return [float(length) for length in lengths]


@dataclass(frozen=True)
class Policies:
    """The one cell of the experiment."""

    id: str = "conditioned"


class Conditioned(Experiment[Policies]):
    """The policy for all designs, by what config.yaml and candidates.csv of a folder say."""

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        super().__init__("conditioned", folder=str(self.folder.resolve()))
        self.asked = RunFolder(self.folder).config()
        self.machine = machine_of(self.asked["geometry"], self.asked["bounds"])
        steps = {"timesteps": self.asked["steps"]}
        self.preset: Preset = parse_preset(
            {
                "description": "", "seeds": [CELL.seed], "evaluation": {"episodes": 1},
                "runs": [], "tracks": {TRACK: steps},
            },
            "conditioned", "codesign",
        )  # fmt: skip
        self.track = self.preset.tracks[TRACK]
        given = env_arguments(self.preset, CELL, self.track)
        self.arguments = {name: value for name, value in given.items() if name != "geometry"}

    def cells(self) -> Sequence[Policies]:
        return [Policies()]

    def settings(self, cell: Policies) -> dict[str, Any]:
        names = ("geometry", "bounds", "starts")
        own = {name: self.asked[name] for name in names} | {"pool": POOL}
        return {"cell": asdict(CELL), "track": plan.settings(self.preset, CELL)["track"], **own}

    def units(self, config: dict[str, Any]) -> int:
        return int(self.track.timesteps)

    def checkpoint_bytes(self, cell: Policies) -> int:
        return plan.checkpoint_bytes(self.track)

    def run(
        self, cell: Policies, folder: RunFolder, stop_requested: StopRequested, device: str
    ) -> dict[str, Any] | None:
        trained = self._train(folder, stop_requested, device)
        if trained is None:
            return None
        model, training = trained
        began = time.perf_counter()
        policy, tell = model_policy(model), Teller(folder, stop_requested)
        seeds = episode_seeds(0, self.asked["starts"], STREAM)
        rows = []
        candidates = RunFolder(self.folder).rows("candidates")
        for number, row in enumerate(candidates.to_dict("records")):
            tell(0.999, f"playing design {number} of {len(candidates)}")
            lengths = play(policy, self.machine, self.machine.of(row), seeds, self.arguments)
            found = dict(zip(NAMES, summary(lengths, self.machine.most), strict=True))
            rows.append({"design": row["design"], **found})
        folder.write_rows("designs", rows)
        return {"training": {**training, "test_seconds": time.perf_counter() - began}}

    def _train(
        self, folder: RunFolder, stop_requested: StopRequested, device: str
    ) -> tuple[Rainbow, dict[str, Any]] | None:
        geometries = pool(self.machine, POOL, CELL.seed)
        stage = 0 if self.track.curriculum.enabled else 1
        envs = _Designs(
            [lambda: DesignsEnv(self.machine, geometries, stage=stage, **self.arguments)]
            * self.track.hyperparameters.n_envs
        )
        envs.seed(derive("train", CELL.seed))
        env = VecMonitor(envs)
        curriculum = CurriculumCallback(self.track.curriculum)
        curve = CurveRecorder(self.track, curriculum)
        kept: dict[str, Any] = {"env": envs, "curriculum": curriculum, "curve": curve}

        def note() -> str:
            return f"success {np.mean(curve.recent):.0%}" if curve.recent else "warming up"

        seconds = self.preset.checkpoint_seconds
        watch = Watch(folder, kept, seconds, self.track.timesteps, stop_requested, note)
        logger = configure(str(folder.tensorboard), ["tensorboard"])
        with flush_denormals():
            model = learn(
                watch, Rainbow, env, lambda: self._build(env, device), [curriculum, curve],
                logger, device,
            )  # fmt: skip
        if model is None:
            return None
        curve.flush()
        folder.write_rows("curve", curve.rows)
        return model, {**curve.summary(), **watch.summary(model)}

    def _build(self, env: VecMonitor, device: str) -> Rainbow:
        model = build_model(self.preset, CELL, env, device)
        assert isinstance(model, Rainbow)
        return model

    def write_tables(self, store: Store, console: Console) -> None:
        """The co-design's own tables hold what this one found."""
