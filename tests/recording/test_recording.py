"""Recordings: whole files, the expected entities and timelines, closed whatever happens."""

from __future__ import annotations

import dataclasses
import itertools
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import rerun as rr
import rerun.blueprint as rrb
from fake_agents import FakeAgent, FakeImaginer
from numpy.typing import NDArray
from recordings import contents, logged, rerun, times, view_names
from small_runs import Inline, small

from imagine_bench import registry
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.interfaces import Agent, Frame, Motion, Observation, Shape3D, State
from imagine_bench.interfaces.capabilities import ImaginedRollout, Perceived
from imagine_bench.judge.open_loop import Moment
from imagine_bench.recording import episodes, stream
from imagine_bench.recording.episodes import record_run
from imagine_bench.recording.stream import log_motion, log_shapes, open_in_viewer, recording_file
from imagine_bench.rules import ending
from imagine_bench.running.bench import bench
from imagine_bench.seeding import episode_seed

NOTHING = lambda _: rrb.Vertical()  # noqa: E731


def record(
    agent: Agent, path: Path, *, name: str = "imagination", execution: str = "kinematic", **changes: object
) -> Path:
    settings = {"seed": 3, "appearance": "mild", "episodes": 2, **changes}
    with closing(gymnasium.make("imagine_bench/ArrowPuzzle-v0", execution=execution, appearance="mild")) as env:
        record_run("arrow_puzzle", agent, name=name, env=env, path=path, **settings)  # type: ignore[arg-type]
    return path


@pytest.fixture(scope="module")
def imagined(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(FakeImaginer(), tmp_path_factory.mktemp("recordings") / "run" / "recording.rrd")


def test_verifies(imagined: Path) -> None:
    checked = rerun("rrd", "verify", imagined)
    assert checked.returncode == 0, checked.stderr


def by_step(path: Path, entity: str, column: str) -> list[Any]:
    """The values that were logged for an entity, in the order of its real steps."""
    return [value for _, (value,) in logged(path, entity, column, "env_step")]


class _HandsOver(FakeImaginer):
    """Acts and imagines within the four macro-actions of pick-and-place."""

    def act(self, observation: Observation, *, explore: bool) -> int:
        return 3

    def imagine(
        self, frame: Frame, *, actions: NDArray[np.int64] | None, depth: int, rng: np.random.Generator
    ) -> ImaginedRollout:
        return super().imagine(frame, actions=rng.integers(4, size=depth), depth=depth, rng=rng)

    def q_values(self, observation: Observation) -> NDArray[np.float32]:
        return np.arange(4, dtype=np.float32)


class _SeesAndExplores(FakeAgent):
    """Has learned to see, in two steps, and says how unknown each action is."""

    def perceived(self) -> list[Perceived]:
        return [Perceived(5 * n, (2,) * n, np.full((8, 8, 3), n, dtype=np.uint8)) for n in (0, 3)]

    def novelty(self, observation: Observation, rng: np.random.Generator) -> NDArray[np.float32]:
        return rng.random(6, dtype=np.float32)


def test_a_recording_shows_perception_first_and_unknown_steps(imagined: Path, tmp_path: Path) -> None:
    path = record(_SeesAndExplores(), tmp_path / "tells.rrd", name="random")
    looked, acted = times(path, "/seen/factors", "sim_time"), times(path, "/real/reward", "sim_time")
    assert len(looked) == 2 and max(looked) < min(acted)
    assert by_step(path, "/real/text", "TextDocument:text")[:2] == [
        f"In training episode {words}."
        for words in ("0 it tells apart nothing yet", "15 it tells apart 3 things, of 2, 2, 2 values")
    ]
    asked = {step - 1 for step in times(path, "/real/reward", "env_step")}
    assert times(path, "/real/novelty/turn_the_left_cube_clockwise", "env_step") == asked
    assert not any("novelty" in path or "seen" in path for path in contents(imagined))
    view = "Unknown share of each macro-action"
    assert view in view_names(path) and view not in view_names(imagined)


class _Repeats(FakeAgent):
    """Always takes one macro-action."""

    def __init__(self, action: int) -> None:
        super().__init__()
        self.action = action

    def act(self, observation: Observation, *, explore: bool) -> int:
        return self.action


@pytest.mark.parametrize("action", [0, 4])
def test_the_first_solved_and_lost_episodes_are_kept(tmp_path: Path, action: int) -> None:
    path = tmp_path / "recording.rrd"
    with closing(gymnasium.make("imagine_bench/ArrowPuzzle-v0", execution="kinematic")) as env:
        given: dict[str, Any] = {"name": "random", "env": env, "seed": 3, "appearance": "clean", "episodes": 12}
        kept = record_run("arrow_puzzle", _Repeats(action), path=path, **given)
        wanted: dict[bool, tuple[list[Frame], list[float]]] = {}
        for episode in range(1, 13):
            seen, info = env.reset(seed=episode_seed("recording", 3, episode))
            frames, rewards, over = [seen], [], False
            while not over:
                seen, reward, terminated, truncated, info = env.step(action)
                frames.append(seen)
                rewards.append(reward)
                over = terminated or truncated
            wanted.setdefault(bool(info["is_success"]), (frames, rewards))
    assert sorted(bool(each.success) for each in kept) == sorted(wanted)
    for each in kept:
        frames, rewards = wanted[bool(each.success)]
        assert np.array_equal(each.frames, frames) and each.rewards.tolist() == rewards
        assert set(each.actions.tolist()) == {action} and (str(each.end) == "solved") == bool(each.success)


def test_several_rollouts_are_shown_only_where_rules_are_random(imagined: Path, tmp_path: Path) -> None:
    """In physics the clock goes on as long as each macro-action takes."""
    with closing(gymnasium.make("imagine_bench/PickPlace-v0")) as env:
        path = tmp_path / "chance.rrd"
        record_run(
            "pick_place", _HandsOver(), name="imagination", seed=0, env=env, appearance="clean", episodes=1, path=path
        )
        scene: Any = env.unwrapped
        acted = [at.total_seconds() for at in sorted(times(path, "/real/reward", "sim_time"))]
        assert np.diff(acted, prepend=0.0)[-1] == pytest.approx(scene.motion().time_s[-1]) != 1.0
    assert contents(path)["/imagined/sampled_rollouts"] >= {"sim_time", "env_step", "episode"}
    assert "/imagined/sampled_rollouts" not in contents(imagined)


def test_values_without_end_are_shown_and_a_wrong_number_of_them_is_named(tmp_path: Path) -> None:
    """As of an agent that tries every action first, or whose network has diverged; a tuple is as good as an array."""

    class Values(FakeAgent):
        values: Any = (-2.0, np.inf, 1.0, -np.inf, np.nan, 0.0)

        def q_values(self, observation: Observation) -> Any:
            return self.values

    record(Values(), tmp_path / "all.rrd", name="random")
    table = episodes.q_table([*"abcdef"], np.array(Values.values, dtype=np.float32), 1)
    assert [line.count("█") for line in table.splitlines()[1:7]] == [11, 5, 5, 11, 0, 0]
    for Values.values in ((1.0,), ((1.0,) * 6,), None):
        with pytest.raises(InvalidValueError, match=r"q_values\(\) gave the shape .*; give 6 numbers"):
            record(Values(), tmp_path / "none.rrd", name="random")


def test_a_failure_leaves_a_closed_partial_file_and_what_was_there(tmp_path: Path) -> None:
    class Breaks(FakeImaginer):
        def q_values(self, observation: Observation) -> np.ndarray:
            raise RuntimeError("broken on purpose")

    path = tmp_path / "recording.rrd"
    path.write_bytes(b"earlier")
    with pytest.raises(RuntimeError, match="broken on purpose"):
        record(Breaks(), path)
    assert path.read_bytes() == b"earlier"
    partial = tmp_path / "recording.partial.rrd"
    assert rerun("rrd", "verify", partial).returncode == 0
    assert "/real/frame" in contents(partial)


_VIEW = """
import os
from pathlib import Path
from imagine_bench.recording.stream import open_in_viewer
os.environ["PYTHONPATH"] = os.environ["VIEWERS"]
os.environ.pop("PYTHONSAFEPATH", None)
open_in_viewer(Path("a.rrd"))
"""


def test_a_viewer_that_fails_is_not_one_of_the_current_folder(tmp_path: Path) -> None:
    """A stand-in on Python's path is run, and one in the current folder is not."""
    path = tmp_path / "here" / "a.rrd"
    for folder in ("path", "here"):
        (tmp_path / folder).mkdir()
        viewer = f"open({str(tmp_path / 'ran')!r}, 'w').write({folder!r})\nraise SystemExit(1)"
        (tmp_path / folder / "rerun.py").write_text(viewer)
    path.write_bytes(b"no recording")
    with pytest.raises(ArtefactError, match=r"a\.rrd is no recording of Rerun"):
        open_in_viewer(path)
    path.write_bytes(b"RRF2")
    environment = {**os.environ, "VIEWERS": str(tmp_path / "path")}
    words = [sys.executable, "-P", "-c", _VIEW]
    done = subprocess.run(words, env=environment, cwd=path.parent, capture_output=True, text=True, check=False)
    said = r"No display .* the viewer failed; .* run 'rerun a.rrd' .* --serve-web"
    assert re.search(f"SetupError: {said}", done.stderr), done.stderr
    assert (tmp_path / "ran").read_text() == "path"


@pytest.mark.parametrize(
    ("info", "terminated", "words"),
    [
        ({"is_success": True}, True, "solved"),
        ({"is_success": False}, True, "lost, because the rules forbid the result of the last macro-action"),
        ({"is_success": False, "fault": False}, False, "lost, because no macro-actions are left"),
        ({"is_success": False, "fault": True}, False, "lost, because of a fault"),
        ({"is_success": False, "fault_reason": "it blew up"}, False, "lost, because it blew up"),
    ],
)
def test_an_episode_that_is_lost_says_why(info: dict[str, object], terminated: bool, words: str) -> None:
    assert ending(info, terminated=terminated) == words


def test_a_shape_that_cannot_be_drawn_is_refused() -> None:
    """Those that can be are in ``tests/whole``."""
    pose = np.array([0, 0, 0, 1.0, 0, 0, 0])
    cone = Shape3D(name="cone", body="body", kind="cone", size=np.ones(3), pose_in_body=pose, rgba=np.ones(4))
    with pytest.raises(InvalidValueError, match="is of kind 'cone'"), rr.RecordingStream("test") as file:
        log_shapes(stream.Recording(file), [cone])


def test_a_motion_ends_now_and_bodies_that_stand_still_get_no_new_poses(tmp_path: Path) -> None:
    poses = np.zeros((4, 2, 7))
    poses[..., 3] = 1.0
    poses[:, 1, 0] = np.arange(4)
    motion = Motion(body_names=("still", "moves"), time_s=np.arange(4) / 20.0, poses_in_world=poses)
    with recording_file(tmp_path / "motion.rrd", "test", NOTHING) as file:
        file.set_clocks(env_step=3)
        file.clock_s = 2.0
        log_motion(file, motion)
    moves = logged(tmp_path / "motion.rrd", "/scene/moves", "Transform3D:translation", "sim_time")
    assert [at.total_seconds() for at, _ in moves] == [1.85, 1.9, 1.95, 2.0]
    assert [x for _, ((x, _, _),) in moves] == [0, 1, 2, 3]
    assert "/scene/still" not in contents(tmp_path / "motion.rrd")


def test_the_view_looks_at_the_place_of_the_objects(tmp_path: Path) -> None:
    with (
        closing(gymnasium.make("imagine_bench/ArrowPuzzle-v0", execution="kinematic")) as env,
        recording_file(tmp_path / "view.rrd", "test", NOTHING, env=env) as file,
    ):
        env.reset(seed=0)
        file.show()
        scene: Any = env.unwrapped
        cubes = [scene.data.body(f"cube_{number}").xpos for number in range(3)]
    np.testing.assert_allclose(file.look_target_m[:2], np.mean(cubes, axis=0)[:2], atol=0.1)


def labelled(states: NDArray[np.int64], appearance: str, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Frames that say their macrostates in numbers; 255 for a hidden coordinate."""
    frames = np.zeros((len(states), 64, 64, 3), np.uint8)
    frames[:, 0, : states.shape[1], 0] = states % 256
    return frames


@pytest.mark.parametrize("before", [0, 1, 4])
def test_compared_rollouts_are_as_late_and_hidden_as_frames(before: int) -> None:
    """With a lag of 2 and a human who points once: a frame shows two macro-actions ago, and the hand at the start."""
    spec = dataclasses.replace(registry.task("arrows:gesture=first,lag=2"), render_macrostates=labelled)
    rng, episode = np.random.default_rng(0), [spec.rules.start_states[0]]
    for _ in range(before):
        moves = [spec.rules.outcomes(episode[-1], action)[0] for action in range(spec.n_actions)]
        episode.append(next(each.macrostate for each in moves if not each.terminated))
    frame = np.zeros((64, 64, 3), np.uint8)
    rollout = FakeImaginer().imagine(frame, actions=None, depth=6, rng=rng)
    moment = Moment(spec=spec, appearance="clean", frame=frame, macrostate=episode[-1], before=episode[:-1])
    compared = moment.beside(rollout, rng)
    states = list(episode)
    rewards = []
    over = False
    for action in rollout.actions:
        (outcome,) = spec.rules.outcomes(states[-1], int(action))
        states.append(states[-1] if over else outcome.macrostate)
        rewards.append(0.0 if over else outcome.reward)
        over = over or outcome.terminated
    assert compared.real_rewards.tolist() == rewards and bool(compared.real_terminated[-1]) == over
    for depth in range(6):
        source = max(0, before + depth + 1 - 2)
        *directions, pointed = states[source]
        in_frame, read = (pointed, pointed) if source == 0 else (255, 3)
        assert compared.real_frames[depth, 0, :4, 0].tolist() == [*directions, in_frame]
        assert compared.real_macrostates[depth].tolist() == [*directions, read]


def test_bars_of_a_rollout_that_ends_early_keep_their_places(tmp_path: Path) -> None:
    class Short(FakeImaginer):
        def imagine(
            self, frame: Frame, *, actions: NDArray[np.int64] | None, depth: int, rng: np.random.Generator
        ) -> ImaginedRollout:
            return super().imagine(frame, actions=actions, depth=2, rng=rng)

    path = record(Short(), tmp_path / "short.rrd", episodes=1)
    for kind, second in (("epistemic", 0.1), ("aleatoric", 0.05), ("modal", 0.01)):
        values = by_step(path, f"/imagined/uncertainty/{kind}", "BarChart:values")[0]
        assert values["buffer"] == pytest.approx([0.0, second, 0.0, 0.0, 0.0, 0.0])


class _Remembers(FakeAgent):
    """Turns a cube back and forth, and recalls values that follow from the frame."""

    def __init__(self) -> None:
        super().__init__()
        self.turns = itertools.cycle((4, 5))

    def act(self, observation: Observation, *, explore: bool) -> int:
        return next(self.turns)

    def read_memory(self, frame: Frame, counts: Sequence[int]) -> NDArray[np.int64]:
        return np.array([int(frame.sum()) % count for count in counts])


class _Faults(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Says of macro-actions without a success that they went wrong."""

    def step(self, action: Any) -> Any:
        *step, info = self.env.step(action)
        fault = {} if info["is_success"] else {"fault": True, "fault_reason": "it slipped"}
        return *step, {**info, **fault}


@pytest.mark.parametrize("observation", ["frame", "state,proprio"])
def test_a_recording_shows_what_the_agent_sees_and_says_what_is_true(tmp_path: Path, observation: str) -> None:
    """Frames are those of another environment, played the same way, which delivers them two macro-actions late; of an
    agent that sees no frames, too. Faults are named, and what an agent remembers of what it does not see.
    """
    task, options = "arrows:gesture=first,lag=2", {"gesture": "first", "lag": 2, "execution": "kinematic"}
    path = tmp_path / "late.rrd"
    with closing(gymnasium.make("imagine_bench/Arrows-v0", observation=observation, **options)) as env:
        given: dict[str, Any] = {"name": "random", "env": _Faults(env), "seed": 6, "appearance": "clean", "episodes": 1}
        record_run(task, _Remembers(), path=path, **given)
    spec = registry.task(task)
    with closing(_Faults(gymnasium.make("imagine_bench/Arrows-v0", **options))) as env:
        frame, info = env.reset(seed=episodes.episode_seed("recording", 6, 1))
        agent, frames, infos, over = _Remembers(), [frame], [info], False
        headings, lasts = ["### Episode 1: a new start"], []
        while not over:
            action = agent.act(Observation(frame=frame, macrostate=None), explore=False)
            frame, reward, terminated, truncated, info = env.step(action)
            frames, infos, over = [*frames, frame], [*infos, info], terminated or truncated
            words = f"Done: {spec.action_names[action]}. Reward {reward:+g}." + " Fault: it slipped." * int(
                info["fault"]
            )
            headings.append(f"### Episode 1, after macro-action {len(headings)}\n\n{words}")
            lasts.append(f"Next: {spec.action_names[action]}.")
        lasts.append(f"{ending(info, terminated=terminated).capitalize()}.")
    shown = np.array(by_step(path, "/real/frame", "Image:buffer"), np.uint8)
    differ = (shown.reshape(-1, 64, 64, 3) != frames).any(axis=3).mean(axis=(1, 2))
    most = 0.0 if observation == "frame" else 0.1  # objects stand a little elsewhere; another arrow is 0.14
    assert (differ <= most).all(), differ
    texts = by_step(path, "/real/text", "TextDocument:text")
    counts = [len(values) for values in spec.macrostate_values]
    for text, info, frame, heading, last in zip(texts, infos, frames, headings, lasts, strict=True):
        recalled = agent.read_memory(frame if observation == "frame" else frame[:0], counts)
        lines = ""
        named = map(spec.value_names, (info["macrostate"], info["shown"], recalled))
        for name, now, late, memory in zip(spec.macrostate_names, *named, strict=True):
            lines += f"- {name}: {now}{'' if now == late else f' (frame: {late}; memory: {memory})'}\n"
        assert text == f"*{spec.description}*\n\n{heading}\n\n{lines}\n\n**{last}**"
    assert "(frame: " in "".join(texts) and "(frame: " not in texts[0] and "Fault" in texts[1]
    assert not any(each.startswith(("/imagined", "/real/q_")) for each in contents(path)), "it does neither"


def test_imagination_is_set_beside_its_own_episode_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moments: list[tuple[list[State], State]] = []

    def noted(**given: Any) -> Moment:
        moments.append((list(given["before"]), given["macrostate"]))
        return Moment(**given)

    monkeypatch.setattr(episodes, "Moment", noted)
    record(FakeImaginer(), tmp_path / "two.rrd", episodes=2)
    assert [before for before, _ in moments].count([]) == 2
    for (earlier, state), (before, _) in itertools.pairwise(moments):
        assert before in ([], [*earlier, state])


@pytest.mark.parametrize(("seeds", "recorded"), [(1, [True, False]), (0, [True, True])])
def test_of_so_many_seeds_alone_or_of_all_runs_are_recorded(tmp_path: Path, seeds: int, recorded: list[bool]) -> None:
    few = {"budgets": (1,), "evaluation_episodes": 1, "recorded_episodes": 1}
    wanted = small(agents=("random",), seeds=(4, 5), recorded_seeds=seeds, **few)
    result = bench(wanted, {}, root=tmp_path, launcher=Inline())
    assert [run.recording is not None for run in result.runs] == recorded
    assert bench(wanted, {}, root=tmp_path, launcher=Inline(patience=0)).missing == (), "no run lacks anything"
