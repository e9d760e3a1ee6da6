"""Trained models as repositories of the Hugging Face hub: package, upload, download, load."""

import datetime
import io
import json
import os
import pathlib
import shutil
import tempfile
from collections.abc import Collection
from importlib import metadata
from typing import Any

import numpy as np
from huggingface_hub import EvalResult, HfApi, ModelCard, ModelCardData, hf_hub_download
from huggingface_sb3 import EnvironmentName, ModelName
from sb3_contrib.common.maskable.evaluation import evaluate_policy
from sb3_contrib.common.maskable.utils import get_action_masks
from stable_baselines3.common.utils import get_system_info
from stable_baselines3.common.vec_env import (
    VecEnv,
    VecNormalize,
    VecVideoRecorder,
    unwrap_vec_normalize,
)

from sb3_rainbow.rainbow import Rainbow
from sb3_rainbow.zoo.files import ALGO, loading
from sb3_rainbow.zoo.playing import masks_apply
from sb3_rainbow.zoo.unpickling import check_model, unpickle

# huggingface_sb3's name for it
VEC_NORMALIZE = "vec_normalize.pkl"
# What a run needs to go on, and nobody else. The generators' states are tensors, which outside of
# torch's own files only an unrestricted pickle can hold.
_OF_THE_RUN = (
    *("_rng_state", "_last_obs", "_last_original_obs", "_last_episode_starts"),
    *("_last_action_masks", "ep_info_buffer", "ep_success_buffer", "tensorboard_log"),
)
_CARD = """\
# **Rainbow** playing **{env_id}**

Rainbow DQN on [Stable-Baselines3](https://github.com/DLR-RM/stable-baselines3), by `sb3_rainbow`
{sb3_rainbow}.

## Results

| environment | episodes | mean return | standard deviation | actions | masks |
|---|---|---|---|---|---|
| {env_id} | {episodes} | {mean:.2f} | {std:.2f} | {actions} | {masks} |

{about}

## Use

```python
from sb3_rainbow.zoo.hub import load_from_hub

model = load_from_hub("<organization>/{name}", "{name}.zip")
```

It refuses a file that names code other than Stable-Baselines3's and Rainbow's own;
`Rainbow.load` runs whatever a file names.

## How it was trained

```
{command}
```

## Versions

| | |
|---|---|
{versions}
"""


def package(
    model: Rainbow,
    env_id: str,
    folder: str | os.PathLike[str],
    *,
    eval_env: VecEnv,
    command: str,
    n_eval_episodes: int = 10,
    deterministic: bool = True,
    about: str = "",
) -> pathlib.Path:
    """Evaluate a model and write what its repository holds, named as ``huggingface_sb3`` names it.

    ``rainbow-<env_id>.zip`` is the model without what only its training needs, ``README.md`` the
    model card with command, results and versions, ``results.json`` the results, and
    ``vec_normalize.pkl`` the statistics, if there are any.

    Args:
        model: trained.
        env_id: the environment's id.
        folder: to write to; made if missing.
        eval_env: for the evaluation; the model acts under its masks where it learned under some,
            and a ``VecNormalize`` around it stays in evaluation.
        command: that trained the model.
        n_eval_episodes: episodes of the evaluation.
        deterministic: evaluate the greedy policy.
        about: Markdown, for the card, below the results.

    Returns:
        the model's file.
    """
    out = pathlib.Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    name = ModelName(ALGO, EnvironmentName(env_id))
    path = out / name.filename
    model.save(path, exclude=_OF_THE_RUN)
    normalizer = unwrap_vec_normalize(eval_env)
    if normalizer is not None:
        normalizer.save(str(out / VEC_NORMALIZE))
        normalizer.training = normalizer.norm_reward = False
    masked = masks_apply(model, eval_env)
    returns, _ = evaluate_policy(
        model,  # type: ignore[arg-type]
        eval_env,
        n_eval_episodes,
        deterministic,
        return_episode_rewards=True,
        use_masking=masked,
    )
    mean, std = float(np.mean(returns)), float(np.std(returns))
    results = {
        "mean_reward": mean,
        "std_reward": std,
        "is_deterministic": deterministic,
        "n_eval_episodes": n_eval_episodes,
        "eval_datetime": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    (out / "results.json").write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    versions = _versions()
    text = _CARD.format(
        name=name,
        env_id=env_id,
        episodes=n_eval_episodes,
        mean=mean,
        std=std,
        actions="greedy" if deterministic else "exploring",
        masks="yes" if masked else "none",
        about=about,
        command=command,
        sb3_rainbow=versions["sb3_rainbow"],
        versions="\n".join(f"| {key} | {value} |" for key, value in versions.items()),
    )
    card = ModelCard(f"---\n{_card_data(env_id, mean, std).to_yaml()}\n---\n\n{text}")
    card.save(out / "README.md")
    return path


def record(model: Rainbow, env: VecEnv, folder: str | os.PathLike[str], n_steps: int) -> None:
    """Write ``replay.mp4``, which the hub shows on a model's page.

    Args:
        model: trained.
        env: made with ``render_mode="rgb_array"``; closed afterwards.
        folder: to write to.
        n_steps: length of the video.
    """
    masked = masks_apply(model, env)
    with tempfile.TemporaryDirectory() as temporary:
        recorder = VecVideoRecorder(env, temporary, lambda step: step == 0, n_steps, "replay")
        obs = recorder.reset()
        for _ in range(n_steps):
            masks = get_action_masks(recorder) if masked else None
            actions, _ = model.predict(obs, deterministic=True, action_masks=masks)  # type: ignore[arg-type]
            obs, *_ = recorder.step(actions)
        recorder.close()
        (video,) = pathlib.Path(temporary).glob("*.mp4")
        shutil.move(video, pathlib.Path(folder) / "replay.mp4")


def push(
    folder: str | os.PathLike[str], repo_id: str, commit_message: str, token: str | None = None
) -> str:
    """Upload what :func:`package` wrote.

    Args:
        folder: written by :func:`package`.
        repo_id: organization/name; made if missing.
        commit_message: of the repository's commit.
        token: of the hub; None for the one that is logged in.

    Returns:
        address of the repository.
    """
    api = HfApi(token=token)
    url = api.create_repo(repo_id=repo_id, exist_ok=True)
    api.upload_folder(
        repo_id=repo_id, folder_path=pathlib.Path(folder), commit_message=commit_message
    )
    return str(url)


def load_from_hub(
    repo_id: str, filename: str, trusted: Collection[str] = (), **kwargs: Any
) -> Rainbow:
    """A model of the hub.

    ``huggingface_sb3.load_from_hub`` downloads only where ``TRUST_REMOTE_CODE`` is set, as what is
    loaded afterwards may run anything. :func:`load` does not, so nobody need trust anybody.

    Args:
        repo_id: organization/name.
        filename: of the model in it, such as ``rainbow-CartPole-v1.zip``.
        trusted: see :func:`load`.
        kwargs: of ``Rainbow.load``.

    Returns:
        the model.

    Raises:
        ZooError: if it is none of Rainbow, or names code that it may not.
    """
    return load(hf_hub_download(repo_id, filename), trusted, **kwargs)


def load(path: str | os.PathLike[str], trusted: Collection[str] = (), **kwargs: Any) -> Rainbow:
    """A model from a file of whom you know nothing.

    As ``Rainbow.load``, but the file may name only what ``sb3_rainbow.zoo.unpickling`` lists.
    What only the run would go on with, such as the states of its random generators, is left out.

    Args:
        path: of the model.
        trusted: more classes and functions that it may name, such as ``"my_package.layers.Swish"``:
            they are imported, and may be called with anything.
        kwargs: of ``Rainbow.load``.

    Returns:
        the model.

    Raises:
        ZooError: if it is none of Rainbow, or names code that it may not.
    """
    with loading(path):
        # What is checked is what is loaded, whatever happens to the file in between.
        content = pathlib.Path(path).read_bytes()
        left_out = {**dict.fromkeys(_OF_THE_RUN), **(kwargs.pop("custom_objects", None) or {})}
        check_model(io.BytesIO(content), trusted, left_out)
        return Rainbow.load(io.BytesIO(content), custom_objects=left_out, **kwargs)


def load_vec_normalize(
    path: str | os.PathLike[str], venv: VecEnv, trusted: Collection[str] = ()
) -> VecNormalize:
    """As ``VecNormalize.load``, from a file of whom you know nothing, for evaluation.

    Args:
        path: of the statistics.
        venv: to normalize.
        trusted: see :func:`load`.

    Raises:
        ZooError: if the file names code that it may not.
    """
    with loading(path):
        normalizer: VecNormalize = unpickle(pathlib.Path(path).read_bytes(), trusted)
        normalizer.set_venv(venv)
        normalizer.training = normalizer.norm_reward = False
        return normalizer


def _versions() -> dict[str, str]:
    info = get_system_info(print_info=False)[0]
    own = {"sb3_rainbow": metadata.version("sb3-rainbow-coop")}
    wanted = ("Stable-Baselines3", "Gymnasium", "PyTorch", "Numpy", "Python")
    return {**own, **{name: info[name] for name in wanted if name in info}}


def _card_data(env_id: str, mean: float, std: float) -> ModelCardData:
    """What the hub's search, and the zoo's list of trained agents, read."""
    return ModelCardData(
        library_name="stable-baselines3",
        tags=[env_id, "deep-reinforcement-learning", "reinforcement-learning", "stable-baselines3"],
        model_name="Rainbow",
        eval_results=[
            EvalResult(
                task_type="reinforcement-learning",
                task_name="reinforcement-learning",
                dataset_type=env_id,
                dataset_name=env_id,
                metric_type="mean_reward",
                metric_name="mean_reward",
                metric_value=f"{mean:.2f} +/- {std:.2f}",
            )
        ],
    )
