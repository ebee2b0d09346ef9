"""The command that runs the ladder of experiments."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from imagine_bench.cli.options import added_up, listed, require_values, shown
from imagine_bench.errors import RunFailedError
from imagine_bench.running.launchers.jobs import launcher


@dataclass(frozen=True, kw_only=True)
class Suite:
    """Run the ladder: experiments that each turn one dial; leaves a radar chart. The same command again goes on."""

    experiment: Annotated[tyro.conf.UseAppendAction[tuple[tuple[str, ...], ...]], listed("STR", "(default: all)")] = ()
    """Only these experiments, such as memory."""
    agents: Annotated[
        tuple[str, ...] | None, listed("STR", "(default: dqn imagination_uncertainty factored:given)")
    ] = None
    """Agents to compare, also of other packages."""
    seeds: Annotated[tuple[int, ...] | None, listed("INT", "(default: 0 1)")] = None
    """Seeds; each agent has one run a seed and level."""
    workers: Annotated[int | None, shown("INT", "(default: one a core)")] = None
    """Processes at a time."""
    launcher: str = "local"
    """Where runs are carried out: local, ray or slurm."""
    out: Path = Path("runs")
    """Folder of all benches."""

    def __call__(self) -> None:
        """Run, score, write."""
        from imagine_bench.report.suite import suite_table, write_suite  # noqa: PLC0415 - matplotlib loads slowly
        from imagine_bench.suite.experiments import AGENTS, LADDER  # noqa: PLC0415 - no other command needs it
        from imagine_bench.suite.run import run_suite, with_seeds  # noqa: PLC0415 - as above

        for name in ("agents", "seeds"):
            require_values(name, getattr(self, name))
        suite = with_seeds(LADDER, self.seeds).only(added_up("experiment", self.experiment))
        where = launcher(self.launcher, self.workers)
        result = run_suite(suite, self.agents or AGENTS, root=self.out, launcher=where, planners=self.workers)
        print(suite_table(result))
        print(f"\nReport:     {write_suite(result, self.out)}")
        if result.failures:
            raise RunFailedError(f"{len(result.failures)} runs failed; the same command tries them again.")
