"""Trained models as repositories of the Hugging Face hub: package, download, load."""

import datetime
import json
import os
import pathlib
from importlib import metadata
from typing import Any

import numpy as np
from huggingface_hub import EvalResult, ModelCard, ModelCardData, hf_hub_download
from sb3_contrib.common.maskable.evaluation import evaluate_policy
from stable_baselines3.common.utils import get_system_info
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_rainbow.masking.masked_off_policy import masks_apply
from sb3_rainbow.rainbow import Rainbow
from sb3_rainbow.zoo.files import ALGO, VEC_NORMALIZE, ZooError, is_model_file, loading
from sb3_rainbow.zoo.model_file import read_model, read_statistics, write_model, write_statistics

_CARD = """\
# **Rainbow** playing **{env_id}**

Rainbow DQN on [Stable-Baselines3](https://github.com/DLR-RM/stable-baselines3), by `sb3_rainbow`
{sb3_rainbow}.

## Results

| environment | episodes | mean return | standard deviation | actions | masks |
|---|---|---|---|---|---|
| {env_id} | {n_eval_episodes} | {mean_reward:.2f} | {std_reward:.2f} | {actions} | {masks} |

## Use

```python
from sb3_rainbow.zoo.hub import load_from_hub

model = load_from_hub("<organization>/{name}", "{name}.zip")
```
{statistics}
Nothing of the file is run: it holds numbers, text and arrays.

## How it was trained

```
{command}
```

## Versions

| | |
|---|---|
{versions}
"""


_STATISTICS = """
It acts on normalized observations: wrap the environment by the repository's statistics.

```python
from huggingface_hub import hf_hub_download
from sb3_rainbow.zoo.hub import load_vec_normalize

path = hf_hub_download("<organization>/{name}", "vec_normalize.zip")
env = load_vec_normalize(path, env)  # a VecEnv
```
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
) -> pathlib.Path:
    """Evaluate a model and write the folder of its repository, for ``HfApi.upload_folder``.

    ``rainbow-<env_id>.zip``, whose path is returned, is the model without what only its training
    needs, ``README.md`` the model card with command, results and versions, ``results.json`` the
    results, and ``vec_normalize.zip`` the statistics, if there are any. No file holds a pickle.

    Args:
        eval_env: env of the evaluation; the model acts under its masks where it learned under some,
            and a ``VecNormalize`` around it is in evaluation meanwhile.
        command: command that trained the model.
        deterministic: evaluate the greedy policy.

    Raises:
        ZooError: naming the settings that only a pickle could hold, such as a network's own class;
            or the folder has another ``README.md``.
    """
    out = pathlib.Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    readme = out / "README.md"
    if readme.exists() and "# **Rainbow** playing **" not in readme.read_text(encoding="utf-8"):
        raise ZooError(f"{readme} is no model card of Rainbow's: choose a folder without one")
    name = f"{ALGO}-{env_id.replace('/', '-')}"
    path = out / f"{name}.zip"
    write_model(model, path)
    normalizer = unwrap_vec_normalize(eval_env)
    (out / VEC_NORMALIZE).unlink(missing_ok=True)  # of an earlier model
    if normalizer is not None:
        write_statistics(normalizer, out / VEC_NORMALIZE)
        modes = normalizer.training, normalizer.norm_reward
        normalizer.training = normalizer.norm_reward = False
    masked = masks_apply(model, eval_env)
    try:
        returns, _ = evaluate_policy(
            model,  # type: ignore[arg-type]
            eval_env,
            n_eval_episodes,
            deterministic,
            return_episode_rewards=True,
            use_masking=masked,
        )
    finally:
        if normalizer is not None:  # its env may be the one that goes on training
            normalizer.training, normalizer.norm_reward = modes
    mean, std = float(np.mean(returns)), float(np.std(returns))
    results = {
        "mean_reward": mean,
        "std_reward": std,
        "is_deterministic": deterministic,
        "n_eval_episodes": n_eval_episodes,
        "eval_datetime": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    (out / "results.json").write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    info = get_system_info(print_info=False)[0]
    names = ("Stable-Baselines3", "Gymnasium", "PyTorch", "Numpy", "Python")
    versions = {"sb3_rainbow": metadata.version("sb3-rainbow-coop")}
    versions |= {name: info[name] for name in names if name in info}
    text = _CARD.format(
        name=name,
        env_id=env_id,
        **results,
        actions="greedy" if deterministic else "exploring",
        masks="yes" if masked else "none",
        statistics=_STATISTICS.format(name=name) if normalizer is not None else "",
        command=command,
        sb3_rainbow=versions["sb3_rainbow"],
        versions="\n".join(f"| {key} | {value} |" for key, value in versions.items()),
    )
    # what the hub's search, and the zoo's list of trained agents, read
    data = ModelCardData(
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
    ModelCard(f"---\n{data.to_yaml()}\n---\n\n{text}").save(readme)
    return path


def load_from_hub(repo_id: str, filename: str, trust: bool = False, **kwargs: Any) -> Rainbow:
    """Download a file such as ``rainbow-CartPole-v1.zip`` of organization/name and :func:`load` it.

    With ``trust`` a file that ``save`` wrote is taken too, which **runs its author's code**.
    """
    return load(hf_hub_download(repo_id, filename), trust, **kwargs)


def load(path: str | os.PathLike[str], trust: bool = False, **kwargs: Any) -> Rainbow:
    """Load a model from a file of unknown origin: nothing of a file of :func:`package` is run.

    Args:
        trust: True takes a file that ``save`` wrote, too. Loading that one **runs its author's
            code** with your rights: it holds pickles, and a pickle calls what it names.
        kwargs: passed to :func:`sb3_rainbow.zoo.model_file.read_model` (``env``, ``device``,
            arguments of Rainbow), or to ``Rainbow.load``.

    Raises:
        ZooError: if it cannot be loaded.
    """
    if trust and not is_model_file(path):
        with loading(path):
            return Rainbow.load(pathlib.Path(path), **kwargs)
    return read_model(path, **kwargs)


def load_vec_normalize(
    path: str | os.PathLike[str], venv: VecEnv, trust: bool = False
) -> VecNormalize:
    """As ``VecNormalize.load``, from a file of unknown origin, for evaluation.

    With ``trust`` a file that ``VecNormalize.save`` wrote is taken too, which **runs its author's
    code**.

    Raises:
        ZooError: if it cannot be loaded.
    """
    if not trust or is_model_file(path):
        return read_statistics(path, venv)
    with loading(path):
        normalizer = VecNormalize.load(os.fspath(path), venv)
        normalizer.training = normalizer.norm_reward = False
        return normalizer
