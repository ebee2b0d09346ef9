"""Where the greedy policies of a bench's agents lead, by the rules and from every start."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from imagine_bench import registry
from imagine_bench.interfaces import Floats, State, TaskSpec
from imagine_bench.judge.policy import FRAMES, Terminations, action_shares, eval_states, optimal_length, terminations
from imagine_bench.report.analysis import MEANS, Analysis, Groups, Measured, analyse, markdown
from imagine_bench.report.text import agent_words, mean_text, percent
from imagine_bench.seeding import Purpose
from imagine_bench.store.trained import Trained

_SHARES = {
    "success": "solved", "failure": "ends otherwise", "late_success": "out of time, then solved",
    "late_failure": "out of time, then ends otherwise", "endless": "never ends",
}  # fmt: skip
_SURE = 0.999  # from here on a start counts as always solved: rules may leave something to chance
_LISTED = 12  # starts that the page lists; starts.csv has all


def policy_report(folder: Path | None, *, root: Path, task: str | None, encoder: str | None) -> str:
    """Follow the policy of every learner of a bench: :func:`.analysis.analyse`."""
    return analyse(PolicyAnalysis, folder, root=root, task=task, encoder=encoder)


class PolicyAnalysis(Analysis[Terminations]):
    """Where each policy leads from every start."""

    name = "policy"
    heading = "where the greedy policies lead"
    rows_file = "starts.csv"

    def __init__(self, spec: TaskSpec, *, appearance: str, purpose: Purpose = "evaluation") -> None:
        super().__init__(spec, appearance=appearance, purpose=purpose)
        self._states = eval_states(spec, appearance=appearance, purpose=purpose)
        self._optimal = optimal_length(spec)

    def measure(self, trained: Trained) -> Terminations:
        """Where its policy leads."""
        privileged = registry.agent_entry(trained.spec.agent).privileged
        shares = action_shares(trained.agent, self._states, self.spec.n_actions, privileged=privileged)
        return terminations(self.spec, self._states, shares)

    def table(self, runs: Sequence[Measured[Terminations]]) -> str:
        """Means over the seeds of each agent with 95 % intervals, and the starts that are missed most, as Markdown."""
        groups = Groups(runs)
        head = ["agent", "real episodes", "seeds", *(f"{words}, %" for words in _SHARES.values())]
        rows = []
        for (agent, episodes), seeds in groups.items():
            means = {name: [float(getattr(each, name).mean()) for each in seeds] for name in (*_SHARES, "length")}
            cells = [mean_text(means[share]) for share in _SHARES]
            length = mean_text(means["length"], "{:.2f}".format)
            rows.append([agent_words(agent).title, f"{episodes:,}", len(seeds), *cells, length])
        lines = [
            f"All {len(self._optimal)} starts, followed by the rules; every visit of a macrostate shows one of "
            f"{FRAMES} frames of it; {MEANS}",
            "",
            *markdown([*head, f"macro-actions (optimal: {self._optimal.mean():.2f})"], rows),
            "",
            *self._by_distance(groups),
            "",
            *self._missed(groups),
        ]
        return "\n".join(lines)

    def rows(self, runs: Sequence[Measured[Terminations]]) -> Iterable[Sequence[object]]:
        """One row a run and start."""
        names = (*_SHARES, "length")
        yield ["agent", "seed", "episodes", *self.spec.macrostate_names, *names, "optimal_length"]
        for run in runs:
            for index, state in enumerate(self.spec.rules.start_states):
                numbers = [*(getattr(run.value, name)[index] for name in names), self._optimal[index]]
                yield [*run.head.values(), *self.spec.value_names(state), *(f"{number:.6g}" for number in numbers)]

    def summary(self, value: Terminations) -> dict[str, Any]:
        """Means over the starts."""
        return {name: float(getattr(value, name).mean()) for name in (*_SHARES, "length")}

    def _by_distance(self, groups: Groups[Terminations]) -> list[str]:
        """What is solved of the starts from which an optimal agent needs equally long, in whole macro-actions."""
        needs, solved, rows = self._optimal.round().astype(int), _solved(groups), []
        for need in np.unique(needs):
            shares = solved[:, needs == need].mean(axis=1)
            rows.append([need, int((needs == need).sum()), *map(percent, shares)])
        return markdown(["optimal macro-actions", "starts", *_heads(groups)], rows)

    def _missed(self, groups: Groups[Terminations]) -> list[str]:
        """The starts that are solved least, with what an optimal agent needs there."""
        solved, states = _solved(groups), self.spec.rules.start_states
        worst = np.min([one.success for seeds in groups.values() for one in seeds], axis=0)  # [starts]
        order = [index for index in np.argsort(solved.mean(axis=0), kind="stable") if worst[index] < _SURE]
        if not order:
            return ["Every run solves every start."]
        rows = []
        for index in order[:_LISTED]:
            rows.append([self._words(states[index]), f"{self._optimal[index]:.2f}", *map(percent, solved[:, index])])
        return [
            f"Starts that some run does not always solve: {len(order)} of {len(self._optimal)}. Solved least:",
            "",
            *markdown(["start", "optimal macro-actions", *_heads(groups)], rows),
        ]

    def _words(self, state: State) -> str:
        named = zip(self.spec.macrostate_names, self.spec.value_names(state), strict=True)
        return ", ".join(f"{name} {value}" for name, value in named)


def _solved(groups: Groups[Terminations]) -> Floats:
    """Mean over the seeds of each group, of each start. Shape (groups, starts)."""
    return np.array([np.mean([one.success for one in seeds], axis=0) for seeds in groups.values()])


def _heads(groups: Groups[Terminations]) -> list[str]:
    return [f"{title}: solved, %" for title in groups.titles]
