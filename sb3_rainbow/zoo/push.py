"""``python -m sb3_rainbow.zoo push``: a trained agent of a log folder as a repository of the hub.

The flags are those of the zoo's push_to_hub, which itself cannot be imported beside the version of
``huggingface_sb3`` that it depends on, and would evaluate without masks.
"""

import argparse
import pathlib
import shutil
import zipfile
from typing import Any

import torch as th
import yaml
from huggingface_hub import HfApi
from huggingface_sb3 import EnvironmentName, ModelName, ModelRepoId
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import StoreDict, get_model_path, get_saved_hyperparams
from stable_baselines3.common.utils import set_random_seed

from sb3_rainbow.zoo import hub
from sb3_rainbow.zoo.files import ALGO, ZooError
from sb3_rainbow.zoo.playing import PlayedRainbow, create_test_env


def main() -> None:
    """Package a run's model, and upload it."""
    args = _parser().parse_args()
    if args.num_threads > 0:
        th.set_num_threads(args.num_threads)
    set_random_seed(args.seed)
    env_name: EnvironmentName = args.env
    try:
        _, model_path, log_path = get_model_path(
            args.exp_id,
            args.folder,
            args.algo,
            env_name,
            args.load_best,
            args.load_checkpoint,
            args.load_last_checkpoint,
        )
    except (AssertionError, ValueError) as error:
        raise ZooError(str(error)) from error
    run = pathlib.Path(log_path)
    env_kwargs = _env_kwargs(run / env_name / "args.yml") | (args.env_kwargs or {})
    name = args.repo_name or ModelName(args.algo, env_name)
    out = pathlib.Path(args.output_folder or pathlib.Path("hub") / name)
    hyperparams, stats = get_saved_hyperparams(str(run / env_name), test_mode=True)

    env = create_test_env(
        env_name.gym_id,
        n_envs=args.n_envs,
        stats_path=stats,
        seed=args.seed,
        should_render=False,
        hyperparams=dict(hyperparams),
        env_kwargs=env_kwargs,
    )
    model = PlayedRainbow.load(model_path, env=env, device=args.device, seed=args.seed)
    # As the zoo evaluates: exploring where the game is deterministic
    explores = args.stochastic or (
        ExperimentManager.is_atari(env_name.gym_id) and not args.deterministic
    )
    hub.package(
        model,
        env_name.gym_id,
        out,
        eval_env=env,
        command=_command(run / env_name / "command.txt"),
        n_eval_episodes=args.n_eval_episodes,
        deterministic=not explores,
    )
    env.close()
    _copy_run(run, env_name, {**hyperparams.get("env_kwargs", {}), **env_kwargs}, out)
    print(f"Packaged in {out}")
    if args.no_upload:
        return
    if args.organization is None:
        raise ZooError("--organization says where to upload; --no-upload packages only")
    api, repo_id = HfApi(), ModelRepoId(args.organization, name)
    print(api.create_repo(repo_id, exist_ok=True))
    api.upload_folder(repo_id=repo_id, folder_path=out, commit_message=args.commit_message)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="Package a trained agent for the hub; upload it")
    add = parser.add_argument
    add("--algo", choices=[ALGO], default=ALGO, help="RL Algorithm")
    add("--env", type=EnvironmentName, required=True, help="Environment ID")
    add("-f", "--folder", default="logs", help="Log folder")
    add("-orga", "--organization", help="Hugging Face hub organization")
    add("-name", "--repo-name", help="Hub repository name, by default 'algo-env'")
    add("-m", "--commit-message", default="Initial commit", help="Commit message")
    add("-o", "--output-folder", help="Where to package, by default hub/<repository name>")
    add("--no-upload", action="store_true", help="Package only")
    add("--n-eval-episodes", type=int, default=10, help="Episodes of the evaluation")
    add("--n-envs", type=int, default=1, help="Environments of the evaluation")
    add("--exp-id", type=int, default=0, help="Experiment ID (0: latest, -1: no exp folder)")
    add("--load-best", action="store_true", help="Best model instead of the last")
    add("--load-checkpoint", type=int, help="Checkpoint at this number of timesteps instead")
    add("--load-last-checkpoint", action="store_true", help="Last checkpoint instead")
    add("--deterministic", action="store_true", help="Greedy actions")
    add("--stochastic", action="store_true", help="Exploring actions")
    add("--device", default="auto", help="PyTorch device")
    add("--num-threads", type=int, default=-1, help="Threads of PyTorch (-1: as they are)")
    add("--seed", type=int, default=0, help="Random generator seed")
    add("--env-kwargs", nargs="+", action=StoreDict, help="Arguments of the environment")
    add("--gym-packages", nargs="+", default=[], help="Packages that register environments")
    add("--verbose", type=int, default=1, help="As the zoo's scripts have it")
    return parser


def _env_kwargs(args_file: pathlib.Path) -> dict[str, Any]:
    """The environment's arguments on the command line of a run of one's own."""
    if not args_file.exists():
        return {}
    saved = yaml.load(args_file.read_text(encoding="utf-8"), Loader=yaml.UnsafeLoader)
    return dict(saved["env_kwargs"] or {})


def _command(command_file: pathlib.Path) -> str:
    """What trained the model, without where Python lies on this machine."""
    if not command_file.exists():
        return "unknown"
    _, *arguments = command_file.read_text(encoding="utf-8").split(" ")
    return " ".join(["python", *arguments])


def _copy_run(
    run: pathlib.Path, env_name: EnvironmentName, env_kwargs: dict[str, Any], out: pathlib.Path
) -> None:
    """The files of which the zoo's load_from_hub makes a log folder."""
    for name in ("args.yml", "config.yml"):
        if (run / env_name / name).exists():
            shutil.copy(run / env_name / name, out / name)
    (out / "env_kwargs.yml").write_text(yaml.safe_dump(env_kwargs), encoding="utf-8")
    with zipfile.ZipFile(out / "train_eval_metrics.zip", "w") as archive:
        for path in (*run.glob("evaluations.npz"), *run.glob("*.csv")):
            archive.write(path, path.name)
