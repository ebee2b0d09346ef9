"""LeRobot 0.6.1 on a folder of demonstrations: read, split, 50 training steps of its ACT, one episode.

Run by ``tests/measure/lerobot.sh``, in an environment that has LeRobot. Nothing is downloaded: the images' network
begins with random weights.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium
import torch
from lerobot.configs import FeatureType
from lerobot.datasets.dataset_tools import split_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.feature_utils import dataset_to_policy_features

import imagine_bench  # noqa: F401 - registers the environments

CHUNK = 25
"""Commands that are predicted at once: a second."""
STEPS = 50
BATCH = 8
CAMERAS = ("hand", "front")


def trained(dataset: LeRobotDataset) -> tuple[ACTPolicy, Any, Any]:
    """ACT after some training steps, and the steps before and behind it."""
    features = dataset_to_policy_features(dataset.meta.features)
    outputs = {name: each for name, each in features.items() if each.type is FeatureType.ACTION}
    inputs = {name: each for name, each in features.items() if name not in outputs}
    config = ACTConfig(
        input_features=inputs,
        output_features=outputs,
        chunk_size=CHUNK,
        n_action_steps=CHUNK,
        pretrained_backbone_weights=None,
        device="cpu",
        push_to_hub=False,
    )
    policy = ACTPolicy(config)
    before, behind = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    policy.train()
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=1e-4)
    generator = torch.Generator().manual_seed(0)
    loader = torch.utils.data.DataLoader(dataset, batch_size=BATCH, shuffle=True, generator=generator)
    batches = iter(loader)
    for step in range(STEPS):
        batch = next(batches, None)
        if batch is None:
            batches = iter(loader)
            batch = next(batches)
        loss, _ = policy(before(batch))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 10 == 0 or step == STEPS - 1:
            print(f"step {step + 1}: loss {loss.item():.3f}", flush=True)
    return policy, before, behind


def episode(env: gymnasium.Env[Any, Any], policy: ACTPolicy, before: Any, behind: Any) -> tuple[float, int, bool]:
    """One episode: its return, its commands, and whether it succeeded."""
    policy.eval()
    policy.reset()
    seen, info = env.reset(seed=1)
    total = 0.0
    count = 0
    over = False
    while not over:
        images = {name: torch.from_numpy(seen[name]).permute(2, 0, 1)[None] / 255.0 for name in CAMERAS}
        given = {f"observation.images.{name}": image for name, image in images.items()}
        given["observation.state"] = torch.from_numpy(seen["proprio"])[None]
        with torch.inference_mode():
            action = behind(policy.select_action(before(given)))
        seen, reward, terminated, truncated, info = env.step(action.squeeze(0).numpy())
        total += float(reward)
        count += 1
        over = terminated or truncated
    return total, count, bool(info["is_success"])


def main(folder: Path) -> None:
    """Do it all, and say it in lines."""
    torch.manual_seed(0)
    card = json.loads((folder / "card.json").read_text())
    fps = int(card["rate_hz"])
    whole = LeRobotDataset("imagine_bench/demonstrations", root=folder)
    row = whole[0]
    print(f"read: {whole.num_episodes} episodes, {whole.num_frames} rows, fps {whole.fps}; task {row['task']!r}")
    print("row:", {name: tuple(value.shape) for name, value in row.items() if hasattr(value, "shape")})
    with tempfile.TemporaryDirectory() as scratch:
        parts = split_dataset(whole, {"train": 0.75, "test": 0.25}, output_dir=Path(scratch) / "split")
        print("split:", {name: (part.num_episodes, part.num_frames) for name, part in parts.items()})
        deltas = {"action": [index / fps for index in range(CHUNK)]}
        root = parts["train"].root
        begun = time.monotonic()
        policy, before, behind = trained(LeRobotDataset("imagine_bench/train", root=root, delta_timestamps=deltas))
        print(f"{STEPS} steps of {sum(each.numel() for each in policy.parameters()) / 1e6:.1f} M parameters:", end=" ")
        print(f"{time.monotonic() - begun:.0f} s")
    env = gymnasium.make(card["env_id"], size=card["size"], appearance=card["appearance"])
    total, count, success = episode(env, policy, before, behind)
    print(f"episode: return {total:.1f} in {count} commands, {'success' if success else 'no success'}")
    env.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
