"""Sections on what agents see and what they imagine."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.figure import Figure

from imagine_bench.protocols.control import Protocol
from imagine_bench.recording.filmstrips import filmstrip, first_cut, png, sampled_filmstrips
from imagine_bench.registry.entries import file_name
from imagine_bench.report import figures
from imagine_bench.report.data import ReportData, agent_title, known_agent
from imagine_bench.report.tables import DASH, Image, Section, Table, percent
from imagine_bench.store import encoders
from imagine_bench.store.files import read_json, reading
from imagine_bench.store.results import ComparedRollout, OpenLoop

SHOWN_ROLLOUTS = 3  # rollouts shown of each imagining agent: the first ones of its first seed
_MEASURES = (
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
_KINDS = ("epistemic", "aleatoric", "modal")
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


def open_loop(data: ReportData) -> Section | None:
    """Imagination against the rules by depth."""
    if not data.open_loop:
        return None
    deep = any(len(loop.correct) > 1 for loop in data.open_loop.values())
    words = (
        f"Imagination against the rules after {data.budgets[-1]:,} real episodes: from real images, the model predicts "
        "ahead without looking again, and a probe that the agents never use reads the macrostate (the discrete state "
        "of the task) from what it imagines. Only chains of macro-actions that end no episode whatever chance may "
        "bring are compared. Mean over seeds.",
        "AUROC: among transitions that began in the right macrostate, the probability that one that goes wrong has the "
        "higher uncertainty of two; 0.5 is chance, 1 is perfect.",
    )
    image = figures.plot("open_loop", lambda: open_loop_figure(data), "By imagined depth; means over seeds.")
    tables = [_depth_table(agent, loop, folded=deep) for agent, loop in data.open_loop.items()]
    return Section("Open-loop error by depth", words, [image] if deep else [], tables)


def _depth_table(agent: str, loop: OpenLoop, *, folded: bool) -> Table:
    """A row a measure, a column an imagined depth."""
    title = agent_title(agent)
    header = [f"{title}: depth", *(str(step + 1) for step in range(len(loop.count)))]
    rows = [[words, *(_value(value, form) for value in getattr(loop, name))] for name, words, form in _MEASURES]
    why = "the filter keeps none, or none or all are wrong"
    unfold = f"In numbers: {title}" if folded else ""
    return Table(f"openloop_{file_name(agent)}", header, rows, why_dash=why, folded=unfold)


def _value(value: float, form: str) -> str:
    if np.isnan(value):
        return DASH
    return percent(value) if form == "%" else form.format(value)


def open_loop_figure(data: ReportData) -> Figure:
    """The measures of the tables by imagined depth, a panel each; an agent that knows no such uncertainty says 0."""
    panels: dict[str, dict[str, dict[int, float]]] = {words: {} for _, words, _ in _MEASURES[1:]}
    for agent, loop in data.open_loop.items():
        for name, words, form in _MEASURES[1:]:
            values = (100.0 if form == "%" else 1.0) * getattr(loop, name)
            if name not in _KINDS or values.any():
                panels[words][agent_title(agent)] = dict(enumerate(values, 1))
    return figures.lines(panels, figures.colors(data.agents), "imagined depth (macro-actions)")


def sampled_rollouts(data: ReportData) -> Section | None:
    """One sheet an agent: several rollouts sampled from one start, of its first seed."""
    images = []
    for agent in data.agents if data.installed else ():
        run = data.result.of(agent)[0]
        if run.sampled_rollouts:
            caption = f"{agent_title(agent)}, seed {run.seed}: the same start {len(run.sampled_rollouts)} times."
            sheet = png(sampled_filmstrips(run.sampled_rollouts, data.spec))
            images.append(Image.of(f"sampled_rollouts_{file_name(agent)}", sheet, caption))
    words = (
        "What happens next is partly chance. Each row is one rollout, sampled from the same real image (the first one; "
        "everything else is imagined and decoded), the agent choosing. Below each image stands what has changed: in "
        "blue where the rules make it possible, in orange where not."
    )
    return Section("One start, several futures", [words], images) if images else None


def filmstrips(data: ReportData) -> Section | None:
    """Imagined rollouts beside the real ones."""
    images = []
    for agent in data.agents if data.installed else ():
        run = data.result.of(agent)[0]
        for number, compared in enumerate(run.imagined[:SHOWN_ROLLOUTS], 1):
            caption = f"{agent_title(agent)}, seed {run.seed}, start {number}: {_rollout_words(compared)}."
            strip = png(filmstrip(compared, data.spec.action_names))
            images.append(Image.of(f"rollout_{file_name(agent)}_{number}", strip, caption))
    words = (
        "Imagined rollouts of the trained agents, by their own greedy choice of macro-actions, decoded back into "
        "images. Top row: what the real environment shows for the same macro-actions. Bottom row: what the agent "
        "imagined; a blue frame where it is what the rules say, an orange one where not. The first of a few starts are "
        "shown, which are the same for every agent; not the best."
    )
    return Section("What the agents imagine", [words], images) if images else None


def _rollout_words(compared: ComparedRollout) -> str:
    alive = np.concatenate([[True], ~compared.real_terminated[:-1]])  # imagined after the real end: nothing to match
    matches = (compared.rollout.macrostates == compared.real_macrostates).all(axis=1) & alive
    cut = first_cut(compared)
    kept = "nothing is cut" if cut is None else f"the filter cuts before macro-action {cut + 1}"
    return f"{matches.sum()} of {alive.sum()} imagined macrostates are what the rules say; {kept}"


def encoders_used(data: ReportData) -> Section | None:
    """The encoders that agents see through, with card and reconstructions, found beside the artefact.

    Raises:
        ArtefactError: A card is damaged.
    """
    images, tables = [], []
    for identity, agents in encoder_readers(data.result.protocol).items():
        name = identity.partition("@")[0]
        heading = f"{identity}, for {', '.join(map(agent_title, agents))}"
        path = encoders.find(identity)
        card: dict[str, object] = {}
        if path is not None and path.with_suffix(".json").is_file():
            card = read_json(path.with_suffix(".json"), "an encoder's card")
        if path is not None and path.with_suffix(".png").is_file():
            with reading(path.with_suffix(".png"), "an encoder's image"):
                content = path.with_suffix(".png").read_bytes()
            caption = f"{heading}: real frames the encoder never saw in training, and what it makes of them."
            images.append(Image.of(f"encoder-{name}", content, caption))
        shown = {key: value for key, value in card.items() if key not in _CARD_HIDDEN}
        rows = [[_CARD_NAMES.get(key, key), _card_text(key, value)] for key, value in shown.items()]
        missing = "" if rows else "It is not here, so its card is beside its file."
        tables.append(Table(f"card-{name}", [heading, "its card"], rows, missing, prose=True))
    words = (
        "Before any learning of the task, an encoder was trained once, on images without any rewards. It turns each "
        "image into a few numbers: a variational autoencoder into latents, one that finds factors into a code for each "
        "factor. Probe accuracy is the share of held-out images whose whole macrostate can be read from them."
    )
    return Section("What the agents see", [words], images, tables) if tables else None


def encoder_readers(protocol: Protocol) -> dict[str, list[str]]:
    """The agents that see through each encoder of a protocol."""
    readers: dict[str, list[str]] = {}
    for agent in protocol.agents:
        entry = known_agent(agent)
        identity = protocol.encoder_of(entry.encoder_kind)
        if entry.needs_encoder and identity is not None:
            readers.setdefault(identity, []).append(agent)
    return readers


def _card_text(key: str, value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{inner} {_card_text(key, item)}" for inner, item in value.items())
    if isinstance(value, list):
        return ", ".join(map(str, value))
    if not isinstance(value, float):
        return str(value)
    if math.isnan(value):
        return DASH
    return f"{100.0 * value:.2f} %" if key == "probe" else f"{value:.4g}"
