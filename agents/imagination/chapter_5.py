"""Settings of chapter 5, the arrow puzzle: the thesis' values are the defaults of every setting.

``(factors)`` and ``(deviations)`` name the study that changed the value alone: points of success after 500 episodes at
``mild``, on three tuning seeds (docs/when_imagination_helps.md). Most values were chosen before there were studies.
"""

from __future__ import annotations

from ..config_groups import Deviation, Family
from ..settings import Settings

_QUICK: dict[str, Deviation] = {
    "model.dynamics_hidden": Deviation((512,), "shallow and wide generalises; 3 x 256: 13 points less (deviations)"),
    "model.components": Deviation(2, "the rules are deterministic; five: 16 points less (deviations)"),
    "model.reward_hidden": Deviation((256, 256), "CPU time: 3 x 512 is most of the arithmetic of the thesis' model"),
    "model.termination_hidden": Deviation((128, 128), "CPU time; and 2 x 256: 13 points less (deviations)"),
    "model.dropout": Deviation(0.0, "one network with 25 % solves 7 points less (factors)"),
    "model.members": Deviation(3, "without dropout, networks that disagree say what the dynamics do not know"),
    "model.learning_rate": Deviation(2e-3, "fewer updates a step want larger ones; 1e-3: 9 points less (deviations)"),
    "model.updates_per_step": Deviation(4, "CPU time; sixteen alone: no gain shown (deviations)"),
    "model.batch_size": Deviation(128, "CPU time; 512 alone: no gain shown at 500 (deviations)"),
    "model.spread": Deviation(
        4.0, "posteriors are narrower than the looks of a macrostate vary; with 1, 12 points less (factors)"
    ),
    "model.balance": Deviation(
        0.5, "a good policy fails rarely; measured with the whole, and alone no gain after 500 episodes (factors)"
    ),
    "model.predict_change": Deviation(True, "a macro-action moves one cube; alone no gain shown (deviations)"),
    "model.sigma_floor": Deviation(
        0.2, "narrow components stop learning of what they miss; no gain shown (deviations)"
    ),
    "model.gradient_clip": Deviation(10.0, "narrow components have steep walls; without: 12 points less (deviations)"),
    "model.precision": Deviation(
        "float32", "small batches gain little from bfloat16; 12 points less with it (deviations)"
    ),
    "controller.epsilon_decay": Deviation(
        0.003, "0.03 ends exploration after 100 episodes; 13 points less with imagination (factors)"
    ),
    "imagination.start_episode": Deviation(100, "the quick model is right early; 1000 would leave nothing to compare"),
    "imagination.end_episode": Deviation(
        1000, "real transitions carry on to 99.8 % at 2,000 (mild, tuning seeds 1001 to 1003; no other value was tried)"
    ),
    "imagination.start_states": Deviation(
        "replayed",
        "rollouts from states of all episodes, not of this one: from the current state 11 points less (factors)",
    ),
    "imagination.breadth": Deviation(
        8, "short rollouts from many states instead of long ones; 3: 14 points less (deviations)"
    ),
    "imagination.depth": Deviation(
        3, "at depth 10 latents drift to where reward and end contradict each other, and values grow without bound"
    ),
    "imagination.updates_per_step": Deviation(4, "one, the thesis' N_I, solves 12 points less (factors)"),
    "imagination.temperature": Deviation(
        0.0, "sampled latents leave what the networks know: at 1, 16 points less (factors)"
    ),
    "imagination.exploration": Deviation(0.2, "a greedy rollout repeats the real actions; no gain shown (deviations)"),
    "imagination.weight_samples": Deviation(
        10, "acts only where dropout is set again: without it the three members are the samples"
    ),
    "imagination.termination_threshold": Deviation(
        0.02, "chosen for 2,000 episodes, where the model half knows of wrong ends; early it costs (factors)"
    ),
}

_SMOKE: dict[str, Deviation] = {
    **_QUICK,
    "model.updates_per_step": Deviation(1, "shows that every part works, within a minute"),
    "imagination.start_episode": Deviation(10, "imagination must happen within a few dozen episodes"),
}

_PRESETS = {"smoke": _SMOKE, "quick": _QUICK, "thesis": {}, "full": {}, "sample_efficiency": _QUICK, "lessons": _QUICK}
CHAPTER_5 = Family(thesis=Settings(), presets=_PRESETS)
