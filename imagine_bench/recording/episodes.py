"""Rerun recordings of what an agent really does and of what it imagines meanwhile.

Timelines: ``sim_time`` (the arm moves; one still second and a half after each episode), ``env_step`` (one a real
frame), ``episode``, ``imagined_depth``. Entities: ``/scene/...``, ``/real/...``, ``/imagined/...``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.arrays import Arrays, Info, Macrostate, Observed
from imagine_bench.environments import Env
from imagine_bench.interfaces import Agent, Frame, Observation, SceneReader, State, TaskSpec
from imagine_bench.interfaces.capabilities import (
    Imaginer,
    MemoryReader,
    NoveltyReader,
    SeeingLearner,
    ValueReader,
    begin_episode,
)
from imagine_bench.judge.open_loop import Moment
from imagine_bench.recording.filmstrips import filmstrip, rgb, sampled_filmstrips
from imagine_bench.recording.scene import blueprint, log_motion, log_shapes, look_target_m, macro_duration_s
from imagine_bench.recording.stream import Recording, recording_file
from imagine_bench.rules import is_random
from imagine_bench.seeding import SeedTree, episode_seed
from imagine_bench.store.files import make_folder
from imagine_bench.store.results import ComparedRollout

MOTION_HZ = 20.0
IMAGINED_DEPTH = 6  # macro-actions imagined at each step; as many as a strip shows legibly
_STILL_S = 1.5
_BAR_CELLS = 16
_KINDS = {"epistemic": (204, 121, 167), "aleatoric": (86, 180, 233), "modal": (0, 158, 115)}


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
) -> Path:
    """Record greedy real episodes of a trained agent, with what it imagines at every step if it imagines.

    ``env`` is the task's at ``appearance``, and stays open; nothing changes in the agent, registered as ``name``. The
    episodes' seeds follow from the run's and are used for nothing else. ``path``, which is returned, ends in ``.rrd``;
    until complete it is called ``<stem>.partial.rrd``.

    Raises:
        UnknownNameError: Unknown task or agent.
        SetupError: The folder cannot be written.
    """
    spec = registry.task(task)
    entry = registry.agent_entry(name)
    make_folder(path.parent)
    scene = env.unwrapped
    if isinstance(scene, SceneReader):
        scene.capture_motion_hz = MOTION_HZ
    seen, info = env.reset(seed=episode_seed("recording", seed, 1))
    begin_episode(agent)
    first = Observation.of(seen, info, privileged=entry.privileged)
    values = isinstance(agent, ValueReader)
    imagines = isinstance(agent, Imaginer)
    several = imagines and is_random(spec.rules)
    layout = blueprint(
        target_m=look_target_m(scene),
        values=values,
        imagines=imagines,
        several=several,
        sees=isinstance(agent, SeeingLearner),
        explores=_novelty(agent, first, SeedTree(seed)) is not None,
    )
    with recording_file(path, task, layout) as recording:
        recorder = _EpisodeRecorder(
            recording=recording, spec=spec, agent=agent, appearance=appearance, privileged=entry.privileged, seed=seed
        )
        if isinstance(scene, SceneReader):
            log_shapes(recording, scene.shapes())
        for episode in range(1, episodes + 1):
            recorder.record(env, episode)
    return path


def q_table(names: Sequence[str], values: NDArray[np.float32], chosen: int) -> str:
    """Q-values (A,) as Markdown: a monospaced row each with a bar from the lowest value to the highest.

    The one of index ``chosen``, which is carried out, is marked by an arrow head.
    """
    low = float(values.min())
    high = float(values.max())
    width = max(len(name) for name in names)
    rows = []
    for index, (name, value) in enumerate(zip(names, values, strict=True)):
        cells = round(1 + (_BAR_CELLS - 1) * (float(value) - low) / (high - low or 1.0))
        rows.append(f"{'>' if index == chosen else ' '} {name:<{width}} {value:+7.2f} {'█' * cells}")
    return "\n".join(["```", *rows, "```", "\\> is the one it carries out."])


def _novelty(agent: Agent, observation: Observation, seeds: SeedTree) -> NDArray[np.float32] | None:
    """How unknown every macro-action is to an agent that can tell. Shape (A,)."""
    return agent.novelty(observation, seeds.generator()) if isinstance(agent, NoveltyReader) else None


@dataclass(kw_only=True)
class _EpisodeRecorder:
    """Records one episode after the other on a common clock; ``privileged`` agents are shown the macrostate."""

    recording: Recording
    spec: TaskSpec
    agent: Agent
    appearance: str
    privileged: bool
    seed: int
    clock_s: float = 0.0
    env_step: int = -1
    states: list[State] = field(default_factory=list)  #: of the episode so far

    def record(self, env: Env, episode: int) -> None:
        """One greedy real episode, numbered from 1."""
        seen, info = env.reset(seed=episode_seed("recording", self.seed, episode))
        begin_episode(self.agent)
        if episode == 1:  # the timeline imagined_depth begins there and needs a scene to stand in
            self.recording.stream.set_time("imagined_depth", sequence=0)
        observation = self._log_frame(env.unwrapped, episode, seen, info)
        if episode == 1:
            self._log_learning_to_see()
        self.states = []
        done = False
        step = 0
        heading = f"### Episode {episode}: a new start"
        while not done:
            macrostate = np.asarray(info["macrostate"])
            action = int(self.agent.act(observation, explore=False))
            self._describe(heading, info, f"Next: {self.spec.action_names[action]}.", observation.frame)
            self._log_values(observation, action)
            self._log_novelty(observation, episode, step)
            self.recording.stream.disable_timeline("imagined_depth")
            self._log_imagination(observation.frame, macrostate, episode, step)
            self.states.append(tuple(macrostate.tolist()))
            seen, reward, terminated, truncated, info = env.step(np.int64(action))
            self.clock_s += macro_duration_s(env.unwrapped)
            observation = self._log_frame(env.unwrapped, episode, seen, info)
            self.recording.scalar("/real/reward", float(reward))
            done = terminated or truncated
            step = step + 1
            fault = f" Fault: {info['fault_reason']}." if info["fault"] else ""
            outcome = f"Done: {self.spec.action_names[action]}. Reward {float(reward):+.0f}.{fault}"
            heading = f"### Episode {episode}, after macro-action {step}\n\n{outcome}"
        self._describe(heading, info, "Solved." if info["is_success"] else "Not solved.", observation.frame)
        self._clear_predictions()
        self.clock_s += _STILL_S

    def _log_learning_to_see(self) -> None:
        """What it saw whenever that changed in training, a moment each, while the scene stands still."""
        if not isinstance(self.agent, SeeingLearner):
            return
        for seen in self.agent.perceived():
            count = len(seen.sizes)
            values = f"{count} thing{'s' * (count != 1)}, of {', '.join(map(str, seen.sizes))} values"
            told = f"In training episode {seen.episodes} it tells apart {values if seen.sizes else 'nothing yet'}."
            self.recording.text("/real/text", told)
            self.recording.sheet("/seen/factors", seen.picture)
            self.clock_s += _STILL_S
            self.recording.set_clocks(self.clock_s, env_step=self.env_step, episode=1)

    def _log_frame(self, scene: Env, episode: int, seen: Observed, info: Info) -> Observation:
        """A new real frame: set the clocks, show it and how the scene stands. Returns what the agent sees."""
        observation = Observation.of(seen, info, privileged=self.privileged)
        frame = observation.frame if observation.frame.size else self._unseen_frame(scene, info)
        self.env_step += 1
        sequences = {"env_step": self.env_step, "episode": episode}
        self.recording.set_clocks(self.clock_s, **sequences)
        self.recording.log("/real/frame", rr.Image(frame))
        if isinstance(scene, SceneReader):
            if self.env_step == 0:
                sequences["imagined_depth"] = 0
            log_motion(self.recording, scene.motion(), end_s=self.clock_s, sequences=sequences)
        return observation

    def _unseen_frame(self, scene: Env, info: Info) -> Frame:
        """For people, the frame of an agent that sees something else: as late as that, and hiding as much."""
        shown = np.asarray(info.get("shown", info["macrostate"]))
        if isinstance(scene, SceneReader) and np.array_equal(shown, info["macrostate"]):
            return scene.agent_view()
        return self.spec.render_macrostates(shown[None], self.appearance, np.random.default_rng(self.env_step))[0]

    def _describe(self, heading: str, info: Info, last: str, frame: Frame) -> None:
        """What has happened, what is true, and what the frame shows where that is something else; what comes next.

        Of an agent with memory also what a read-out finds in it.
        """
        spec = self.spec
        truth: Macrostate = info["macrostate"]
        remembered = truth
        if isinstance(self.agent, MemoryReader):
            remembered = self.agent.read_memory(frame, [len(values) for values in spec.macrostate_values])
        names = map(spec.value_names, (truth, info.get("shown", truth), remembered))
        seen = ""
        for name, now, shown, recalled in zip(spec.macrostate_names, *names, strict=True):
            recall = f"; memory: {recalled}" if isinstance(self.agent, MemoryReader) else ""
            seen += f"- {name}: {now}" + f" (frame: {shown}{recall})" * (now != shown) + "\n"
        self.recording.text("/real/text", f"*{self.spec.description}*\n\n{heading}\n\n{seen}\n\n**{last}**")

    def _log_values(self, observation: Observation, action: int) -> None:
        """The Q-values: a curve each, and a table with bars, the chosen one marked."""
        if not isinstance(self.agent, ValueReader):
            return
        names = self.spec.action_names
        values = self.agent.q_values(observation)
        self.recording.curves("/real/q_values", names, values)
        self.recording.text("/real/q_table", q_table(names, values, action))

    def _log_novelty(self, observation: Observation, episode: int, step: int) -> None:
        """How unknown each macro-action is to the agent, a curve each."""
        novelty = _novelty(self.agent, observation, SeedTree(self.seed).child("novelty", episode, step))
        if novelty is not None:
            self.recording.curves("/real/novelty", self.spec.action_names, novelty)

    def _clear_predictions(self) -> None:
        """Remove what was predicted from the frame before: at an episode's end nothing more is carried out."""
        stale = ["/real/q_table"] if isinstance(self.agent, ValueReader) else []
        if isinstance(self.agent, Imaginer):
            stale += ["/imagined/filmstrip", *(f"/imagined/uncertainty/{kind}" for kind in _KINDS)]
            stale += ["/imagined/sampled_rollouts"] if is_random(self.spec.rules) else []
        for path in stale:
            self.recording.clear(path)

    def _log_imagination(self, frame: Frame, macrostate: NDArray[np.int64], episode: int, step: int) -> None:
        """The agent's greedy plan, imagined from here and set beside what would really happen."""
        if not isinstance(self.agent, Imaginer):
            return
        spec = self.spec
        seeds = SeedTree(self.seed)
        rng = seeds.child("recording", episode, step).generator()
        rollout = self.agent.imagine(frame, actions=None, depth=IMAGINED_DEPTH, rng=rng)
        moment = Moment(
            spec=spec,
            appearance=self.appearance,
            frame=frame,
            macrostate=tuple(macrostate.tolist()),
            before=self.states,
        )
        compared = moment.beside(rollout, rng)
        self.recording.sheet("/imagined/filmstrip", filmstrip(compared, spec.action_names, columns=IMAGINED_DEPTH))
        self._uncertainty_bars(compared)
        if is_random(spec.rules):  # several rollouts, since what happens next is partly chance
            branch = seeds.child("sampled_rollouts", episode, step)
            sampled = sampled_filmstrips(moment.sampled(self.agent, branch), spec)
            self.recording.sheet("/imagined/sampled_rollouts", sampled)
        if step == 0:
            self._by_depth(compared, f"/imagined/episode_{episode}")

    def _uncertainty_bars(self, compared: ComparedRollout) -> None:
        """Three bars, side by side, at each depth; none after the rollout's end, so that the axis stays the same."""
        for index, (kind, color) in enumerate(_KINDS.items()):
            imagined = np.asarray(getattr(compared.rollout, kind), dtype=np.float64)
            values = np.pad(imagined, (0, IMAGINED_DEPTH - len(imagined)))
            places = 1.0 + np.arange(len(values)) + 0.27 * (index - 1)
            widths = np.full(len(values), 0.25)
            bars = rr.BarChart(values, abscissa=places, widths=widths, color=color)
            self.recording.log(f"/imagined/uncertainty/{kind}", bars)

    def _by_depth(self, compared: ComparedRollout, root: str) -> None:
        """The same rollout along ``imagined_depth``; depth 0 is the real start."""
        rollout = compared.rollout
        recording = self.recording
        curves: Arrays = {
            **{f"uncertainty/{kind}": getattr(rollout, kind) for kind in _KINDS},
            "prediction/reward": rollout.rewards,
            "prediction/p_terminated": rollout.p_terminated,
            "prediction/true_reward": compared.real_rewards,
            "prediction/kept_by_filter": rollout.accepted,
        }
        for depth in range(len(rollout.actions) + 1):
            recording.stream.set_time("imagined_depth", sequence=depth)
            real = compared.start_frame if depth == 0 else compared.real_frames[depth - 1]
            imagined = rollout.start_frame if depth == 0 else rollout.frames[depth - 1]
            recording.log(f"{root}/real_frame", rr.Image(real))
            recording.log(f"{root}/frame", rr.Image(rgb(imagined)))
            for name, values in curves.items() if depth else ():
                recording.scalar(f"{root}/{name}", values[depth - 1])
        recording.stream.disable_timeline("imagined_depth")
