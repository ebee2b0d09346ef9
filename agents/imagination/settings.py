"""Settings of the agents that imagine; the defaults are the thesis' values of chapter 5.

Chapter 3 is pick-and-place with a human who changes their mind (thesis 3.2.2). It names no dropout, no max-norm, no
discount and no size of the memories. Its second controller is "trained in exactly the same manner, but on imaginary
data", so both memories are alike; imagined episodes end where the model says. ``(factors)`` and ``(deviations)`` name
the study that changed the value alone: points of success after 500 episodes at ``mild``, on three tuning seeds
(docs/explanation/imagination.md). Most values were chosen before there were studies.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from imagine_bench.errors import InvalidValueError

from ..dqn_settings import CONTROLLER_3, FAST_3, FAST_5, DQNSettings, ReplaySettings
from ..settings import (
    COUNT,
    DROPOUT,
    LAYERS,
    NOT_NEGATIVE,
    POSITIVE,
    PRECISIONS,
    PROBABILITY,
    ROWS,
    SIZES,
    SWITCH,
    UPDATES,
    ConfigGroup,
    Hyperparameters,
    Override,
    between,
    setting,
)

FEW = between(1, 1000)


@dataclass(frozen=True, kw_only=True)
class WorldModelSettings:
    """The environment model: dynamics p(z' | z, a), reward r(z'), termination d(z') (thesis 5.2.2).

    Sizes are units a hidden layer, of one network with two outputs or of two networks, else: InvalidValueError.
    """

    dynamics_hidden: tuple[int, ...] = setting((256, 256, 256), LAYERS)  #: units of each hidden layer of the dynamics
    components: int = setting(5, FEW)  #: gaussians in the mixture of the dynamics network, K
    #: Dynamics networks that differ by their first weights and dropout masks, E: a deep ensemble (Lakshminarayanan et
    #: al. 2017); the thesis has one.
    members: int = setting(1, FEW)
    #: units of each hidden layer of the reward network
    reward_hidden: tuple[int, ...] = setting((512, 512, 512), SIZES)
    #: units of each hidden layer of the termination network
    termination_hidden: tuple[int, ...] = setting((256, 256), SIZES)
    #: Of one network for reward and termination, instead of the two (thesis 3.2.2).
    shared_hidden: tuple[int, ...] = setting((), SIZES)
    #: The input of reward and termination: ``"next_state"`` (the thesis) or ``"transition"``.
    head_input: str = setting("next_state", ("next_state", "transition"))
    #: Reward that the reward network counts as 1. Log-cosh is quadratic below an error of 1 and linear above, where a
    #: rare large reward weighs little; the thesis counts in plain units, 1.
    reward_scale: float = setting(1.0, POSITIVE)
    dropout: float = setting(0.5, DROPOUT)  #: probability of dropping a hidden unit, the same in every network
    learning_rate: float = setting(1e-3, POSITIVE)  #: step size of Adam, of every network of the model
    #: Largest norm of the incoming weights of a unit; None limits nothing.
    max_norm: float | None = setting(3.0, POSITIVE)
    updates_per_step: int = setting(
        16, between(1, 1000)
    )  #: model updates a real step, N_E, of ``batch_size`` transitions each
    batch_size: int = setting(512, COUNT)  #: transitions a model update
    #: Latents of a batch are sampled from N(mu, (spread sigma)^2), anew for each batch; the thesis with 1. Where an
    #: encoder's posteriors are narrower than the appearance of one macrostate varies, networks learn the few frames
    #: they saw by heart; a larger spread keeps them from it.
    spread: float = setting(1.0, NOT_NEGATIVE)
    #: How much batches make up for rare outcomes: a transition is sampled in proportion to n ** -balance, with n the
    #: number of replayed ones of the same reward and end. In the thesis all are equally likely, 0. A good policy fails
    #: rarely, and a model that has forgotten failures imagines none.
    balance: float = setting(0.0, NOT_NEGATIVE)
    predict_change: bool = setting(False, SWITCH)  #: whether the mixture describes z' - z instead of z'
    sigma_floor: float = setting(0.01, POSITIVE)  #: smallest standard deviation of a component, in units of z
    #: Largest gradient norm of each network, an ensemble counting as one; None clips nothing.
    gradient_clip: float | None = setting(None, POSITIVE)
    precision: str = setting("auto", PRECISIONS)  #: in which hidden layers train. All else is always float32.

    def __post_init__(self) -> None:
        apart = bool(self.reward_hidden), bool(self.termination_hidden)
        if apart != (not self.shared_hidden,) * 2:
            raise InvalidValueError(
                f"model.shared_hidden is {self.shared_hidden}, model.reward_hidden {self.reward_hidden} and "
                f"model.termination_hidden {self.termination_hidden}: give either the first, for one network with both "
                "outputs, or the other two, and set the unused ones to []."
            )


@dataclass(frozen=True, kw_only=True)
class ImaginationSettings:
    """Imagined rollouts and their filter (thesis 5.2.2, algorithm 1); none ends before it starts."""

    start_episode: int = setting(1000, between(0, 10_000_000))  #: first training episode that imagines, I_start
    #: First training episode that imagines no more; its updates are made on real transitions instead, of which there
    #: are enough by then. None: imagination never ends (thesis).
    end_episode: int | None = setting(None, between(0, 10_000_000))
    #: Where rollouts start: ``"current"``, the state the robot just left (thesis), or ``"replayed"``, states sampled
    #: from the real memory.
    start_states: str = setting("current", ("current", "replayed"))
    #: Imagined episodes of a controller that is trained in the model alone (thesis 3.2.2).
    model_only_episodes: int = setting(1000, ROWS)
    breadth: int = setting(3, COUNT)  #: rollouts a real step, I_B
    depth: int = setting(10, COUNT)  #: longest rollout in macro-actions, I_D
    updates_per_step: int = setting(1, UPDATES)  #: controller updates on imagined transitions a real step, N_I
    #: Scale of the component's standard deviation when z' is sampled: 1 the thesis, 0 its mean.
    temperature: float = setting(1.0, NOT_NEGATIVE)
    #: Whose ``p(z' | z, a)`` is imagined: ``"average"``, that of the T weight samples (thesis 4.4, of chapter 4's
    #: predictions); ``"network"``, that of the whole network, which drops nothing (chapter 5 turns dropout on for the
    #: uncertainty of transitions that are there already); or ``"sample"``, that of one weight sample, drawn anew.
    predicts_with: str = setting("average", ("average", "network", "sample"))
    #: Smallest exploration probability inside rollouts; the real one counts where it is larger.
    exploration: float = setting(0.0, PROBABILITY)
    #: Reward that the controller learns from on top of a real transition's own, for each squared unit of z of epistemic
    #: variance in the model's prediction there, up to 1: artificial curiosity (thesis 6). Noise pays nothing. 0: none.
    curiosity: float = setting(0.0, NOT_NEGATIVE)
    #: Dropout samples of the dynamics, T (thesis 4.5: 50; chapter 5 names none).
    weight_samples: int = setting(50, between(1, 1000))
    #: How the epistemic variances of the latent dimensions become one. The thesis has a vector (equation 4.25) and one
    #: threshold; see docs/explanation/deviations.md for why that is read as max.
    reduction: str = setting("max", ("sum", "mean", "max"))
    #: Largest reduced epistemic variance that passes the filter, in squared units of z.
    threshold: float = setting(0.3, NOT_NEGATIVE)
    #: If given, the threshold moves with the model instead: it is this quantile of the reduced epistemic variance of
    #: transitions that really happened, a batch of them a real step.
    threshold_quantile: float | None = setting(None, PROBABILITY)
    #: Whether a step counts with the uncertainty of all steps before it in its rollout (as Infoprop, Frauenknecht
    #: et al. 2025), which so ends sooner the less the model knows. The thesis compares each step alone.
    accumulates: bool = setting(False, SWITCH)
    #: If given, the controller learns from all that is kept, each transition by its confidence, 1 / (1 + uncertainty /
    #: scale), with the reduced epistemic variance and the scale in squared units of z. None: all alike (thesis).
    confidence_scale: float | None = setting(None, POSITIVE)
    #: If given, the filter reads the reward network too: the largest standard deviation of a reward over T of its
    #: dropout samples that passes, in units of reward. The thesis reads the dynamics alone.
    reward_threshold: float | None = setting(None, NOT_NEGATIVE)
    #: If given, the filter reads the termination network too: the largest probability that passes of the less likely of
    #: two events, that the episode ends there or that it goes on.
    termination_threshold: float | None = setting(None, between(0.0, 0.5, "it bounds the less likely of two"))

    def __post_init__(self) -> None:
        if self.end_episode is not None and self.end_episode <= self.start_episode:
            raise InvalidValueError(
                f"imagination.end_episode {self.end_episode} is not above imagination.start_episode "
                f"{self.start_episode}: nothing would be imagined. Set it above that, or to null for no end."
            )


@dataclass(frozen=True, kw_only=True)
class MemorySettings(ReplaySettings):
    """How many real and imagined transitions are kept; the oldest go first (thesis 5.2.2)."""

    imagined: int = setting(3_000, ROWS)  #: imagined transitions that are kept


@dataclass(frozen=True, kw_only=True)
class Settings(DQNSettings):
    """All settings of an agent that imagines."""

    model: WorldModelSettings = field(default_factory=WorldModelSettings)
    imagination: ImaginationSettings = field(default_factory=ImaginationSettings)
    memory: MemorySettings = field(default_factory=MemorySettings)


_FAST_5: dict[str, Override] = {
    **FAST_5,
    "model.dynamics_hidden": Override((512,), "shallow and wide generalises; 3 x 256: 13 points less (deviations)"),
    "model.components": Override(2, "the rules are deterministic; five: 16 points less (deviations)"),
    "model.reward_hidden": Override((256, 256), "CPU time: 3 x 512 is most of the arithmetic of the thesis' model"),
    "model.termination_hidden": Override((128, 128), "CPU time; and 2 x 256: 13 points less (deviations)"),
    "model.dropout": Override(0.0, "one network with 25 % solves 7 points less (factors)"),
    "model.members": Override(3, "without dropout, networks that disagree show where the dynamics are unknown"),
    "model.learning_rate": Override(2e-3, "fewer updates a step want larger ones; 1e-3: 9 points less (deviations)"),
    "model.updates_per_step": Override(4, "CPU time; sixteen alone: no gain shown (deviations)"),
    "model.batch_size": Override(128, "CPU time; 512 alone: no gain shown at 500 (deviations)"),
    "model.spread": Override(4.0, "posteriors are narrower than the looks of a state; 1: 12 points less (factors)"),
    "model.balance": Override(0.5, "a good policy fails rarely; alone no gain after 500 episodes (factors)"),
    "model.predict_change": Override(True, "a macro-action moves one cube; alone no gain shown (deviations)"),
    "model.sigma_floor": Override(
        0.2, "narrow components stop learning from values that they miss; no gain shown (deviations)"
    ),
    "model.gradient_clip": Override(10.0, "narrow components have steep walls; without: 12 points less (deviations)"),
    "model.precision": Override("float32", "small batches gain little from bfloat16: 12 points less (deviations)"),
    "imagination.start_episode": Override(100, "the quick model is right early; 1000 would leave nothing to compare"),
    "imagination.end_episode": Override(
        1000, "real transitions carry on to 99.8 % at 2,000 (mild, tuning seeds 1001 to 1003; no other value was tried)"
    ),
    "imagination.start_states": Override(
        "replayed", "states of all episodes; the current one: 11 points less (factors)"
    ),
    "imagination.breadth": Override(8, "many short rollouts instead of few long ones; 3: 14 points less (deviations)"),
    "imagination.depth": Override(3, "at 10 latents drift to where reward and end disagree; values grow unbounded"),
    "imagination.updates_per_step": Override(4, "one, the thesis' N_I, solves 12 points less (factors)"),
    "imagination.temperature": Override(
        0.0, "sampled latents leave the region that networks know; 1: 16 points less (factors)"
    ),
    "imagination.exploration": Override(0.2, "a greedy rollout repeats the real actions; no gain shown (deviations)"),
    "imagination.weight_samples": Override(10, "acts only where dropout is set: else the 3 members are the samples"),
    "imagination.termination_threshold": Override(
        0.02, "chosen for 2,000 episodes, where the model half knows of wrong ends; early it costs (factors)"
    ),
}

_MINIMAL_5: dict[str, Override] = {
    **_FAST_5,
    "model.updates_per_step": Override(1, "shows that every part works, within a minute"),
    "imagination.start_episode": Override(10, "imagination must happen within a few dozen episodes"),
}

_CHAPTER_3 = Settings(
    model=WorldModelSettings(
        components=24,
        reward_hidden=(),
        termination_hidden=(),
        shared_hidden=(512, 256),
        dropout=0.0,
        max_norm=None,
        updates_per_step=4,
        batch_size=64,
        precision="float32",  # batches of 64 gain nothing from bfloat16
    ),
    controller=CONTROLLER_3,
    imagination=ImaginationSettings(depth=50, weight_samples=1),
    memory=MemorySettings(imagined=50_000),
)

_FAST_3: dict[str, Override] = {
    **FAST_3,
    "model.members": Override(3, "the filter compares networks; chapter 3 has no dropout to draw them from"),
    "model.updates_per_step": Override(1, "CPU time: one update of 256 rows for four of 64"),
    "model.batch_size": Override(256, "as many rows a real step as the thesis' four updates; see updates_per_step"),
    "model.sigma_floor": Override(0.05, "below the encoder's own spread nothing is left to learn"),
    "imagination.threshold": Override(0.1, "latents have unit variance: a tenth of it is uncertain"),
}

_MINIMAL_3: dict[str, Override] = {
    **_FAST_3,
    "imagination.model_only_episodes": Override(50, "shows that every part works, within a minute"),
}

HYPERPARAMETERS = Hyperparameters(
    {
        "chapter_3": ConfigGroup(_CHAPTER_3, {"minimal": _MINIMAL_3, "fast": _FAST_3, "published": {}}),
        "chapter_5": ConfigGroup(Settings(), {"minimal": _MINIMAL_5, "fast": _FAST_5, "published": {}}),
    }
)
