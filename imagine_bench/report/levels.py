"""The levels of a judgement, L0 to L7: each with its measures, the claim that it supports, and one that it does not.

Levels after "How Should World Models Be Evaluated?" (arXiv 2606.15032), which has L0 to L3 as diagnostics of images,
L4 as the first test of interventions, and L5 to L7 as evidence of use for decisions. Here tests of interventions are
L3, and L4 is calibration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from imagine_bench.arrays import Pixels
from imagine_bench.interfaces import TaskSpec
from imagine_bench.recording.filmstrips import Tile, png, sheet
from imagine_bench.registry.entries import file_name
from imagine_bench.report.page import Image, Table, number


class EvidenceLevel(NamedTuple):
    """A level, and the names of its scores."""

    name: str
    measures: Sequence[str]
    supports: str
    shows_not: str


LEVELS = (
    EvidenceLevel("L0", ("unreadable",), "Its images look like images of this world.", "They show the right thing."),
    EvidenceLevel(
        "L1",
        ("total_variation", "unbiased"),
        "It gives the outcomes of one macro-action their probabilities.",
        "Its errors stay small over several macro-actions.",
    ),
    EvidenceLevel(
        "L2", ("unbiased_10",), "The same after ten macro-actions in a row.", "Decisions can be based on it."
    ),
    EvidenceLevel(
        "L3",
        ("counterfactual",),
        "It tells apart the outcomes of two macro-actions at the same luck.",
        "It knows which of them is worth more.",
    ),
    EvidenceLevel(
        "L4",
        ("outcome_ece", "auroc_wrong"),
        "Its probabilities are right in the mean, and it is less certain where it is wrong.",
        "An agent gains by believing its uncertainty.",
    ),
    EvidenceLevel(
        "L5",
        ("policy_r", "policy_tau"),
        "It ranks given policies as the world does.",
        "It still ranks rightly a policy that was optimized in it.",
    ),
    EvidenceLevel(
        "L6",
        ("value_loss", "lift", "lift_trained"),
        "The policy that is optimal in it is good in the world, and better than without the model.",
        "Another optimizer, with another aim, does as well in it.",
    ),
    EvidenceLevel(
        "L7",
        ("exploit", "exploit_bound"),
        "It promises no policy a return that is further above the true one than the bound.",
        "It underrates no policy; an optimizer finds the worst one.",
    ),
)


def claims_table() -> Table:
    """The claims of each level."""
    header = ["level", "it supports the claim", "it does not show"]
    rows = [[level.name, level.supports, level.shows_not] for level in LEVELS]
    return Table("claims", header, rows, "Claims that each level supports, and claims that it leaves open.", prose=True)


def film_image(model: str, title: str, spec: TaskSpec, film: Mapping[str, Any], frames: Mapping[str, Pixels]) -> Image:
    """The most overrated policy of a model: the course that it believes above that of the world."""
    believed, real = film["returns"]
    rows = []
    for name, words in (("believed", "the model believes"), ("real", "the world does")):
        first, *reached = frames[f"film_{name}"]
        tiles = [Tile(first, "start")]
        for step, (frame, (action, reward, over)) in enumerate(zip(reached, film[name], strict=True), 1):
            below = f"reward {number(reward)}" + ("\nthe end" if over else "")
            tiles.append(Tile(frame, f"{step}. {spec.action_names[action]}", below))
        rows.append((words, tiles))
    room = max(len(tiles) for _, tiles in rows)
    caption = (
        f"The policy that {title} overrates most, from {film['start']}: expected return {number(believed)} in the "
        f"model and {number(real)} in the world. Shown are the likeliest outcomes, as read, and expected rewards; "
        "black is an image in which nothing is read."
    )
    return Image(f"film_{file_name(model)}", lambda: png(sheet(rows, room)), caption)
