"""The study of killed runs, on a small one."""

import re
from pathlib import Path

import pytest
import yaml

from benchmarks.__main__ import main

SMALL = {
    "policy": "MlpPolicy",
    "n_timesteps": 2000,
    "learning_starts": 40,
    "buffer_size": 2000,
    "batch_size": 8,
    "policy_kwargs": {"net_arch": [16]},
}


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_killed_run_ends_as_late_as_one_that_was_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rl_zoo3", reason="needs the extra zoo")
    settings = tmp_path / "small.yml"
    settings.write_text(yaml.safe_dump({"default": SMALL}), encoding="utf-8")
    words = ["resume", "--timesteps", "2000", "--seeds", "1", "--episodes", "1"]
    words += ["--out", str(tmp_path), "--conf-file", str(settings)]
    assert main(words) == 0
    text = (tmp_path / "CartPole-v1" / "resume.md").read_text(encoding="utf-8")
    (row,) = re.findall(r"^\| 0 .*$", text, re.MULTILINE)
    _, killed, _, went_on, *_ = (cell.strip().replace(",", "") for cell in row.split("|")[1:])
    assert 1000 < int(killed) < 2000
    assert int(killed) - 200 <= int(went_on) <= int(killed) + 200
    first = capsys.readouterr().out
    assert main(words) == 0  # what is there is not run again
    assert capsys.readouterr().out == first
