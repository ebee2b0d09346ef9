"""The section on where greedy policies lead by the rules, from every start: exact, no episode is sampled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from imagine_bench.interfaces import Floats, State, TaskSpec
from imagine_bench.judge.policy import Terminations, optimal_length, terminations
from imagine_bench.report.data import ReportData
from imagine_bench.report.sections import Section, Table
from imagine_bench.report.text import agent_words, mean_text, percent
from imagine_bench.rules import greedy

_SHARES = {
    "success": "solved", "failure": "ends otherwise", "late_success": "out of time, then solved",
    "late_failure": "out of time, then ends otherwise", "endless": "never ends",
}  # fmt: skip
_SURE = 0.999  # from here on a start counts as always solved: rules may leave something to chance
_LISTED = 12  # starts that are listed, those solved least
Found = Mapping[str, Sequence[Terminations]]
"""By agent, where the policy of each of its seeds leads."""


def followed(data: ReportData) -> Found:
    """The learners whose macro-action in every macrostate was kept at the last budget, followed from the tests' starts.

    In each macrostate an agent does what it did in a frame of it that it read right, if one of a few was.
    """
    spec = data.result.protocol.spec(testing=True) if data.spec.action_names else data.spec
    held = {
        agent: [run.checkpoints[-1].beliefs for run in data.result.of(agent)] for agent in data.result.protocol.agents
    }
    return {
        agent: [terminations(spec, greedy(one.action.astype(np.int64), spec.n_actions)) for one in each if one]
        for agent, each in held.items()
        if data.spec.action_names and all(each)
    }


def policies(data: ReportData, found: Found) -> Section:
    """What policies do from every start, by the shortest plan, and from the starts that they miss."""
    spec = data.result.protocol.spec(testing=True)
    optimal, episodes = optimal_length(spec), f"{data.budgets[-1]:,} real episodes"
    solved = np.array([np.mean([one.success for one in seeds], axis=0) for seeds in found.values()])  # [agents, starts]
    titles = [agent_words(agent).title for agent in found]
    rows = [
        [title, *(mean_text([float(getattr(one, name).mean()) for one in seeds]) for name in _SHARES),
         mean_text([float(one.length.mean()) for one in seeds], "{:.2f}".format)]
        for title, seeds in zip(titles, found.values(), strict=True)
    ]  # fmt: skip
    needs = optimal.round().astype(int)
    by_need = [
        [str(need), str((needs == need).sum()), *map(percent, solved[:, needs == need].mean(axis=1))]
        for need in np.unique(needs)
    ]
    tables = [
        Table(
            name="policies", rows=rows,
            header=["agent, %", *_SHARES.values(), f"macro-actions (optimal: {optimal.mean():.2f})"],
            caption=f"After {episodes}, from all {len(optimal)} starts. Means over seeds [95 %].",
        ),
        Table(name="policies_by_length", header=["optimal macro-actions", "starts", *titles], rows=by_need,
              caption="Solved, %, by what an optimal agent needs.", folded="By the length of the optimal plan"),
    ]  # fmt: skip
    worst = np.min([one.success for seeds in found.values() for one in seeds], axis=0)  # [starts]
    if missed := [index for index in np.argsort(solved.mean(axis=0), kind="stable") if worst[index] < _SURE]:
        tables.append(_missed(spec, missed, optimal, solved, titles))
    words = "Each policy is followed by the rules: no episode is sampled, and no frame misread that can be read right."
    return Section(title="Where the greedy policies lead", words=[words], tables=tables)


def _missed(spec: TaskSpec, missed: Sequence[int], optimal: Floats, solved: Floats, titles: Sequence[str]) -> Table:
    starts = spec.rules.start_states

    def words(state: State) -> str:
        named = zip(spec.macrostate_names, spec.value_names(state), strict=True)
        return ", ".join(f"{name} {value}" for name, value in named)

    return Table(
        name="policies_missed", header=["start", "optimal macro-actions", *titles],
        rows=[[words(starts[at]), f"{optimal[at]:.2f}", *map(percent, solved[:, at])] for at in missed[:_LISTED]],
        caption=f"Solved, %. Some run does not always solve {len(missed)} of {len(optimal)} starts.",
        folded="The starts that are solved least",
    )  # fmt: skip
