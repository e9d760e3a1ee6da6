"""Behaviour cloning: a network learns the exact optimum's moves from a Minari dataset, under masks.
The small one of the repository, about a minute; `-m examples.behaviour_cloning 1` is one epoch.
"""

import os
import sys
from pathlib import Path

import minari
import numpy as np
import torch
from torch.nn.functional import cross_entropy

from benchmarks.cli import main
from sb3_rainbow import Rainbow

epochs = int(sys.argv[1]) if len(sys.argv) > 1 else 10
# another dataset of `python -m benchmarks study data`, such as optimum, and another seed
name = sys.argv[2] if len(sys.argv) > 2 else "optimum-small"
seed = int(sys.argv[3]) if len(sys.argv) > 3 else 0
data = Path(__file__).resolve().parent.parent / "results" / "data"
os.environ.setdefault("MINARI_DATASETS_PATH", str(data))

dataset = minari.load_dataset(f"coop-insertion/{name}-v0")
episodes = list(dataset)
held_out = len(episodes) // 10 or 1  # whole episodes, as neighbouring moves are alike


def columns(part: list[minari.EpisodeData]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Observations (n, 12), masks (n, 12) and moves (n,); the last observation has no move."""
    observations = np.concatenate([e.observations[:-1] for e in part])
    masks = np.concatenate([e.infos["action_masks"][:-1] for e in part])
    moves = np.concatenate([e.actions for e in part])
    return torch.as_tensor(observations), torch.as_tensor(masks), torch.as_tensor(moves)


# Rainbow's network without its extensions: what it calls values are the moves' scores here
parts = {"noisy": False, "dueling": False, "distributional": False, "prioritized": False}
model = Rainbow(
    "MlpPolicy",
    dataset.recover_environment(),
    policy_kwargs={"net_arch": [256, 128, 64]},
    buffer_size=1_000,
    seed=seed,
    device="cpu",
    **parts,  # type: ignore[arg-type]
)
optimizer = torch.optim.Adam(model.q_net.parameters(), lr=1e-3)
observations, masks, moves = columns(episodes[held_out:])
for _ in range(epochs):
    for rows in torch.randperm(len(moves)).split(128):
        scores = model.q_net(observations[rows]).masked_fill(~masks[rows], -torch.inf)
        loss = cross_entropy(scores, moves[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

observations, masks, moves = columns(episodes[:held_out])
with torch.no_grad():
    chosen = model.q_net(observations).masked_fill(~masks, -torch.inf).argmax(dim=1)
print(f"agreement on episodes held out: {(chosen == moves).float().mean():.2f}")
Path("build").mkdir(exist_ok=True)
file = f"build/cloned-{name}-s{seed}.zip"
model.save(file)
# A look at the starts of `quick`, which are for validation; without --episodes it joins the board
words = ["evaluate", "--model", file, "--name", "behaviour-cloning"]
sys.exit(main([*words, "--trust", "--mask-singularities", "--episodes", "20"]))
