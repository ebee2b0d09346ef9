"""Sections on what agents see and what they imagine."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from imagine_bench.judge.filmstrips import filmstrip, first_cut, png, sampled_filmstrips
from imagine_bench.registry.entries import file_name
from imagine_bench.report import figures
from imagine_bench.report.data import ReportData
from imagine_bench.report.missing import known_agent
from imagine_bench.report.tables import DASH, Cell, Image, Section, Table
from imagine_bench.report.text import agent_words, percent
from imagine_bench.store import encoders
from imagine_bench.store.files import read_json, reading
from imagine_bench.store.results import BenchResult, ComparedRollout

SHOWN_ROLLOUTS = 3  # rollouts shown of each imagining agent: the first ones of its first seed
_LOOP_ROWS = (
    ("count", "transitions compared", "{:.0f}"),
    ("correct", "macrostate right (%)", "%"),
    ("correct_accepted", "right among those kept (%)", "%"),
    ("accepted", "kept by the filter (%)", "%"),
    ("termination_error", "wrong about the end (%)", "%"),
    ("auroc_epistemic", "wrong ones found by epistemic (AUROC)", "{:.2f}"),
    ("auroc_aleatoric", "by aleatoric", "{:.2f}"),
    ("auroc_modal", "by modal", "{:.2f}"),
    ("reward_mae", "reward error", "{:.3g}"),
    ("epistemic", "epistemic", "{:.3g}"),
    ("aleatoric", "aleatoric", "{:.3g}"),
    ("modal", "modal", "{:.3g}"),
)
_CARD_NAMES = {
    "code_sizes": "values of each factor",
    "cpu_s": "CPU seconds",
    "kl_nats": "KL from the prior (nats a frame)",
    "reconstruction": "reconstruction error",
    "latent_size": "latent size",
    "macrostate_names": "macrostate",
    "probe": "probe accuracy",
}
_CARD_HIDDEN = {"format", "cardinalities"}


@dataclass(frozen=True, kw_only=True)
class EncoderView:
    """What the report knows of an encoder."""

    agents: tuple[str, ...]  # those that see through it
    identity: str  # as in the protocol: name and beginning of the digest
    card: dict[str, Any]  # the card's contents; empty where the file is not among the bundled ones
    image: Path | None  # real and reconstructed frames, a PNG file, or None


def sections(data: ReportData) -> Iterator[Section]:
    """Those for which the result has something, in their order."""
    if data.acceptance:
        yield _acceptance(data)
    if data.open_loop:
        yield _open_loop(data)
    is_here = bool(data.spec.action_names)
    if is_here and (sheets := list(_sampled_rollouts(data))):
        yield Section(
            title="One start, several futures",
            words=(
                "What happens next is partly chance. Each row is one rollout, sampled from the same real image (the "
                "first one; everything else is imagined and decoded), the agent choosing. Below each image stands "
                "what has changed: in blue where the rules make it possible, in orange where not.",
            ),
            images=sheets,
        )
    if is_here and (strips := list(_filmstrips(data))):
        yield Section(
            title="What the agents imagine",
            words=(
                "Imagined rollouts of the trained agents, by their own greedy choice of macro-actions, decoded back "
                "into images. Top row: what the real environment shows for the same macro-actions. Bottom row: what "
                "the agent imagined; a blue frame where it is what the rules say, an orange one where not. The first "
                "of a few starts are shown, which are the same for every agent; not the best.",
            ),
            images=strips,
        )
    if views := encoder_views(data.result):
        yield _encoders(views)


def _acceptance(data: ReportData) -> Section:
    caption = (
        "Share of the transitions imagined while training, up to each budget, that went into the replay memory of "
        "imagined transitions. Mean over seeds."
    )
    alt = "Share of imagined transitions that the uncertainty filter kept while training."
    draw = functools.partial(figures.acceptance_figure, data)
    figure = figures.image("acceptance", draw, alt=alt, caption=caption, svg=True, dpi=180)
    return Section(
        title="How much imagination is kept",
        words=(
            "An imagined rollout is a chain of transitions that the agent's world model predicts, starting from a real "
            "image; depth counts its macro-actions. The uncertainty filter cuts a rollout at the first transition "
            "whose epistemic uncertainty (what the model does not know for want of data) is too high. Two other kinds "
            "are shown beside it: aleatoric (noise) and modal (several outcomes are possible).",
        ),
        images=[figure],
    )


def _open_loop(data: ReportData) -> Section:
    deep = any(len(loop.correct) > 1 for loop in data.open_loop.values())
    alt = "Open-loop error and uncertainty of imagined rollouts by depth."
    caption = f"After {data.budgets[-1]:,} real episodes. Means over seeds."
    figure = figures.image(
        "open_loop", lambda: figures.open_loop_figure(data), alt=alt, caption=caption, svg=True, dpi=180
    )
    return Section(
        title="Open-loop error by depth",
        words=(
            f"Imagination against the rules after {data.budgets[-1]:,} real episodes: from real images, the model "
            "predicts ahead without looking again, and a probe that the agents never use reads the macrostate (the "
            "discrete state of the task) from what it imagines. Only chains of macro-actions that end no episode "
            "whatever chance may bring are compared. Mean over seeds.",
            "AUROC: among transitions that began in the right macrostate, the probability that one that goes wrong has "
            "the higher uncertainty of two; 0.5 is chance, 1 is perfect.",
        ),
        images=[figure] if deep else [],
        tables=[
            _by_depth(
                "openloop", agent, loop, _LOOP_ROWS, why="the filter keeps none, or none or all are wrong",
                folded=f"In numbers: {agent_words(agent).title}" if deep else "",
            )
            for agent, loop in data.open_loop.items()
        ],
    )  # fmt: skip


def _by_depth(
    name: str, agent: str, found: object, rows: Sequence[tuple[str, str, str]], *, why: str, folded: str = ""
) -> Table:
    """A row a measure, a column an imagined depth."""
    depth = len(getattr(found, rows[0][0]))
    return Table(
        name=f"{name}_{file_name(agent)}",
        header=[f"{agent_words(agent).title}: depth", *(str(step + 1) for step in range(depth))],
        rows=[
            [words, *(_value(value, form, {"agent": agent, name: field}) for value in getattr(found, field))]
            for field, words, form in rows
        ],
        why_dash=why,
        folded=folded,
    )


def _value(value: float, form: str, data: dict[str, object]) -> Cell:
    return Cell(text=DASH if np.isnan(value) else percent(value) if form == "%" else form.format(value), data=data)


def _filmstrips(data: ReportData) -> Iterator[Image]:
    for agent in data.result.protocol.agents:
        run = data.result.of(agent)[0]
        for index, compared in enumerate(run.imagined[:SHOWN_ROLLOUTS]):
            yield _filmstrip(data, agent, run.seed, index, compared)


def _filmstrip(data: ReportData, agent: str, seed: int, index: int, compared: ComparedRollout) -> Image:
    alive = np.concatenate([[True], ~compared.real_terminated[:-1]])  # imagined after the real end: nothing to match
    matches = (compared.rollout.macrostates == compared.real_macrostates).all(axis=1) & alive
    cut = first_cut(compared)
    kept = "nothing is cut" if cut is None else f"the filter cuts before macro-action {cut + 1}"
    caption = (
        f"{_capital(agent)}, seed {seed}, start {index + 1}: {int(matches.sum())} of {int(alive.sum())} imagined "
        f"macrostates are what the rules say; {kept}."
    )
    return Image.of(
        png(filmstrip(compared, data.spec.action_names)),
        name=f"rollout_{file_name(agent)}_{index + 1}",
        alt=f"Real frames above, imagined frames below. {caption}",
        caption=caption,
    )


def _sampled_rollouts(data: ReportData) -> Iterator[Image]:
    """One sheet an agent: several rollouts sampled from one start, of its first seed."""
    for agent in data.result.protocol.agents:
        run = data.result.of(agent)[0]
        if run.sampled_rollouts:
            caption = f"{_capital(agent)}, seed {run.seed}: the same start {len(run.sampled_rollouts)} times."
            sheet = png(sampled_filmstrips(run.sampled_rollouts, data.spec))
            alt = f"Only the first image is real. {caption}"
            yield Image.of(sheet, name=f"sampled_rollouts_{file_name(agent)}", alt=alt, caption=caption)


def _capital(agent: str) -> str:
    title = agent_words(agent).title
    return f"{title[:1].upper()}{title[1:]}"


def encoder_views(result: BenchResult) -> list[EncoderView]:
    """Card and image of every encoder used, found beside the artefact of the same content.

    Raises:
        ArtefactError: A card is damaged.
    """
    readers: dict[str, list[str]] = {}
    for agent in result.protocol.agents:
        entry = known_agent(agent)
        identity = result.protocol.encoder_of(entry.encoder_kind)
        if entry.needs_encoder and identity is not None:
            readers.setdefault(identity, []).append(agent)
    views = []
    for identity, agents in readers.items():
        path = encoders.find(identity)
        card, image = (path.with_suffix(".json"), path.with_suffix(".png")) if path else (None, None)
        facts = read_json(card, "an encoder's card") if card and card.is_file() else {}
        shown = image if image and image.is_file() else None
        views.append(EncoderView(agents=tuple(agents), identity=identity, card=facts, image=shown))
    return views


def _encoders(views: Sequence[EncoderView]) -> Section:
    images, tables = [], []
    for view in views:
        name = view.identity.partition("@")[0]
        heading = f"{view.identity}, for {', '.join(agent_words(agent).title for agent in view.agents)}"
        if view.image:
            with reading(view.image, "an encoder's image"):
                content = view.image.read_bytes()
            caption = f"{heading}: real frames the encoder never saw in training, and what it makes of them."
            alt = "Real frames and what the encoder keeps of them"
            images.append(Image.of(content, name=f"encoder-{name}", alt=alt, caption=caption))
        shown = {key: value for key, value in view.card.items() if key not in _CARD_HIDDEN}
        rows = [[_CARD_NAMES.get(key, key), _card_text(key, value)] for key, value in shown.items()]
        missing = "" if rows else "It is not here, so its card is beside its file."
        tables.append(Table(name=f"card-{name}", header=[heading, "its card"], rows=rows, caption=missing, prose=True))
    return Section(
        title="What the agents see",
        words=(
            "Before any learning of the task, an encoder was trained once, on images without any rewards. It turns "
            "each image into a few numbers: a variational autoencoder into latents, one that finds factors into a "
            "code for each factor. Probe accuracy is the share of held-out images whose whole macrostate can be read "
            "from them.",
        ),
        images=images,
        tables=tables,
    )


def _card_text(key: str, value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{inner} {_card_text(key, item)}" for inner, item in value.items())
    if isinstance(value, float):
        return DASH if math.isnan(value) else f"{100.0 * value:.2f} %" if key == "probe" else f"{value:.4g}"
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
