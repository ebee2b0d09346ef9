"""A judgement to step through: the truth and what each model imagines of it, side by side.

Timeline ``depth``, the macro-actions imagined so far; entities ``/real/...`` and ``/<model>/...``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from imagine_bench import registry
from imagine_bench.judge.judgement import Judgement, shown
from imagine_bench.judge.models import model_entry
from imagine_bench.recording.stream import recording_file
from imagine_bench.registry.entries import file_name


def record_judgement(folder: Path, judgement: Judgement) -> Path | None:
    """Record one rollout of every model that was fitted to most data: pictures, and outcomes with probabilities.

    Returns the file, or None where no model was judged.
    """
    spec = registry.task(judgement.task)
    found = shown(folder, judgement)
    if not found:
        return None
    one = next(iter(found.values()))
    strips = {"real": ("the truth", one["futures_real"][0], one["futures"]["real"])}
    for model, each in found.items():
        strips[file_name(model)] = (model_entry(model).title, each["futures_imagined"][0], each["futures"]["imagined"])
    path = folder / "judgement.rrd"
    with recording_file(path, spec.id, _layout({name: title for name, (title, _, _) in strips.items()})) as to:
        for depth in range(1 + len(one["futures"]["real"])):
            to.stream.set_time("depth", sequence=depth)
            action = f"**{depth}. {spec.action_names[one['futures_actions'][0][depth - 1]]}**" if depth else "the start"
            to.text("/action", action)
            for name, (_, pictures, outcomes) in strips.items():
                to.log(f"/{name}/frame", rr.Image(pictures[depth - 1] if depth else one["futures_before"][0]))
                to.text(f"/{name}/outcomes", _words(outcomes[depth - 1] if depth else {}))
    return path


def _words(outcomes: Mapping[str, float]) -> str:
    """Outcomes, the likeliest first."""
    rows = sorted(outcomes.items(), key=lambda pair: -pair[1])
    return "\n".join(f"- {share:.0%} {words}" for words, share in rows)


def _layout(titles: Mapping[str, str]) -> rrb.Blueprint:
    columns = []
    for name, title in titles.items():
        frame = rrb.Spatial2DView(origin=f"/{name}/frame", name=title)
        columns.append(rrb.Vertical(frame, rrb.TextDocumentView(origin=f"/{name}/outcomes", name="outcomes")))
    action = rrb.TextDocumentView(origin="/action", name="macro-action")
    return rrb.Blueprint(
        rrb.Vertical(action, rrb.Horizontal(*columns), row_shares=[1, 8]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="depth"),
    )
