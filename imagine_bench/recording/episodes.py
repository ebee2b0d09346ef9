"""Rerun recordings of an agent's real episodes, and of its imagination meanwhile.

Timelines: ``sim_time`` (the arm moves; one still second and a half after each episode), ``env_step`` (one a real
frame), ``episode``, ``imagined_depth``. Entities: ``/scene/...``, ``/real/...``, ``/imagined/...``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.arrays import Arrays, Info, Macrostate, Observed
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Agent, Frame, Observation, State, TaskSpec
from imagine_bench.interfaces.capabilities import (
    Imaginer,
    MemoryReader,
    NoveltyReader,
    SeeingLearner,
    ValueReader,
    begin_episode,
)
from imagine_bench.interfaces.environments import Env
from imagine_bench.judge.open_loop import Moment
from imagine_bench.recording.filmstrips import DARK, filmstrip, sampled_filmstrips, signed
from imagine_bench.recording.stream import KINDS, Recording, recording_file, scene_view, sheet_view
from imagine_bench.rules import ending, is_random
from imagine_bench.seeding import SeedTree, episode_seed
from imagine_bench.store.results import ComparedRollout, RecordedEpisode

IMAGINED_DEPTH = 6  # macro-actions imagined at each step; as many as a strip shows legibly
_STILL_S = 1.5
_BAR_CELLS = 16


def record_run(
    task: str,
    agent: Agent,
    *,
    name: str,
    seed: int,
    env: Env,
    appearance: str,
    episodes: int,
    path: Path,
) -> tuple[RecordedEpisode, ...]:
    """Record greedy real episodes of a trained agent, with its imagination at every step if it imagines.

    ``env`` is the task's at ``appearance``, and stays open; nothing changes in the agent, registered as ``name``. The
    episodes' seeds follow from the run's and are used for nothing else. ``path`` ends in ``.rrd``; until complete it is
    called ``<stem>.partial.rrd``.

    Returns:
        The first episode that was solved and the first that was not, as far as there are such, in their order.

    Raises:
        UnknownNameError: Unknown task or agent.
        SetupError: The folder cannot be written.
    """
    spec = registry.task(task)
    privileged = registry.agent_entry(name).privileged
    with recording_file(path, task, _layout, env=env) as recording:
        recorder = _EpisodeRecorder(recording, spec, agent, appearance, privileged, seed)
        for episode in range(1, episodes + 1):
            recorder.record(env, episode)
    return tuple(recorder.first.values())


def q_table(names: Sequence[str], values: NDArray[np.float32], chosen: int) -> str:
    """Q-values (A,) as Markdown: a monospaced row each with a bar from zero, to the left where it is negative.

    The one of index ``chosen``, which is carried out, is marked by an arrow head. The bar of an infinite one is as long
    as the longest on its side; NaN has none.
    """
    finite = values[np.isfinite(values)]
    low = float(finite.min(initial=0.0))
    high = float(finite.max(initial=0.0))
    cells_per_unit = _BAR_CELLS / (high - low or 1.0)
    room = round(-low * cells_per_unit)
    width = max(len(name) for name in names)
    rows = []
    lengths = abs(np.nan_to_num(values, posinf=high, neginf=low))
    for index, (name, value, length) in enumerate(zip(names, values, lengths.tolist(), strict=True)):
        bar = "█" * round(length * cells_per_unit)
        below, above = (bar, "") if value < 0 else ("", bar)
        rows.append(f"{'>' if index == chosen else ' '} {name:<{width}} {value:+7.2f} {below:>{room}}│{above}")
    return "\n".join(["```", *rows, "```", "\\> is the one it carries out; bars begin at zero."])


@dataclass
class _EpisodeRecorder:
    """Records one episode after the other on a common clock; ``privileged`` agents are shown the macrostate."""

    recording: Recording
    spec: TaskSpec
    agent: Agent
    appearance: str
    privileged: bool
    seed: int
    states: list[State] = field(default_factory=list)  #: of the episode so far
    frames: list[Frame] = field(default_factory=list)  #: likewise
    first: dict[bool, RecordedEpisode] = field(default_factory=dict)  #: the first solved one and the first other one

    def record(self, env: Env, episode: int) -> None:
        """One greedy real episode, numbered from 1."""
        self.frames = []
        names = self.spec.action_names
        recording = self.recording
        seen, info = env.reset(seed=episode_seed("recording", self.seed, episode))
        begin_episode(self.agent)
        observation = self._log_frame(episode, seen, info)
        if episode == 1:
            self._log_learning_to_see()
        self.states = []
        actions: list[int] = []
        rewards: list[float] = []
        done = False
        step = 0
        heading = f"### Episode {episode}: a new start"
        while not done:
            action = int(self.agent.act(observation, explore=False))
            self._describe(heading, info, f"Next: {names[action]}.", observation.frame)
            self._log_values(observation, action, SeedTree(self.seed).child("novelty", episode, step))
            recording.leave("imagined_depth")
            self._log_imagination(observation.frame, info["macrostate"], episode, step)
            self.states.append(tuple(info["macrostate"].tolist()))
            seen, reward, terminated, truncated, info = env.step(np.int64(action))
            self.recording.act()
            observation = self._log_frame(episode, seen, info)
            recording.curves("/real", {"reward": float(reward)})
            actions.append(action)
            rewards.append(float(reward))
            done = terminated or truncated
            step = step + 1
            fault = f" Fault: {info.get('fault_reason', 'not named')}." if info["fault"] else ""
            outcome = f"Done: {names[action]}. Reward {signed(float(reward))}.{fault}"
            heading = f"### Episode {episode}, after macro-action {step}\n\n{outcome}"
        end = ending(info, terminated=terminated)
        self._describe(heading, info, f"{end.capitalize()}.", observation.frame)
        self._keep(actions, rewards, success=bool(info["is_success"]), end=end)
        recording.clear("/real/q_table")  # nothing more is carried out
        recording.clear("/imagined")
        recording.clock_s += _STILL_S

    def _keep(self, actions: Sequence[int], rewards: Sequence[float], *, success: bool, end: str) -> None:
        """Keep the episode if it is the first that ended so."""
        played = RecordedEpisode(
            frames=np.array(self.frames),
            actions=np.array(actions),
            rewards=np.array(rewards),
            success=np.array(success),
            end=np.array(end),
        )
        self.first.setdefault(success, played)

    def _log_learning_to_see(self) -> None:
        """Its perception whenever that changed in training, a moment each, while the scene stands still."""
        recording = self.recording
        for seen in self.agent.perceived() if isinstance(self.agent, SeeingLearner) else ():
            count = len(seen.sizes)
            values = f"{count} thing{'s' * (count != 1)}, of {', '.join(map(str, seen.sizes))} values"
            told = f"In training episode {seen.episodes} it tells apart {values if seen.sizes else 'nothing yet'}."
            recording.text("/real/text", told)
            recording.sheet("/seen/factors", seen.picture)
            recording.clock_s += _STILL_S
            recording.set_clocks(env_step=self.recording.env_step, episode=1)

    def _log_frame(self, episode: int, seen: Observed, info: Info) -> Observation:
        """A new real frame: set the clocks, show it and how the scene stands. Returns the agent's observation."""
        observation = Observation.of(seen, info, privileged=self.privileged)
        if self.recording.env_step < 0:  # the timeline imagined_depth begins there and needs a scene to stand in
            self.recording.set_clocks(imagined_depth=0)
        self.recording.show(episode=episode)
        frame = observation.frame if observation.frame.size else self._unseen_frame(info)
        self.recording.log("/real/frame", rr.Image(frame))
        self.frames.append(frame)
        return observation

    def _unseen_frame(self, info: Info) -> Frame:
        """For people, the frame of an agent that sees something else: as late as that, and hiding as much."""
        shown = np.asarray(info.get("shown", info["macrostate"]))
        if self.recording.scene is not None and np.array_equal(shown, info["macrostate"]):
            return self.recording.scene.agent_view()
        return self.spec.render_macrostates(
            shown[None], self.appearance, np.random.default_rng(self.recording.env_step)
        )[0]

    def _describe(self, heading: str, info: Info, last: str, frame: Frame) -> None:
        """The last step, the true macrostate, that of the frame where it differs, and the next step.

        Of an agent with memory also the values that a read-out finds in it.
        """
        spec = self.spec
        truth: Macrostate = info["macrostate"]
        remembered = truth
        remembers = isinstance(self.agent, MemoryReader)
        if isinstance(self.agent, MemoryReader):
            remembered = self.agent.read_memory(frame, [len(values) for values in spec.macrostate_values])
        names = map(spec.value_names, (truth, info.get("shown", truth), remembered))
        seen = ""
        for name, now, shown, recalled in zip(spec.macrostate_names, *names, strict=True):
            recall = f"; memory: {recalled}" if remembers else ""
            seen += f"- {name}: {now}" + f" (frame: {shown}{recall})" * (now != shown) + "\n"
        self.recording.text("/real/text", f"*{self.spec.description}*\n\n{heading}\n\n{seen}\n\n**{last}**")

    def _log_values(self, observation: Observation, action: int, seeds: SeedTree) -> None:
        """The Q-values, a curve each and a table with bars; how unknown each macro-action is, a curve each."""
        names = self.spec.action_names
        if isinstance(self.agent, ValueReader):
            values = np.asarray(self.agent.q_values(observation), dtype=np.float32)
            if values.shape != (len(names),):
                raise InvalidValueError(f"q_values() gave the shape {values.shape}; give {len(names)} numbers.")
            self.recording.curves("/real/q_values", dict(zip(names, values, strict=True)))
            self.recording.text("/real/q_table", q_table(names, values, action))
        if isinstance(self.agent, NoveltyReader):
            novelty = self.agent.novelty(observation, seeds.generator())
            if novelty is not None:
                self.recording.curves("/real/novelty", dict(zip(names, novelty, strict=True)))

    def _log_imagination(self, frame: Frame, macrostate: Macrostate, episode: int, step: int) -> None:
        """The agent's greedy plan, imagined from here and set beside the real outcome of the same macro-actions."""
        if not isinstance(self.agent, Imaginer):
            return
        spec = self.spec
        seeds = SeedTree(self.seed)
        rng = seeds.child("recording", episode, step).generator()
        rollout = self.agent.imagine(frame, actions=None, depth=IMAGINED_DEPTH, rng=rng).in_range()
        moment = Moment(
            spec=spec,
            appearance=self.appearance,
            frame=frame,
            macrostate=tuple(macrostate.tolist()),
            before=self.states,
        )
        compared = moment.beside(rollout, rng)
        self.recording.sheet(
            "/imagined/filmstrip", filmstrip(compared, spec.action_names, columns=IMAGINED_DEPTH, colors=DARK)
        )
        for index, (kind, color) in enumerate(KINDS.items()):  # three bars, side by side, at each depth
            values = np.zeros(IMAGINED_DEPTH)  # none after the rollout's end, so that the axis stays the same
            imagined = getattr(rollout, kind)
            values[: len(imagined)] = imagined
            places = np.arange(IMAGINED_DEPTH) + 1.0 + 0.27 * (index - 1)
            bars = rr.BarChart(values, abscissa=places, widths=np.full(IMAGINED_DEPTH, 0.25), color=color)
            self.recording.log(f"/imagined/uncertainty/{kind}", bars)
        if is_random(spec.rules):  # several rollouts, since the next macrostate is partly chance
            branch = seeds.child("sampled_rollouts", episode, step)
            sampled = sampled_filmstrips(moment.sampled(self.agent, branch), spec, DARK)
            self.recording.sheet("/imagined/sampled_rollouts", sampled)
        if step == 0:
            _log_by_depth(self.recording, compared, f"/imagined/episode_{episode}")


def _log_by_depth(recording: Recording, compared: ComparedRollout, root: str) -> None:
    """A rollout along ``imagined_depth``; depth 0 is the real start."""
    rollout = compared.rollout
    predictions: Arrays = {
        "reward": rollout.rewards,
        "p_terminated": rollout.p_terminated,
        "true_reward": compared.real_rewards,
        "kept_by_filter": rollout.accepted,
    }
    for depth in range(len(rollout.actions) + 1):
        recording.set_clocks(imagined_depth=depth)
        recording.frames(compared, depth, real=f"{root}/real_frame", imagined=f"{root}/frame")
        if depth:
            recording.curves(f"{root}/uncertainty", {kind: getattr(rollout, kind)[depth - 1] for kind in KINDS})
            recording.curves(f"{root}/prediction", {name: each[depth - 1] for name, each in predictions.items()})
    recording.leave("imagined_depth")


def _layout(recording: Recording) -> rrb.Vertical:
    """The scene large, beside it the agent's view and predictions, below it its imagination."""
    shown = recording.shown
    table = rrb.TextDocumentView(origin="/real/q_table", name="Q-values: return expected of each macro-action")
    side = rrb.Vertical(
        rrb.Horizontal(
            rrb.TextDocumentView(origin="/real/text", name="Steps"),
            rrb.Spatial2DView(origin="/real/frame", name="Agent's view, 64 x 64"),
        ),
        *shown(table),
        row_shares=[1.2, 1.0],
    )
    top = rrb.Horizontal(scene_view(recording), side, column_shares=[1.1, 1.0])
    seen = "Its learned perception: a color a factor, and beside it a view of each of its values"
    plan = "The agent's own plan from here: the real outcome (above), its imagination (below)"
    uncertainty = "Uncertainty by depth: epistemic pink, aleatoric blue, modal yellow"
    strip = sheet_view("/imagined/filmstrip", plan)
    now = rrb.Horizontal(
        strip,
        rrb.BarChartView(origin="/imagined/uncertainty", name=uncertainty, plot_legend=rrb.PlotLegend(visible=False)),
        column_shares=[1.5, 1.0],
        name="Imagination from the current frame",
    )
    over_time = shown(
        rrb.TimeSeriesView(origin="/real/reward", name="Reward of each real macro-action"),
        rrb.TimeSeriesView(origin="/real/q_values", name="Q-value of each macro-action"),
        rrb.TimeSeriesView(origin="/real/novelty", name="Unknown share of each macro-action"),
    )
    root = "/imagined/episode_1"
    by_depth = rrb.Horizontal(
        rrb.Spatial2DView(origin=f"{root}/real_frame", name="Real"),
        rrb.Spatial2DView(origin=f"{root}/frame", name="Imagined"),
        rrb.TimeSeriesView(origin=f"{root}/uncertainty", name="Uncertainty by depth"),
        rrb.TimeSeriesView(origin=f"{root}/prediction", name="Predicted reward and P(end) by depth"),
        column_shares=[1, 1, 2, 2],
        name="Episode 1 by depth (choose the timeline imagined_depth below)",
    )
    imagines = len(shown(strip))
    pages: list[rrb.Container | rrb.View] = [
        *shown(sheet_view("/seen/factors", seen)),
        *[now] * imagines,
        *shown(sheet_view("/imagined/sampled_rollouts", "Several futures from the current frame")),
        rrb.Horizontal(*over_time, name="Rewards and values over time"),
        *[by_depth] * imagines,
    ]
    return rrb.Vertical(top, rrb.Tabs(*pages, active_tab=0), row_shares=[1.35, 1.0])
