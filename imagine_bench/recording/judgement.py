"""A judgement to step through: the truth and each model's imagination of it, side by side.

Timeline ``depth``, the macro-actions imagined so far; entities ``/real/...`` and ``/<model>/...``.
"""

from __future__ import annotations

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
    strips = {"real": (one["futures_real"][0], one["futures"]["real"])}
    titles = {"real": "the truth"}
    for model, each in found.items():
        name = file_name(model)
        strips[name] = (each["futures_imagined"][0], each["futures"]["imagined"])
        titles[name] = model_entry(model).label
    columns = [
        rrb.Vertical(
            rrb.Spatial2DView(origin=f"/{name}/frame", name=title),
            rrb.TextDocumentView(origin=f"/{name}/outcomes", name="outcomes"),
        )
        for name, title in titles.items()
    ]
    action = rrb.TextDocumentView(origin="/action", name="macro-action")
    layout = rrb.Vertical(action, rrb.Horizontal(*columns), row_shares=[1, 8])
    path = folder / "judgement.rrd"
    with recording_file(path, spec.id, lambda _: layout, timeline="depth") as recording:
        for depth in range(1 + len(one["futures"]["real"])):
            recording.stream.set_time("depth", sequence=depth)
            done = spec.action_names[one["futures_actions"][0][depth - 1]]
            recording.text("/action", f"**{depth}. {done}**" if depth else "the start")
            for name, (pictures, outcomes) in strips.items():
                recording.log(f"/{name}/frame", rr.Image(pictures[depth - 1] if depth else one["futures_before"][0]))
                likeliest = sorted(outcomes[depth - 1].items(), key=lambda pair: -pair[1]) if depth else ()
                lines = [f"- {share:.0%} {words}" for words, share in likeliest]
                recording.text(f"/{name}/outcomes", "\n".join(lines))
    return path
