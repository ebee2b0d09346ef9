"""Why the agents of a bench failed: every failed test episode, at every budget, with the one cause that it has."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from imagine_bench import registry
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.interfaces import Agent, TaskSpec
from imagine_bench.judge.causes import Attribution, FailedEpisode, frames_to_ask_with, misread
from imagine_bench.report import write_report
from imagine_bench.report.analysis import chosen, origin, provenance
from imagine_bench.report.exact import HEAD, causes_table, failures
from imagine_bench.rules import states_of
from imagine_bench.running.evaluation import Env
from imagine_bench.running.progress import counted
from imagine_bench.running.run_state import make_env
from imagine_bench.running.trained import Trained, learners, load_trained, protocol_of_agents
from imagine_bench.seeding import Purpose, episode_seed, evaluation_split
from imagine_bench.store import run_folder
from imagine_bench.store.files import csv_text, lock, make_folder, write_bytes, write_json
from imagine_bench.store.merge import load_so_far
from imagine_bench.store.results import KeptEpisodes


@dataclass(frozen=True, kw_only=True)
class Tested:
    """The causes of one test's failures."""

    episodes: int  # real training episodes before
    tests: int
    causes: Mapping[int, str]  # by number of the test


def why_report(folder: Path | None, *, root: Path, task: str | None, encoder: str | None) -> str:
    """Find the causes for every learner of a bench, keep them in its folder, and write its report anew.

    The bench is as in :func:`.analysis.chosen`, ``encoder`` as in :func:`imagine_bench.running.trained.load_trained`.
    Returns what to print.

    Raises:
        ImagineBenchError: No bench, or none with an agent that can be taken up again.
        BusyError: Another process is at the same.
        SetupError: The bench's folder cannot be written.
    """
    bench = chosen(folder, root, task)
    protocol, where = protocol_of_agents(bench), bench / "why"
    spec, appearance, folders = registry.task(protocol.task), protocol.appearance_in_tests, learners(bench)
    with lock(bench / ".why.lock", f"The folder {where}"):
        analysis = WhyAnalysis(spec, appearance=appearance, purpose=evaluation_split(protocol.seeds[0]))
        rows: list[Sequence[object]] = []
        runs = []
        for run in counted(folders, "runs", total=len(folders)):
            trained = load_trained(run, encoder=encoder)
            found, head = analysis.measure(trained), {"agent": trained.spec.agent, "seed": trained.spec.seed}
            by_budget = {str(each.episodes): Counter(each.causes.values()) for each in found}
            runs.append({**head, "episodes": trained.episodes, "failures": by_budget})
            for each in found:  # a row a failure; and one a test without any, whose cause is empty
                facts = (*head.values(), each.episodes, each.tests)
                rows += [(*facts, test, cause) for test, cause in each.causes.items() or [("", "")]]
        table, made = causes_table(failures(rows)), {**provenance(protocol.hash), "appearance": appearance}
        text = f"{table.markdown}\n\n{table.remark}"
        make_folder(where)
        write_bytes(where / "causes.csv", csv_text([HEAD, *rows]).encode())
        write_json(where / "summary.json", {**made, "frames": "kinematic", "runs": runs})
        write_bytes(where / "why.md", f"# {spec.title}: why agents failed\n\n{text}\n\n{origin(made)}\n".encode())
    write_report(load_so_far(bench))
    return f"{spec.title}, {appearance}\n\n{text}\n\nAll rows:   {where / 'causes.csv'}"


class WhyAnalysis:
    """The causes of every failure."""

    def __init__(self, spec: TaskSpec, *, appearance: str, purpose: Purpose = "evaluation") -> None:
        if spec.sight is not None:
            raise InvalidValueError(
                f"Frames of {spec.id} hide something, or are old. What an agent should have done there depends on all "
                "that it saw before, so its failures have no one cause; ask about a world without gesture and lag."
            )
        self.spec, self._appearance, self._purpose = spec, appearance, purpose
        self._states = np.array(states_of(spec.rules), dtype=np.int64)

    def measure(self, trained: Trained) -> tuple[Tested, ...]:
        """Play its failed test episodes again and find their causes; its eyes are those of the end of training.

        Raises:
            ArtefactError: An unfinished run, or one that keeps no test episodes.
            InvalidValueError: What it experienced is not known, or its task has too many macrostates.
        """
        protocol, found = trained.spec.protocol, []
        if protocol.dataset or protocol.after:
            raise InvalidValueError("What agents saw in a dataset or an earlier task is not kept; give another bench.")
        if not protocol.shows_frames_alone:
            raise InvalidValueError("These agents saw more than frames; give a bench of --observation frame.")
        if not run_folder.is_done(trained.folder):
            raise ArtefactError(f"{trained.folder} is not finished; give the bench command again to finish it.")
        run = run_folder.load_run(trained.folder)
        with closing(make_env(protocol, protocol.task, testing=True)) as env:
            episodes, agent = _FailedEpisodes(env, trained.agent, trained.spec.seed), trained.agent
            frames = frames_to_ask_with(agent, self.spec, appearance=self._appearance, purpose=self._purpose)
            readable = ~misread(agent, frames, self._states)
            for row in run.checkpoints:
                if row.kept is None or run.tried is None:
                    raise ArtefactError(f"{trained.folder} keeps no test episodes; run its bench anew, elsewhere.")
                if row.beliefs is None:
                    raise InvalidValueError(f"{self.spec.id} has too many macrostates to ask an agent about each.")
                tried = run.tried[run.tried[:, -1] < row.episodes, :-1].astype(np.int64)
                attribution = Attribution(self.spec, row.beliefs, tried, readable)
                failed = np.flatnonzero(~row.kept.success).tolist()
                causes = {test: attribution.cause(episodes.of(row.kept, test)) for test in failed}
                found.append(Tested(episodes=row.episodes, tests=row.test_episodes, causes=causes))
        return tuple(found)


class _FailedEpisodes:
    """Failed test episodes, played again with the agent's eyes open; each once."""

    def __init__(self, env: Env, agent: Agent, seed: int) -> None:
        self._env, self._agent, self._purpose = env, agent, evaluation_split(seed)
        self._known: dict[tuple[int, ...], FailedEpisode] = {}

    def of(self, kept: KeptEpisodes, test: int) -> FailedEpisode:
        """One of the episodes kept."""
        actions, seed = kept.actions_of(test), episode_seed(self._purpose, 0, test)
        if (seed, *actions) not in self._known:
            self._known[seed, *actions] = self._play(seed, actions)
        return self._known[seed, *actions]

    def _play(self, seed: int, actions: list[int]) -> FailedEpisode:
        frame, info = self._env.reset(seed=seed)
        frames, infos, terminated = [frame], [info], False
        for action in actions:
            frame, _, terminated, _, info = self._env.step(action)
            frames.append(frame)
            infos.append(info)
        states = np.array([info["macrostate"] for info in infos], dtype=np.int64)
        wrong = misread(self._agent, np.array(frames[:-1]), states[:-1])
        return FailedEpisode(
            states=[tuple(state) for state in states.tolist()], actions=actions, terminated=bool(terminated),
            faults=[bool(info["fault"]) for info in infos[1:]], misread=wrong.tolist(), seed=seed,
        )  # fmt: skip
