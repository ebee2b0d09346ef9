"""Why the agents of a bench failed: every failed test episode, at every budget, with the one cause that it has."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from imagine_bench import registry
from imagine_bench.judge.causes import WhyAnalysis
from imagine_bench.report import write_report
from imagine_bench.report.exact import HEAD, causes_table, failures
from imagine_bench.report.page import chosen, origin, provenance
from imagine_bench.running.progress import counted
from imagine_bench.running.trained import learners, load_trained, protocol_of_agents
from imagine_bench.seeding import evaluation_split
from imagine_bench.store.files import csv_text, lock, make_folder, write_bytes, write_json
from imagine_bench.store.loading import load_so_far


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
    where = bench / "why"
    protocol = protocol_of_agents(bench)
    spec = registry.task(protocol.task)
    appearance = protocol.appearance_in_tests
    folders = learners(bench)
    with lock(bench / ".why.lock", f"The folder {where}"):
        analysis = WhyAnalysis(spec, appearance=appearance, purpose=evaluation_split(protocol.seeds[0]))
        rows: list[Sequence[object]] = []
        runs = []
        for run in counted(folders, "runs", total=len(folders)):
            trained = load_trained(run, encoder=encoder)
            found = analysis.measure(trained)
            head = {"agent": trained.spec.agent, "seed": trained.spec.seed}
            by_budget = {str(each.episodes): Counter(each.causes.values()) for each in found}
            runs.append({**head, "episodes": trained.episodes, "failures": by_budget})
            for each in found:  # a row a failure; and one a test without any, whose cause is empty
                facts = (*head.values(), each.episodes, each.tests)
                rows += [(*facts, test, cause) for test, cause in each.causes.items() or [("", "")]]
        table = causes_table(failures(rows))
        made = {**provenance(protocol.hash), "appearance": appearance}
        text = f"{table.markdown}\n\n{table.remark}"
        make_folder(where)
        write_bytes(where / "causes.csv", csv_text([HEAD, *rows]).encode())
        write_json(where / "summary.json", {**made, "frames": "kinematic", "runs": runs})
        write_bytes(where / "why.md", f"# {spec.title}: why agents failed\n\n{text}\n\n{origin(made)}\n".encode())
    write_report(load_so_far(bench))
    return f"{spec.title}, {appearance}\n\n{text}\n\nAll rows:   {where / 'causes.csv'}"
