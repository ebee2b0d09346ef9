"""Every hyperparameter of the learners, with its unit and its source. The defaults are the thesis' values of chapter 5.

Another chapter's values are a family of settings (:mod:`.chapter_3`). A preset is a list of deviations from a family's
values, each beside its reason; ``thesis`` deviates in nothing, and chapter
5's ``full`` neither; chapter 3's is its ``quick``.
"""

from __future__ import annotations

from dataclasses import dataclass, field

START_STATES = ("current", "replayed")


@dataclass(frozen=True, kw_only=True)
class WorldModelSettings:
    """The environment model: dynamics p(z' | z, a), reward r(z'), termination d(z') (thesis 5.2.2).

    Attributes:
        dynamics_hidden: Units a hidden layer of the dynamics network.
        components: Gaussians in its mixture, K.
        members: Dynamics networks that differ by their first weights and dropout masks, E: a deep ensemble
            (Lakshminarayanan et al. 2017); the thesis has one.
        reward_hidden: Units a hidden layer of the reward network.
        termination_hidden: Units a hidden layer of the termination network.
        shared_hidden: Units a hidden layer of one network with both outputs, instead of the two (thesis 3.2.2).
        assessment_input: What reward and termination are read from: ``"next_state"`` (the thesis) or ``"transition"``.
        reward_scale: Reward that the reward network counts as 1. Log-cosh is quadratic below an error of 1 and linear
            above, where a rare large reward is hardly heard; the thesis counts in plain units, 1.
        dropout: Probability of dropping a hidden unit, the same in every network; [0, 1).
        learning_rate: Of Adam (thesis 3.2.2: 1e-3).
        max_norm: Largest norm of the incoming weights of a unit; None limits nothing.
        updates_per_step: Model updates a real step, N_E.
        batch_size: Transitions an update.
        spread: Latents of a batch are drawn from N(mu, (spread sigma)^2), anew for each batch; the thesis draws with 1.
            An encoder whose posteriors are narrower than the looks of one macrostate vary leaves networks to learn the
            few pictures they saw by heart; a larger spread keeps them from it.
        balance: How much batches make up for rare outcomes: a transition is drawn in proportion to n ** -balance, with
            n the number of replayed ones of the same reward and end. The thesis draws all alike, 0. A good policy
            fails rarely, and a model that has forgotten what fails imagines that nothing does.
        predict_change: Whether the mixture describes z' - z instead of z'.
        sigma_floor: Smallest standard deviation of a component, in units of z.
        gradient_clip: Largest gradient norm of each network, an ensemble counting as one; None clips nothing.
        precision: In which hidden layers train: float32, bfloat16, or auto, which is bfloat16 where the device has
            instructions for it; the gradients of output layers' weights come in it too. Weights, moments, the values
            of output layers, losses and predictions are always float32.
    """

    dynamics_hidden: tuple[int, ...] = (256, 256, 256)
    components: int = 5
    members: int = 1
    reward_hidden: tuple[int, ...] = (512, 512, 512)
    termination_hidden: tuple[int, ...] = (256, 256)
    shared_hidden: tuple[int, ...] = ()
    assessment_input: str = "next_state"
    reward_scale: float = 1.0
    dropout: float = 0.5
    learning_rate: float = 1e-3
    max_norm: float | None = 3.0
    updates_per_step: int = 16
    batch_size: int = 512
    spread: float = 1.0
    balance: float = 0.0
    predict_change: bool = False
    sigma_floor: float = 0.01
    gradient_clip: float | None = None
    precision: str = "auto"


@dataclass(frozen=True, kw_only=True)
class ControllerSettings:
    """The DQN on latents (thesis 5.2.2).

    Attributes:
        hidden: Units a hidden layer.
        learning_rate: Of Adam.
        batch_size: Transitions an update, real or imagined.
        updates_per_step: Updates on real transitions a real step, N_R.
        discount: Discount a macro-action, gamma in [0, 1]. The thesis gives none; see docs/deviations.md.
        target_rate: How far the target network moves toward the learning one after each update, in (0, 1]: 1 is no
            target network (thesis).
        gradient_clip: Largest gradient norm; None clips nothing.
        epsilon_min: Exploration probability in the limit.
        epsilon_max: Exploration probability at step 0.
        epsilon_decay: Decay rate lambda, a real step.
    """

    hidden: tuple[int, ...] = (512, 256, 128)
    learning_rate: float = 1e-3
    batch_size: int = 64
    updates_per_step: int = 1
    discount: float = 0.95
    target_rate: float = 1.0
    gradient_clip: float | None = None
    epsilon_min: float = 0.001
    epsilon_max: float = 0.8
    epsilon_decay: float = 0.03


@dataclass(frozen=True, kw_only=True)
class ImaginationSettings:
    """Imagined rollouts and their filter (thesis 5.2.2, algorithm 1).

    Attributes:
        start_episode: First training episode that imagines, I_start.
        end_episode: First training episode that imagines no more; its updates are made on real transitions instead, of
            which there are enough by then. None: imagination never ends (thesis).
        start_states: Where rollouts start: ``"current"``, the state the robot just left (thesis), or ``"replayed"``,
            states drawn from the real memory.
        rehearsal_episodes: Imagined episodes of a controller that is trained in imagination alone (thesis 3.2.2).
        breadth: Rollouts a real step, I_B.
        depth: Longest rollout in macro-actions, I_D.
        updates_per_step: Controller updates on imagined transitions a real step, N_I.
        temperature: Scale of the component's standard deviation when z' is drawn: 1 the thesis, 0 its mean.
        exploration: Smallest exploration probability inside rollouts; the real one counts where it is larger.
        weight_samples: Dropout samples of the dynamics, T (thesis 4.5: 50; chapter 5 names none).
        reduction: How the epistemic variances of the latent dimensions become one: sum, mean or max. The thesis has a
            vector (equation 4.25) and one threshold; see docs/deviations.md for why that is read as max.
        threshold: Largest reduced epistemic variance that passes the filter, in squared units of z.
        threshold_quantile: If given, the threshold moves with the model instead: it is this quantile of the reduced
            epistemic variance of transitions that really happened, a batch of them a real step.
        reward_threshold: If given, the filter reads the reward network too: the largest standard deviation of a reward
            over T of its dropout samples that passes, in units of reward. The thesis reads the dynamics alone.
        termination_threshold: If given, the filter reads the termination network too: the largest probability that
            passes of what the model thinks less likely, that the episode ends there or that it goes on; in [0, 0.5].
    """

    start_episode: int = 1000
    end_episode: int | None = None
    start_states: str = "current"
    rehearsal_episodes: int = 1000
    breadth: int = 3
    depth: int = 10
    updates_per_step: int = 1
    temperature: float = 1.0
    exploration: float = 0.0
    weight_samples: int = 50
    reduction: str = "max"
    threshold: float = 0.3
    threshold_quantile: float | None = None
    reward_threshold: float | None = None
    termination_threshold: float | None = None


@dataclass(frozen=True, kw_only=True)
class MemorySettings:
    """How many transitions each memory keeps; the oldest go first (thesis 5.2.2).

    Attributes:
        real: Transitions of the real memory.
        imagined: Transitions of the imagined memory.
        starts: Starts of real episodes, for those who imagine whole episodes.
    """

    real: int = 50_000
    imagined: int = 3_000
    starts: int = 1_000


@dataclass(frozen=True, kw_only=True)
class Settings:
    """All settings of a learner."""

    model: WorldModelSettings = field(default_factory=WorldModelSettings)
    controller: ControllerSettings = field(default_factory=ControllerSettings)
    imagination: ImaginationSettings = field(default_factory=ImaginationSettings)
    memory: MemorySettings = field(default_factory=MemorySettings)
